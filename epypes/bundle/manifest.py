"""The manifest of a bundle: a digest of every file, the lines that were changed since, and what it was recorded on.

The manifest can be checked by ``sha256sum --check MANIFEST.sha256``, which passes over its comments. They name what the
samples were recorded with, so that a replay that differs can be explained. It is no signature: it shows accidents and
careless changes, and a program that can write the files can write the manifest anew.

A bundle holds regular files only. A FIFO, a device or a link is refused before anything is read, since opening a FIFO
blocks, a device has no end, and a link leads out of the folder.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import importlib.util
import os
import platform
import stat
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from epypes.errors import BundleChanged, BundleError, InvalidValue

# The files of a bundle.
MODULE: Final = "pipeline.py"
SETTINGS: Final = "pipeline.toml"
SAMPLES: Final = "samples"
# The folder of the modules of the user's project.
OWN_MODULES: Final = "modules"
REQUIREMENTS: Final = "requirements.txt"
MANIFEST: Final = "MANIFEST.sha256"
_TEXTS: Final = (MODULE, SETTINGS, REQUIREMENTS)
# What a comment of the manifest begins with.
_FACT: Final = "# "
_LINES: Final = "lines of "
# Bounds on what is read and hashed of a folder that may be anything. Samples and weights are large, text is not.
MOST_BYTES: Final = 8 * 1024**3
MOST_FILES: Final = 10_000
_MOST_TEXT_MB: Final = 64


def write_manifest(folder: Path, environment: Mapping[str, str] | None = None) -> str:
    """Write the manifest, in the format of ``sha256sum``; return the bundle's digest.

    Parameters
    ----------
    folder
        The bundle.
    environment
        What its samples have been recorded on; without, those of the manifest before stay.
    """
    names = bundle_files(folder)
    facts = dict(recorded_environment(folder) if environment is None else environment)
    facts |= {f"{_LINES}{name}": _sums(folder / name) for name in names if _is_text(name)}
    lines = [f"{_FACT}{name}: {value}\n" for name, value in facts.items()]
    lines += [f"{_hash(folder / name)}  {name}\n" for name in names]
    (folder / MANIFEST).write_text("".join(lines), encoding="utf-8")
    return digest(folder)


def digest(folder: Path) -> str:
    """Return the SHA-256 of the manifest, which stands for the whole bundle."""
    return _hash(folder / MANIFEST)


def check_manifest(folder: Path) -> str:
    """Compare every file with the manifest; return the bundle's digest.

    Raises
    ------
    BundleChanged
        A file was changed, is missing or was added; all of them are named.
    BundleError
        There is no bundle, or something in it is not a regular file or is too large.
    """
    if not os.path.lexists(folder / MANIFEST):
        if folder.is_dir():
            text = f"{folder} is not a bundle: it has no {MANIFEST}. Name the folder that epypes promote wrote."
        elif folder.exists():
            text = f"{folder} is a file. Name the folder of a bundle, which epypes promote writes."
        else:
            text = f"{folder} does not exist. Make a bundle with: epypes promote NOTEBOOK --to {folder}"
        raise BundleError(folder, text)
    present = bundle_files(folder)
    recorded, facts = _read_manifest(folder)
    findings = [f"{name} is missing" for name in recorded if name not in present]
    findings += [f"{name} was added" for name in present if name not in recorded]
    findings += [
        f"{name} was changed{_changed_line(folder / name, facts.get(_LINES + name))}"
        for name, value in recorded.items()
        if name in present and _hash(folder / name) != value
    ]
    if findings:
        text = f"{folder} is not what was promoted: {'; '.join(findings)}. Restore it, or promote again."
        raise BundleChanged(folder, text)
    return digest(folder)


def why_no_bundle(folder: Path) -> str:
    """Return as a sentence why a folder is not a bundle and nothing else; "" if it is.

    A file that was changed or removed since is no reason; one that the manifest does not name is the user's own.
    """
    try:
        present, (recorded, _) = bundle_files(folder), _read_manifest(folder)
    except BundleError as error:
        return f"{folder} exists and is not a bundle: {error}"
    if not {MODULE, SETTINGS} <= recorded.keys():
        return f"{folder} exists and is not a bundle."
    foreign = [name for name in present if name not in recorded]
    return f"{folder} has files that are not the bundle's: {', '.join(foreign):.200}." if foreign else ""


def recorded_environment(folder: Path) -> dict[str, str]:
    """Return what the samples of a bundle were recorded on; nothing without a manifest."""
    facts = _read_manifest(folder)[1] if os.path.lexists(folder / MANIFEST) else {}
    return {name: value for name, value in facts.items() if not name.startswith(_LINES)}


def _sums(path: Path) -> str:
    """Return four hexadecimal digits for each line: enough to find the one that was changed."""
    return " ".join(f"{zlib.crc32(line) & 0xFFFF:04x}" for line in path.read_bytes().splitlines())


def _changed_line(path: Path, sums: str | None) -> str:
    """Return where a text was changed first, as ``" at line 3: ..."``; "" if that is not known."""
    if sums is None:
        return ""
    matcher = difflib.SequenceMatcher(None, sums.split(), _sums(path).split(), autojunk=False)
    for what, first, _, at, _ in matcher.get_opcodes():
        if what == "delete":
            return f", where line {first + 1} is missing"
        if what != "equal":
            return f" at line {at + 1}: {path.read_bytes().splitlines()[at].decode(errors='replace').strip():.80}"
    return ""


def _read_manifest(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return the digests of a manifest by file, and the facts in its comments by name."""
    path = folder / MANIFEST
    recorded: dict[str, str] = {}
    facts: dict[str, str] = {}
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith(_FACT):
                name, _, value = line.removeprefix(_FACT).partition(": ")
                facts[name] = value
                continue
            value, spaces, name = line.partition("  ")
            if not spaces:
                raise InvalidValue(f"{line!r:.60} is no line of it")
            if recorded.setdefault(name, value) != value:
                raise InvalidValue(f"it has two digests for {name!r}")
    except (OSError, ValueError) as error:
        raise BundleError(folder, f"{path} can't be read: {error}. Promote again.") from error
    return recorded, facts


