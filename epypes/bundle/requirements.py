"""The requirements of a bundle: the packages that its replay imports, their pins, and a fresh environment of them."""

from __future__ import annotations

import ast
import base64
import contextlib
import hashlib
import importlib.util
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from epypes.errors import BundleError

REQUIREMENTS: Final = "requirements.txt"
INSTALL_TIMEOUT_S: Final = 1200.0
_OURS: Final = "epypes"
# What EPypes needs to read samples; the rest of what it needs is for serving.
_NEEDED: Final = ("numpy", "protobuf")
_NO_NETWORK: Final = re.compile(
    r"name resolution|connection (refused|error|reset)|newconnectionerror|"
    r"network is unreachable|tunneling|timed out",
    re.IGNORECASE,
)
_ADDRESSES: Final = re.compile(r"https?://\S+")


# -- which distributions a bundle imports ----------------------------------------------------------------------------


def imported_names(text: str) -> frozenset[str]:
    """Return the modules that the statements of a module import, also in lines that no sample runs.

    Names that are imported from a module are among them: they may be modules too.
    """
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def requirement_lines(modules: Collection[str]) -> tuple[str, ...]:
    """Return the lines of requirements.txt for modules and what their distributions require: pinned, sorted.

    What EPypes needs itself is not among them, unless a package of the bundle needs it too: it comes with EPypes.
    Names that nothing on this machine has are passed over: the module may have two ways, of which this machine has one.
    """
    # By distribution: those that have overwritten its files, or were overwritten by it.
    twins: dict[str, set[str]] = {_OURS: set()}
    for module in modules:
        owner, *others = _owners(module) or (_OURS,)
        twins.setdefault(owner, set()).update(others)
    waiting = [*twins.keys() - {_OURS}]
    while waiting:
        new = [name for name in _requires(waiting.pop()) if name not in twins]
        twins |= {name: set() for name in new}
        waiting += new
    return tuple(line for name in sorted(twins) for line in _lines(name, twins[name]))


def _requires(name: str) -> Iterator[str]:
    """Give the names of the installed distributions that one requires, without those of its extras."""
    for text in metadata.requires(name) or ():
        with contextlib.suppress(InvalidRequirement, metadata.PackageNotFoundError):
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                yield canonicalize_name(metadata.distribution(requirement.name).name)


@cache
def _owners(module: str) -> tuple[str, ...]:
    """Return the distributions that have brought the file of a module, the one whose files are there now first."""
    top, file = module.partition(".")[0], _file(module)
    if top == _OURS or not file:
        return (_OURS,) if top == _OURS else ()
    candidates = bringing(top)
    if not candidates:
        return tuple(name for folder, name in _editable().items() if _is_in(file, folder))[:1]
    if len(candidates) > 1:
        candidates = tuple(name for name in candidates if file in _files(name)) or candidates
    # Each has overwritten the files of the others; the hashes in its record are of what it had brought.
    return tuple(sorted(candidates, key=lambda name: -_agreeing(name, top) if len(candidates) > 1 else 0))


def bringing(top: str) -> tuple[str, ...]:
    """Return the normalized names of the distributions that bring a top-level module."""
    return _by_module().get(top, ())


@cache
def _by_module() -> dict[str, tuple[str, ...]]:
    # A distribution is listed once for each of its files' folders.
    found = metadata.packages_distributions().items()
    return {top: tuple(sorted({*map(canonicalize_name, names)})) for top, names in found}


def _file(module: str) -> str:
    """Return the file of a module, which is not imported for it; its package is."""
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # it has none, or whatever its package raises
        return ""
    origin = spec.origin if spec else None
    return str(Path(origin).resolve()) if origin and Path(origin).is_file() else ""


def _is_in(file: str, folder: str) -> bool:
    # What is installed into an environment inside the folder is not of the folder.
    return Path(file).is_relative_to(folder) and "site-packages" not in Path(file).relative_to(folder).parts


@cache
def _files(name: str) -> frozenset[str]:
    return frozenset(str(Path(str(path.locate())).resolve()) for path in metadata.files(name) or ())


def _agreeing(name: str, top: str) -> int:
    """Return how many of a distribution's files have the content that it brought."""
    count = 0
    for path in metadata.files(name) or ():
        if path.parts[0] == top and path.hash:
            with contextlib.suppress(OSError):
                content = hashlib.new(path.hash.mode, Path(str(path.locate())).read_bytes()).digest()
                count += base64.urlsafe_b64encode(content).decode().rstrip("=") == path.hash.value
    return count


@cache
def _editable() -> dict[str, str]:
    """Return the distributions that are installed as editable, by folder."""
    found: dict[str, str] = {}
    for distribution in metadata.distributions():
        source = _install_source(distribution)
        if source.get("dir_info", {}).get("editable"):
            found[str(Path(unquote(urlsplit(source["url"]).path)).resolve())] = canonicalize_name(distribution.name)
    return found


