"""Is every byte of a bundle the one that was promoted?"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from epypes.errors import BundleError

MANIFEST: Final = "MANIFEST.sha256"


def seal(folder: Path) -> str:
    """Write the manifest, in the format of ``sha256sum``; return the bundle's digest."""
    lines = [f"{_hash(folder / name)}  {name}\n" for name in _files(folder)]
    (folder / MANIFEST).write_text("".join(lines), encoding="utf-8")
    return digest(folder)


def digest(folder: Path) -> str:
    """Return the SHA-256 of the manifest, which stands for the whole bundle."""
    return _hash(folder / MANIFEST)


def check_seal(folder: Path) -> str:
    """Compare every file with the manifest; return the bundle's digest.

    Raises
    ------
    BundleError
        There is no bundle, or a file was changed, is missing or was added; all of them are named.
    """
    if not (folder / MANIFEST).is_file():
        raise BundleError(folder, _no_bundle(folder))
    recorded = _read_manifest(folder)
    present = set(_files(folder))
    findings = [f"{name} is missing" for name in recorded if name not in present]
    findings += [f"{name} was added" for name in sorted(present - recorded.keys())]
    findings += [
        f"{name} was changed" for name, value in recorded.items() if name in present and _hash(folder / name) != value
    ]
    if findings:
        text = f"{folder} is not what was promoted: {'; '.join(findings)}. Restore it, or promote again."
        raise BundleError(folder, text)
    return digest(folder)


def _no_bundle(folder: Path) -> str:
    if folder.is_dir():
        return f"{folder} is not a bundle: it has no {MANIFEST}. Name the folder that epypes promote wrote."
    if folder.exists():
        return f"{folder} is a file. Name the folder of a bundle, which epypes promote writes."
    return f"{folder} does not exist. Make a bundle with: epypes promote NOTEBOOK --to {folder}"


def _read_manifest(folder: Path) -> dict[str, str]:
    recorded: dict[str, str] = {}
    try:
        for line in (folder / MANIFEST).read_text(encoding="utf-8").splitlines():
            value, name = line.split("  ", 1)
            recorded[name] = value
    except (ValueError, UnicodeDecodeError) as error:
        raise BundleError(folder, f"{folder / MANIFEST} can't be read: {error}. Promote again.") from error
    return recorded


def _files(folder: Path) -> list[str]:
    """Return everything but folders and the manifest; bytecode, which is never read, does not count.

    Raises
    ------
    BundleError
        There is a link, or something else that is neither a file nor a folder.
    """
    found = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise BundleError(folder, f"{folder} holds {name}, which is not a plain file. Remove it.")
        if path.is_file() and name != MANIFEST and "__pycache__" not in path.relative_to(folder).parts:
            found.append(name)
    return found


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
