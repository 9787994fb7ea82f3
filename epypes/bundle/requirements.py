"""Which packages, at which versions, does a bundle need? Those that its replay really imported."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
from collections.abc import Collection, Iterable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

# Distributions that bring the same module: only one of them is to be installed.
_TWINS: Final = (
    frozenset({"opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless"}),
)
_LARGE_BYTES: Final = 4_000_000
_OURS: Final = "epypes"


def owner(name: str) -> str:
    """Return the distribution that a loaded module is of; for any other its top name, as that of Python's own."""
    return _distribution(name) or name.partition(".")[0]


@cache
def _distribution(name: str) -> str:
    """Return the normalized name of the distribution that owns the file of a module; "" if none does."""
    top = name.partition(".")[0]
    if top == _OURS:
        return _OURS
    candidates = _by_module().get(top, ())
    file = _file(name)
    if len(candidates) == 1 and file:
        return candidates[0]
    if not file:
        return ""
    if not candidates:
        return next((found for folder, found in _editable().items() if _is_in(file, folder)), "")
    owners = [found for found in candidates if file in _files(found)]
    return owners[0] if len(owners) == 1 else _loaded_from(owners or candidates, top)


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


def _loaded_from(candidates: Iterable[str], top: str) -> str:
    """Return which of several distributions has brought the files that are there: each has overwritten the others'.

    Their records have the hashes of what they had brought.
    """
    return max(candidates, key=lambda distribution: sum(_agrees(path) for path in _recorded(distribution, top)))


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


def requirement_lines(modules: Collection[str]) -> tuple[str, ...]:
    """Return the lines of requirements.txt for modules that were imported: pinned, sorted, with comments.

    What EPypes needs itself is not among them: it comes with EPypes.
    """
    names = {_distribution(name) for name in modules} - {"", _OURS}
    lines = [line for name in sorted(names | {_OURS}) for line in _lines(name)]
    return tuple(lines)


def _lines(name: str) -> list[str]:
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
    comments += [f"# {text}" for text in twins_of(name)]
    return [*comments, f"{distribution.name}=={distribution.version}"]


def twins_of(name: str) -> list[str]:
    """Return a warning if another distribution that brings the same module is installed beside one."""
    twins = frozenset().union(*(family for family in _TWINS if name in family)) - {name}
    others = sorted(twin for twin in twins if _is_there(twin))
    if not others:
        return []
    text = f"{name} and {', '.join(others)} are both installed and overwrite each other: uninstall all but one."
    return [f"{text} The files that were loaded are those of {name}."]


def _is_there(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def pins(lines: Iterable[str]) -> dict[str, str]:
    """Return the version of each pinned distribution; comments and what is not pinned are passed over."""
    found = (re.fullmatch(r"\s*([\w.-]+)\s*==\s*([^\s;#]+).*", line) for line in lines)
    return {normalized(pin[1]): pin[2] for pin in found if pin}