def _install_source(distribution: metadata.Distribution) -> dict[str, Any]:
    """Return what PEP 610's direct_url.json says, {} for what comes from an index."""
    try:
        found = json.loads(distribution.read_text("direct_url.json") or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) and isinstance(found.get("url"), str) else {}


def _lines(name: str, twins: Collection[str]) -> Iterator[str]:
    distribution = metadata.distribution(name)
    source = _install_source(distribution)
    if source:
        is_editable = source.get("dir_info", {}).get("editable")
        how = "as editable, from a folder" if is_editable else "from a file or an address"
        yield f"# {distribution.name} was installed {how}, not from an index: install it from there first."
    if "+" in distribution.version:
        yield f"# {distribution.version} is a local version: an index of its own has it."
    if twins:
        both = f"{name} and {', '.join(sorted(twins))} are both installed and overwrite each other"
        yield f"# {both}: uninstall all but one. The files that were loaded are those of {name}."
    yield f"{distribution.name}=={distribution.version}"


def pins(lines: Iterable[str]) -> dict[str, str]:
    """Return the version of each pinned distribution; comments and what is not pinned are passed over."""
    found = (re.fullmatch(r"\s*([\w.-]+)\s*==\s*([^\s;#]+).*", line) for line in lines)
    return {canonicalize_name(pin[1]): pin[2] for pin in found if pin}


# -- a fresh environment ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def fresh_environment(folder: Path) -> Iterator[str]:
    """Make an environment from the requirements of a bundle, give its interpreter, and remove it at the end.

    Raises
    ------
    BundleError
        No environment can be made, or something can't be installed.
    """
    try:
        pinned = pins((folder / REQUIREMENTS).read_text(encoding="utf-8").splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise BundleError(folder, f"{folder / REQUIREMENTS} can't be read: {error}. Promote again.") from error
    with tempfile.TemporaryDirectory(prefix="epypes-fresh-") as scratch:
        home = Path(scratch) / "env"
        python = str(home / "bin" / "python")
        pip = [python, "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
        until = time.monotonic() + INSTALL_TIMEOUT_S
        for what, command in (
            ("A new environment can't be made", [sys.executable, "-I", "-m", "venv", str(home)]),
            ("What requirements.txt names can't be installed", [*pip, *_wanted(pinned)]),
        ):
            _run(folder, what, command, until - time.monotonic())
        yield python


def _wanted(pinned: Mapping[str, str]) -> list[str]:
    """Return what is to be installed, as pip takes it: the pins, EPypes, and what that needs for a replay."""
    named = [_source(name, version) for name, version in pinned.items() if name != _OURS]
    own = {Requirement(text).name: Requirement(text) for text in metadata.requires(_OURS) or ()}
    needed = [f"{name}{own[name].specifier}" for name in _NEEDED if name in own and name not in pinned]
    return [*named, *needed, epypes_source(pinned)]


def epypes_source(pinned: Mapping[str, str]) -> str:
    """Return where to install EPypes from: the checkout that runs now, if it is one, else a requirement."""
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").is_file():
        return str(checkout)
    return _source(_OURS, pinned.get(_OURS, metadata.version(_OURS)))


def _source(name: str, version: str) -> str:
    """Return where to install a distribution from: where it was installed from here, if that was no index."""
    try:
        distribution = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return f"{name}=={version}"
    source = _install_source(distribution)
    # Another version than is installed here can only come from an index; of EPypes it is the one that runs now.
    if not source or (distribution.version != version and name != _OURS):
        return f"{name}=={version}"
    address = urlsplit(source["url"])
    if address.scheme == "file":
        return unquote(address.path)
    commit = source.get("vcs_info", {}).get("commit_id")
    return f"{name} @ {source['vcs_info']['vcs']}+{source['url']}@{commit}" if commit else f"{name} @ {source['url']}"


def _run(folder: Path, what: str, command: list[str], timeout_s: float) -> None:
    """Run a command; raise BundleError with a sentence of why it failed, without the addresses of what it asked."""
    try:
        done = subprocess.run(  # noqa: S603 - venv or pip of this interpreter
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=max(timeout_s, 0.0), check=False
        )
    except subprocess.TimeoutExpired as error:
        text = f"{what} within {INSTALL_TIMEOUT_S:g} s. Try again, or verify without --fresh-env."
        raise BundleError(folder, f"{folder}: {text}") from error
    except OSError as error:
        raise BundleError(folder, f"{folder}: {what}: {error}.") from error
    if done.returncode == 0:
        return
    output = done.stderr.decode(errors="replace")
    if _NO_NETWORK.search(output):
        reason = "no package index answers. Connect to the network, or verify without --fresh-env."
    else:
        # Around its errors, pip lists versions that do not fit and gives general advice.
        errors = [line for line in output.splitlines() if re.match(r"\s*error: (?!Ignored)", line, re.IGNORECASE)]
        text = " ".join(_ADDRESSES.sub("...", " ".join(errors) or output).split()) or "it printed nothing"
        reason = f"{text[:300]}. Mend requirements.txt in a new promotion, or verify without --fresh-env."
    raise BundleError(folder, f"{folder}: {what}: {reason}")