def bundle_files(folder: Path) -> list[str]:
    """Return the names of a bundle's files, sorted: all but the manifest, and bytecode, which is never read.

    Raises
    ------
    BundleError
        There is a link, something else that is neither a file nor a folder, or more than a bundle may hold.
    """
    found, total_bytes = [], 0
    for number, path in enumerate(folder.rglob("*"), 1):
        if number > MOST_FILES:
            raise BundleError(folder, f"{folder} holds more than {MOST_FILES:,} files. It is no bundle.")
        status, name = path.lstat(), path.relative_to(folder)
        if stat.S_ISDIR(status.st_mode):
            continue
        if not stat.S_ISREG(status.st_mode):
            raise BundleError(folder, f"{folder} holds {name}, which is not a plain file. Remove it.")
        if (_is_text(name.as_posix()) or name.as_posix() == MANIFEST) and status.st_size > _MOST_TEXT_MB * 1024**2:
            text = f"{path} is larger than {_MOST_TEXT_MB} MB, which no text of a bundle is. Promote again."
            raise BundleError(folder, text)
        total_bytes += status.st_size
        if total_bytes > MOST_BYTES:
            limit = f"{MOST_BYTES // 1024**3} GB"
            raise BundleError(folder, f"{folder} holds more than {limit}, up to {name}. Store large data elsewhere.")
        if name.as_posix() != MANIFEST and not (name.parent.name == "__pycache__" and ".pyc" in name.suffixes):
            found.append(name)
    return [name.as_posix() for name in sorted(found)]


def _is_text(name: str) -> bool:
    return name in _TEXTS or is_module(name)


def is_module(name: str) -> bool:
    """Whether a file of a bundle, by its name there, is Python code."""
    return name == MODULE or (name.startswith(f"{OWN_MODULES}/") and name.endswith(".py"))


def module_files(folder: Path) -> list[Path]:
    """Return the files of a bundle that are Python code: ``pipeline.py`` and the modules of the user's project."""
    return [folder / MODULE, *sorted((folder / OWN_MODULES).rglob("*.py"))]


def code_of(folder: Path) -> str:
    """Return the text of all Python code of a bundle, one file after another, to look for names and imports in it."""
    return "\n".join(importlib.util.decode_source(file.read_bytes()) for file in module_files(folder))


def own_packages(folder: Path) -> frozenset[str]:
    """Return the outermost packages and modules of the user's project that a bundle has."""
    return frozenset(path.name.removesuffix(".py") for path in (folder / OWN_MODULES).glob("*"))


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# How each difference is named, by the name of what differs.
_DIFFERENCES: Final = {
    "python": "another Python",
    "platform": "another platform",
    "processor": "another processor",
    "opencv": "another build of OpenCV",
    "opencv processor features": "a processor of which OpenCV uses other features",
    "opencv threads": "another number of threads of OpenCV",
}


def environment() -> dict[str, str]:
    """Return Python, platform and processor; and OpenCV's build, features and threads where it is imported."""
    facts = {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }
    cv2 = sys.modules.get("cv2")
    if cv2 is not None:
        build = hashlib.sha256(cv2.getBuildInformation().encode()).hexdigest()[:12]
        facts["opencv"] = f"{cv2.__version__} {build}"
        facts["opencv processor features"] = cv2.getCPUFeaturesLine()
        facts["opencv threads"] = str(cv2.getNumThreads())
    return {name: " ".join(value.split()) for name, value in facts.items()}


def _processor() -> str:
    """Return the processor's model, which Python does not know on Linux."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or f"{os.cpu_count()} of unknown kind"


def environment_differences(recorded: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return as sentences what is not as it was when the samples were recorded."""
    return [
        f"It was recorded on {what}: {recorded[name]}, here it is {now[name]}."
        for name, what in _DIFFERENCES.items()
        if name in recorded and name in now and recorded[name] != now[name]
    ]
