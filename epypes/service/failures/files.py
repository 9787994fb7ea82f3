"""How does a folder hold failures: a record as JSON and, beside it, the event as it came?

Every file appears whole or not at all, under a name that tells its place in time. What others put into the folder is
left alone. What can't be read is raised here, and counted by whoever asked.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from epypes.errors import FailureNotKept, UnknownName
from epypes.service.failures.record import ID, FailureRecord, record_of

_RECORD, _EVENT, _PART = ".json", ".event", ".part"
# Larger ones were not written here.
_MOST_RECORD_BYTES: Final = 16 * 1024**2
# What a process that was killed has begun and no other can be writing any more.
_OLD_S: Final = 600.0
# Of one cause so many first ones are kept for as long as there are others to remove.
_FIRST: Final = 3


@dataclass(frozen=True, slots=True)
class Entry:
    """One failure in the folder: its id, whether it has a record, and the bytes of its files."""

    id: str
    has_record: bool
    size: int


def entries(folder: Path) -> list[Entry]:
    """Return what the folder holds, the oldest first; nothing if there is no folder.

    Raises
    ------
    OSError
        It can't be read.
    """
    sizes: dict[str, dict[str, int]] = {}
    try:
        with os.scandir(folder) as found:
            for file in found:
                stem, _, ending = file.name.partition(".")
                if ID.fullmatch(stem) and f".{ending}" in (_RECORD, _EVENT):
                    with contextlib.suppress(FileNotFoundError):  # another service has just removed it
                        sizes.setdefault(stem, {})[f".{ending}"] = file.stat(follow_symlinks=False).st_size
    except FileNotFoundError:
        return []
    return [Entry(name, _RECORD in files, sum(files.values())) for name, files in sorted(sizes.items())]


def write(folder: Path, record: FailureRecord, event: bytes | None) -> int:
    """Write a failure, its event first: a record that says so has its event. Return how many bytes that took.

    Raises
    ------
    OSError
        It can't be written: the disk is full, or the folder read-only.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    told: dict[str, Any] = {"record": asdict(record)}
    if event is not None:
        told["event"] = {"bytes": len(event), "sha256": hashlib.sha256(event).hexdigest()}
    text = json.dumps(told, default=str, indent=1).encode()
    try:
        if event is not None:
            _put(folder, record.id + _EVENT, event)
        _put(folder, record.id + _RECORD, text)
    except OSError:
        remove(folder, record.id)
        raise
    return len(text) + len(event or b"")


def _put(folder: Path, name: str, data: bytes) -> None:
    """Write a file under another name first, so that nobody ever sees half of it."""
    part = folder / f".{name}.{os.getpid()}{_PART}"
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
        part.replace(folder / name)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def remove(folder: Path, failure_id: str) -> None:
    """Remove a failure, its record first. What can't be removed stays."""
    for ending in (_RECORD, _EVENT):
        with contextlib.suppress(OSError):
            (folder / f"{failure_id}{ending}").unlink()


def sweep(folder: Path) -> None:
    """Remove what processes that were killed have left: parts of files, and events without a record."""
    before_s = time.time() - _OLD_S
    with contextlib.suppress(OSError):
        for part in folder.glob(f".*{_PART}"):
            _remove_old(part, before_s)
        for entry in entries(folder):
            if not entry.has_record:
                _remove_old(folder / f"{entry.id}{_EVENT}", before_s)


def _remove_old(file: Path, before_s: float) -> None:
    with contextlib.suppress(OSError):
        if file.lstat().st_mtime < before_s:
            file.unlink()


def read_record(folder: Path, failure_id: str) -> FailureRecord:
    """Return the record of a failure.

    Raises
    ------
    UnknownName
        There is none with this id; the nearest is named.
    FailureNotKept
        It can't be read.
    """
    return record_of(_told(folder, failure_id)["record"])


def read_event(folder: Path, failure_id: str) -> bytes:
    """Return the packed event of a failure.

    Raises
    ------
    UnknownName
        There is no failure with this id.
    FailureNotKept
        Its event was not kept, or is not the one any more that was.
    """
    told = _told(folder, failure_id)
    record, about = record_of(told["record"]), told.get("event")
    if not isinstance(about, Mapping):
        raise FailureNotKept(failure_id, folder, f"The event of failure {failure_id} was not kept: {why_not(record)}.")
    path = folder / f"{failure_id}{_EVENT}"
    try:
        if path.stat().st_size != about.get("bytes"):
            raise _damaged(failure_id, path, "it has another size than was written")
        data = path.read_bytes()
    except OSError as error:
        raise _damaged(failure_id, path, error.strerror or "it can't be read") from error
    if hashlib.sha256(data).hexdigest() != about.get("sha256"):
        raise _damaged(failure_id, path, "it is not what was written")
    return data


def why_not(record: FailureRecord) -> str:
    """Return why an event was not kept."""
    return record.no_event or "the service had none to give"


def _told(folder: Path, failure_id: str) -> dict[str, Any]:
    """Return what stands in a failure's JSON, in which a readable record is."""
    path = folder / f"{failure_id}{_RECORD}"
    if not ID.fullmatch(failure_id) or not path.exists():
        known = [entry.id for entry in entries(folder) if entry.has_record]
        raise UnknownName("failure", failure_id, reversed(known), f"in {folder}")
    try:
        if path.stat().st_size > _MOST_RECORD_BYTES:
            raise ValueError("it is too large")
        told = json.loads(path.read_bytes())
        record = record_of(told["record"])
        if record.id != failure_id:
            raise ValueError(f"it is the record of {record.id}")
    except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise _damaged(failure_id, path, str(getattr(error, "strerror", None) or error)) from error
    found: dict[str, Any] = told
    return found


def _damaged(failure_id: str, path: Path, reason: str) -> FailureNotKept:
    return FailureNotKept(failure_id, path, f"{path} can't be read: {reason}. Remove it, or restore it.")


def to_remove(present: Sequence[Entry], causes: Mapping[str, object], most: int, most_bytes: int) -> Iterable[str]:
    """Yield which failures have to go until no more than ``most`` of ``most_bytes`` together are left.

    Those that are damaged go first. Then the cause that has the most loses the oldest behind its first ones: a storm
    leaves the other failures alone, and how it began can be seen.

    Parameters
    ----------
    present
        The oldest first.
    causes
        By id; None of one that is damaged.
    """
    left = dict.fromkeys(present)
    counts = Counter(causes[entry.id] for entry in left)
    size = sum(entry.size for entry in left)
    while left and (len(left) > most or size > most_bytes):
        entry = _next_to_go(left, causes, counts)
        del left[entry]
        counts[causes[entry.id]] -= 1
        size -= entry.size
        yield entry.id


def _next_to_go(left: Iterable[Entry], causes: Mapping[str, object], counts: Counter[object]) -> Entry:
    if counts[None]:
        return next(entry for entry in left if causes[entry.id] is None)
    cause, count = counts.most_common(1)[0]
    if count <= _FIRST:
        return next(iter(left))
    return [entry for entry in left if causes[entry.id] == cause][_FIRST]
