"""Drafts: folders beside their target, which are swapped into its place in one step."""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

# From Linux's fcntl.h and fs.h.
_AT_FDCWD: Final = -100
_RENAME_EXCHANGE: Final = 2
# What the names of folders end with in which drafts are.
_DRAFTS: Final = ".epypes-draft"


@contextmanager
def draft_folder(target: Path) -> Iterator[Path]:
    """Give the path of a draft beside its target, where the two can be swapped; it is deleted in the end.

    A process that was killed leaves its draft there. The next one to the same target deletes it, once its own is done:
    a folder in use is locked, and the lock ends with the process.
    """
    prefix = f".{target.name[:40]}-"
    with tempfile.TemporaryDirectory(prefix=prefix, suffix=_DRAFTS, dir=target.parent) as scratch, _locked(scratch):
        yield Path(scratch) / target.name
        for folder in target.parent.glob(f".*{_DRAFTS}"):
            # What another process has not locked yet is empty.
            if folder.name.startswith(prefix) and any(folder.iterdir()):
                with _locked(folder) as is_ours:
                    if is_ours:
                        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: str | Path) -> Iterator[bool]:
    """Lock a folder until this process ends, at the latest; give whether that was possible."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_locked = True
    except OSError:  # another process has it, or the file system has no locks
        is_locked = False
    try:
        yield is_locked
    finally:
        os.close(descriptor)


def swap_folders(left: Path, right: Path) -> None:
    """Exchange two folders in one step, which Python has no call for; rename by rename where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    in_one = getattr(libc, "renameat2", None)
    if in_one and in_one(_AT_FDCWD, os.fsencode(left), _AT_FDCWD, os.fsencode(right), _RENAME_EXCHANGE) == 0:
        return
    aside = left.with_name("old")
    right.rename(aside)
    try:
        left.rename(right)
    except OSError:
        aside.rename(right)
        raise
    aside.rename(left)
