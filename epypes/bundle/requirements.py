"""The packages of a bundle: those that its replay imports, their pins, and a fresh environment made of them."""

from __future__ import annotations

import ast
import base64
import contextlib
import hashlib
import importlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from epypes.errors import BundleError

REQUIREMENTS: Final = "requirements.txt"
INSTALL_TIMEOUT_S: Final = 1200.0
_LARGE_BYTES: Final = 4_000_000
_OURS: Final = "epypes"
# What EPypes needs to read samples; the rest of what it needs is for serving.
_NEEDED: Final = ("numpy", "protobuf")
_NO_NETWORK: Final = re.compile(
    r"dns error|name resolution|failed to fetch|connection (refused|error|reset)|newconnectionerror|"
    r"network is unreachable|tunneling|timed out|offline",
    re.IGNORECASE,
)
# uv keeps the wheels that it has built of folders, also when their code has changed.
_REFRESHED: Final = ("--refresh-package", _OURS)
_ADDRESSES: Final = re.compile(r"https?://\S+")


# -- which distributions a bundle imports ----------------------------------------------------------------------------


def import_all_of(text: str) -> frozenset[str]:
    """Import what the statements of a module name, also those that no sample has come to; return the modules.

    What can't be imported is passed over: the module may have two ways, of which this machine has one.
    """
    named: list[tuple[str, tuple[str, ...]]] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            named += ((alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            named.append((node.module, tuple(alias.name for alias in node.names)))
    for module, items in named:
        with contextlib.suppress(Exception):
            __import__(module, fromlist=items)
    found = {module for module, _ in named} | {f"{module}.{item}" for module, items in named for item in items}
    return frozenset(found & sys.modules.keys())


def requirement_lines(modules: Collection[str]) -> tuple[str, ...]:
    """Return the lines of requirements.txt for modules that were imported: pinned, sorted, with comments.

    What EPypes needs itself is not among them, unless a package of the bundle needs it too: it comes with EPypes.
    """
    names = {_distribution(name) for name in modules} - {"", _OURS}
    waiting = [*names]
    while waiting:
        new = {name for name in _requires(waiting.pop()) if _is_loaded(name)} - names
        names |= new
        waiting += new
    twins: dict[str, set[str]] = {}
    for module in modules:
        twins.setdefault(_distribution(module), set()).update(_owners(module))
    return tuple(line for name in sorted(names | {_OURS}) for line in _lines(name, twins.get(name, set()) - {name}))


def _requires(name: str) -> Iterator[str]:
    """Give the names of the distributions that one needs, without those of its extras."""
    for requirement in metadata.requires(name) or ():
        text, _, marker = requirement.partition(";")
        if "extra" not in marker:
            yield normalized(re.split(r"[^\w.-]", text.strip(), maxsplit=1)[0])


def _is_loaded(distribution: str) -> bool:
    return any(distribution in found for top, found in _by_module().items() if top in sys.modules)


@cache
def _distribution(name: str) -> str:
    """Return the normalized name of the distribution that owns the file of a module; "" if none does."""
    top = name.partition(".")[0]
    if top == _OURS:
        return _OURS
    candidates, file = bringing(top), _file(name)
    if not file:
        return ""
    if not candidates:
        return next((found for folder, found in _editable().items() if _is_in(file, folder)), "")
    # Each has overwritten the files of the others; the hashes in its record are of what it had brought.
    return max(_owners(name) or candidates, key=lambda owner: sum(map(_agrees, _recorded(owner, top))))


@cache
def _owners(name: str) -> tuple[str, ...]:
    """Return the distributions that have brought the file of a module; more than one if they overwrite each other."""
    candidates, file = bringing(name.partition(".")[0]), _file(name)
    if len(candidates) == 1 or not file:
        return candidates if file else ()
    return tuple(found for found in candidates if file in _files(found))


def bringing(top: str) -> tuple[str, ...]:
    """Return the normalized names of the distributions that bring a top-level module."""
    return tuple(_by_module().get(top, ()))


@cache
def _by_module() -> dict[str, list[str]]:
    # A distribution is listed once for each of its files' folders.
    return {name: sorted({*map(normalized, found)}) for name, found in metadata.packages_distributions().items()}


def normalized(name: str) -> str:
    """Return the name of a distribution as it is compared: lower case, with single dashes."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _file(name: str) -> str:
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None) or getattr(getattr(module, "__spec__", None), "origin", None)
    return str(Path(file).resolve()) if isinstance(file, str) and Path(file).is_file() else ""


def _is_in(file: str, folder: str) -> bool:
    # What is installed into an environment inside the folder is not of the folder.
    return Path(file).is_relative_to(folder) and "site-packages" not in Path(file).relative_to(folder).parts


@cache
def _files(distribution: str) -> frozenset[str]:
    return frozenset(str(Path(str(path.locate())).resolve()) for path in metadata.files(distribution) or ())


def _recorded(distribution: str, top: str) -> list[Any]:
    paths = metadata.files(distribution) or ()
    return [path for path in paths if path.parts[0] == top and path.hash and (path.size or 0) < _LARGE_BYTES]


def _agrees(path: Any) -> bool:
    try:
        content = Path(str(path.locate())).read_bytes()
    except OSError:
        return False
    made = base64.urlsafe_b64encode(hashlib.new(path.hash.mode, content).digest()).decode().rstrip("=")
    return bool(made == path.hash.value)


@cache
def _editable() -> dict[str, str]:
    """Return which distribution is installed as editable from which folder."""
    found = {}
    for distribution in metadata.distributions():
        source = install_source(distribution)
        if source.get("dir_info", {}).get("editable"):
            found[str(Path(unquote(urlsplit(source["url"]).path)).resolve())] = normalized(distribution.name)
    return found


def install_source(distribution: metadata.Distribution) -> dict[str, Any]:
    """Return what PEP 610's direct_url.json says, {} for what comes from an index."""
    try:
        found = json.loads(distribution.read_text("direct_url.json") or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) and isinstance(found.get("url"), str) else {}


def _lines(name: str, twins: Collection[str]) -> list[str]:
    distribution = metadata.distribution(name)
    comments = []
    source = install_source(distribution)
    if source:
        how = (
            "as editable, from a folder" if source.get("dir_info", {}).get("editable") else "from a file or an address"
        )
        comments.append(f"# {distribution.name} was installed {how}, not from an index: install it from there first.")
    if "+" in distribution.version:
        comments.append(f"# {distribution.version} is a local version: an index of its own has it.")
    if twins:
        both = f"{name} and {', '.join(sorted(twins))} are both installed and overwrite each other"
        comments.append(f"# {both}: uninstall all but one. The files that were loaded are those of {name}.")
    return [*comments, f"{distribution.name}=={distribution.version}"]


def pins(lines: Iterable[str]) -> dict[str, str]:
    """Return the version of each pinned distribution; comments and what is not pinned are passed over."""
    found = (re.fullmatch(r"\s*([\w.-]+)\s*==\s*([^\s;#]+).*", line) for line in lines)
    return {normalized(pin[1]): pin[2] for pin in found if pin}


# -- a fresh environment ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def fresh_environment(folder: Path) -> Iterator[str]:
    """Make an environment from the requirements of a bundle, give its interpreter, and remove it at the end.

    Raises
    ------
    BundleError
        No environment can be made, or something can't be installed.
    """
    with tempfile.TemporaryDirectory(prefix="epypes-fresh-") as scratch:
        home = Path(scratch) / "env"
        until = time.monotonic() + INSTALL_TIMEOUT_S
        for what, command in _steps(home, _wanted(folder)):
            _run(folder, what, command, until - time.monotonic())
        yield str(home / "bin" / "python")


def _wanted(folder: Path) -> list[str]:
    """Return what is to be installed, as pip takes it: the pins, EPypes, and what that needs for a replay."""
    try:
        lines = (folder / REQUIREMENTS).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BundleError(folder, f"{folder / REQUIREMENTS} can't be read: {error}. Promote again.") from error
    pinned = pins(lines)
    named = [_source(name, version) for name, version in pinned.items() if name != _OURS]
    needed = [requirement for name, requirement in _own_needs().items() if name not in pinned]
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
    source = install_source(distribution)
    # Another version than is installed here can only come from an index; of EPypes it is the one that runs now.
    if not source or (distribution.version != version and name != _OURS):
        return f"{name}=={version}"
    address = urlsplit(source["url"])
    if address.scheme == "file":
        return unquote(address.path)
    commit = source.get("vcs_info", {}).get("commit_id")
    return f"{name} @ {source['vcs_info']['vcs']}+{source['url']}@{commit}" if commit else f"{name} @ {source['url']}"


def _own_needs() -> dict[str, str]:
    """Return the requirements of EPypes' own that a replay needs, without their markers, by name."""
    texts = [requirement.partition(";")[0].strip() for requirement in metadata.requires(_OURS) or ()]
    by_name = {normalized(re.split(r"[^\w.-]", text, maxsplit=1)[0]): text for text in reversed(texts)}
    return {name: by_name[name] for name in _NEEDED if name in by_name}


def _steps(home: Path, wanted: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the commands that make the environment, each with what it does: uv where it is, else venv and pip."""
    python = str(home / "bin" / "python")
    made, installed = "A new environment can't be made", "What requirements.txt names can't be installed"
    uv = uv_command()
    if uv:
        return [
            (made, [*uv, "venv", "--quiet", "--no-project", "--python", sys.executable, str(home)]),
            (installed, [*uv, "pip", "install", "--quiet", *_REFRESHED, "--python", python, *wanted]),
        ]
    pip = [python, "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
    return [(made, [sys.executable, "-I", "-m", "venv", str(home)]), (installed, [*pip, *wanted])]


def uv_command() -> list[str]:
    """Return how uv is called on this machine; empty if it is not there."""
    if importlib.util.find_spec("uv"):
        return [sys.executable, "-m", "uv"]
    path = shutil.which("uv")
    return [path] if path else []


def _run(folder: Path, what: str, command: Sequence[str], timeout_s: float) -> None:
    try:
        done = subprocess.run(  # noqa: S603 - uv, venv or pip of this interpreter
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=max(timeout_s, 0.0), check=False
        )
    except subprocess.TimeoutExpired as error:
        text = f"{what} within {INSTALL_TIMEOUT_S:g} s. Try again, or verify without --fresh-env."
        raise BundleError(folder, f"{folder}: {text}") from error
    except OSError as error:
        raise BundleError(folder, f"{folder}: {what}: {error}.") from error
    if done.returncode != 0:
        raise BundleError(folder, f"{folder}: {_reason(what, done.stderr.decode(errors='replace'))}")


def _reason(what: str, output: str) -> str:
    """Return in one sentence why a command failed, without the addresses of what it asked."""
    if _NO_NETWORK.search(output):
        return f"{what}: no package index answers. Connect to the network, or verify without --fresh-env."
    text = " ".join(_ADDRESSES.sub("...", output).split()) or "it printed nothing"
    return f"{what}: {text[:300]}. Mend requirements.txt in a new promotion, or verify without --fresh-env."
