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
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from epypes.bundle.manifest import REQUIREMENTS
from epypes.bundle.source.references import is_main_guard
from epypes.errors import BundleError

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


def imported_names(text: str, own: Collection[str] = ()) -> frozenset[str]:
    """Return the modules that the statements of a bundle import, also in lines that no sample runs.

    Names that are imported from a module are among them: they may be modules too. Those of the bundle's ``own``
    packages are not.
    """
    found: set[str] = set()
    tree = ast.parse(text)
    tree.body = [node for node in tree.body if not is_main_guard(node)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(name for name in found if name.partition(".")[0] not in own)


def requirement_lines(modules: Collection[str]) -> tuple[str, ...]:
    """Return the lines of requirements.txt for modules and what their distributions require: pinned, sorted.

    What EPypes needs itself is not among them, unless a package of the bundle needs it too, as OpenCV needs NumPy.
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
    """Give the names of the installed distributions that one requires, without those of its extras.

    pandas computes texts by pyarrow where that is installed, and tables travel by it.
    """
    for text in (*(metadata.requires(name) or ()), *(["pyarrow"] if name == "pandas" else [])):
        with contextlib.suppress(InvalidRequirement, metadata.PackageNotFoundError):
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                yield canonicalize_name(metadata.distribution(requirement.name).name)


@cache
def _owners(module: str) -> tuple[str, ...]:
    """Return the distributions that have brought the file of a module, the one whose files are there now first."""
    top = module.partition(".")[0]
    if top == _OURS:
        return (_OURS,)
    try:
        spec = importlib.util.find_spec(module)  # imports the package of the module, and not the module
    except Exception:  # there is none, or whatever its package raises
        return ()
    file = Path(spec.origin).resolve() if spec and spec.origin else None
    if file is None or not file.is_file():
        return ()
    names = bringing(top) or tuple(name for folder, name in _checkouts() if file.is_relative_to(folder))[:1]
    if len(names) > 1:  # parts of a namespace, or twins, which have overwritten the files of each other
        brought = {name: _files(name, top) for name in names}
        names = tuple(name for name in names if file in brought[name]) or names
        names = tuple(sorted(names, key=lambda name: -_unchanged(brought[name]) if len(names) > 1 else 0))
    return names


def bringing(top: str) -> tuple[str, ...]:
    """Return the normalized names of the distributions that bring a top-level module."""
    return _by_module().get(top, ())


@cache
def _by_module() -> dict[str, tuple[str, ...]]:
    # A distribution is listed once for each of its files' folders.
    found = metadata.packages_distributions().items()
    return {top: tuple(sorted({*map(canonicalize_name, names)})) for top, names in found}


@cache
def _checkouts() -> list[tuple[Path, str]]:
    """Return the folders of the distributions that are installed as editable; no file of theirs is recorded."""
    sources = ((_install_source(distribution), distribution.name) for distribution in metadata.distributions())
    return [
        (Path(unquote(urlsplit(source["url"]).path)).resolve(), canonicalize_name(name))
        for source, name in sources
        if source.get("dir_info", {}).get("editable")
    ]


@cache
def _files(name: str, top: str) -> dict[Path, metadata.FileHash | None]:
    """Return the hashes of the files that a distribution has brought below a top-level module."""
    files = (path for path in metadata.files(name) or () if path.parts[0] == top)
    return {Path(str(path.locate())).resolve(): path.hash for path in files}


def _unchanged(files: Mapping[Path, metadata.FileHash | None]) -> int:
    """Return how many files have the content that their distribution brought."""
    count = 0
    for path, recorded in files.items():
        if recorded and path.is_file():
            content = hashlib.new(recorded.mode, path.read_bytes()).digest()
            count += base64.urlsafe_b64encode(content).decode().rstrip("=") == recorded.value
    return count


def _install_source(distribution: metadata.Distribution) -> dict[str, Any]:
    """Return what PEP 610's direct_url.json says, {} for what comes from an index."""
    return json.loads(distribution.read_text("direct_url.json") or "{}")  # type: ignore[no-any-return]


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


def read_pins(folder: Path) -> dict[str, str]:
    """Return the pins of a bundle's requirements.txt.

    Raises
    ------
    BundleError
        It can't be read.
    """
    try:
        return pins((folder / REQUIREMENTS).read_text(encoding="utf-8").splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise BundleError(folder, f"{folder / REQUIREMENTS} can't be read: {error}. Promote again.") from error


# -- a fresh environment ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def fresh_environment(folder: Path) -> Iterator[str]:
    """Make an environment from the requirements of a bundle, give its interpreter, and remove it at the end.

    Raises
    ------
    BundleError
        No environment can be made, or something can't be installed.
    """
    pinned = read_pins(folder)
    with tempfile.TemporaryDirectory(prefix="epypes-fresh-") as scratch:
        home = Path(scratch) / "env"
        python = str(home / "bin" / "python")
        # Compiling all modules takes longer than the replay, which compiles those that it imports.
        quiet = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-compile"]
        pip = [python, "-I", "-m", "pip", "install", *quiet]
        _run(folder, "A new environment can't be made", [sys.executable, "-I", "-m", "venv", str(home)])
        _run(folder, "What requirements.txt names can't be installed", [*pip, *_wanted(pinned)])
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
    with contextlib.suppress(metadata.PackageNotFoundError):
        distribution = metadata.distribution(name)
        source = _install_source(distribution)
        # Another version than is installed here can only come from an index; of EPypes it is the one that runs now.
        if source and (distribution.version == version or name == _OURS):
            address = urlsplit(source["url"])
            if address.scheme == "file":
                return unquote(address.path)
            vcs = source.get("vcs_info")
            return f"{name} @ {vcs['vcs']}+{source['url']}@{vcs['commit_id']}" if vcs else f"{name} @ {source['url']}"
    return f"{name}=={version}"


def _run(folder: Path, what: str, command: list[str]) -> None:
    """Run a command; raise BundleError with a sentence of why it failed, without the addresses of what it asked."""
    try:
        done = subprocess.run(  # noqa: S603 - venv or pip of this interpreter
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=INSTALL_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        text = f"{what} within {INSTALL_TIMEOUT_S:g} s. Try again, or verify without --fresh-env."
        raise BundleError(folder, f"{folder}: {text}") from error
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
