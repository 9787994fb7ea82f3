"""A folder of failures: a record as JSON and, beside it, the event as it came.

A thread of its own writes, so that no caller waits for a disk; what is wrong with the disk is counted, and logged once
a minute. Every file appears whole or not at all, under a name that tells its place in time. Files of others in the
folder are left alone. Several stores, also of other processes, may use one folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import EpypesError, FailureNotKept, UnknownName
from epypes.service.failures.record import ID, FailureRecord, read_record, with_id
from epypes.store.writer import Writer

if TYPE_CHECKING:
    from epypes.wire import EncodedEnvelope, Envelope

__all__ = ["FailureRecord", "FailureStore", "failures_folder"]

_log = logging.getLogger("epypes.service")

_MAX_FAILURES: Final = 100
_MAX_BYTES: Final = 256 * 1024**2
# The share of all bytes that one event may take; a larger one would push out too many others.
_EVENT_SHARE: Final = 0.25
_RECORD, _EVENT, _PART = ".json", ".event", ".part"
# Larger records were not written here.
_MAX_RECORD_BYTES: Final = 16 * 1024**2
# Older parts of files are those of a process that was killed.
_PART_AGE_S: Final = 600.0
# Of one cause so many first failures are kept for as long as there are others to remove.
_FIRST: Final = 3
_COUNTED: Final = ("kept", "skipped", "removed", "without_event", "unwritten", "unreadable")
_LOG_PAUSE_S: Final = 60.0

# Of one cause, so many failures are written at once, then one each second.
_BURST: Final = 10
_PER_S: Final = 1.0
# What waits is in memory, with its images.
_MAX_WAITING: Final = 20
_MAX_CAUSES: Final = 16


def failures_folder(bundle: str | Path) -> Path:
    """Return the folder for the failures of a bundle's service: one of this user's, not in the bundle."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    name = hashlib.sha256(str(Path(bundle).resolve()).encode()).hexdigest()[:20]
    return Path(state) / "epypes" / "failures" / name


# -- the pace ---------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Bucket:
    """A token bucket of one cause: how many failures may be written now, and the newest that may not."""

    left: float
    at_s: float
    latest: Any = None

    def fill(self, now_s: float, burst: int) -> None:
        self.left = min(self.left + (now_s - self.at_s) * _PER_S, burst)
        self.at_s = now_s


class _Throttle:
    """The failures that wait to be written: the first of each cause, then the newest whenever one is due.

    A camera with black frames fails thirty times a second, always alike: to write down each failure would take the disk
    from other processes, and push out the one failure that is different. `Writer` holds its lock around all methods,
    and gives the time in seconds on a monotonic clock.
    """

    def __init__(self, burst: int) -> None:
        self._burst = burst
        self._first: deque[Any] = deque()
        self._buckets: OrderedDict[Hashable, _Bucket] = OrderedDict()

    def __len__(self) -> int:
        return len(self._first) + sum(bucket.latest is not None for bucket in self._buckets.values())

    def add(self, cause: Hashable, item: Any, now_s: float) -> int:
        """Add a failure; return how many were dropped for it."""
        dropped = 0
        if cause not in self._buckets and len(self._buckets) >= _MAX_CAUSES:
            _, oldest = self._buckets.popitem(last=False)
            dropped += oldest.latest is not None
        bucket = self._buckets.setdefault(cause, _Bucket(self._burst, now_s))
        self._buckets.move_to_end(cause)
        bucket.fill(now_s, self._burst)
        if bucket.left >= 1 and len(self._first) < _MAX_WAITING:
            bucket.left -= 1
            self._first.append(item)
            return dropped
        dropped += bucket.latest is not None
        bucket.latest = item
        return dropped

    def take(self, now_s: float, *, at_once: bool = False) -> Any:
        """Return what is to be written now, None if nothing is; ``at_once`` does not wait until something is due."""
        if self._first:
            return self._first.popleft()
        for bucket in self._buckets.values():
            bucket.fill(now_s, self._burst)
            if bucket.latest is not None and (at_once or bucket.left >= 1):
                bucket.left = max(bucket.left - 1, 0.0)
                found, bucket.latest = bucket.latest, None
                return found
        return None

    def due_in_s(self, now_s: float) -> float | None:
        """Return in how many seconds the next is to be written; None if nothing waits."""
        if self._first:
            return 0.0
        waiting = [bucket for bucket in self._buckets.values() if bucket.latest is not None]
        return min((max((1 - each.left) / _PER_S - (now_s - each.at_s), 0.0) for each in waiting), default=None)


# -- the store --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Stored:
    """One failure in the folder: its id, whether it has a record, and the bytes of its files."""

    id: str
    has_record: bool
    size: int


class FailureStore:
    """The last failures of a service, each with the event that failed, in a folder.

    Parameters
    ----------
    folder
        Made when there is something to keep. Several stores, also of other processes, may use one.
    most
        How many failures are kept.
    most_bytes
        How many bytes all of them may take. An event of more than a quarter of it is not kept, and its record says so.
    burst
        How many failures of one cause are kept one right after the other; of a storm's others the newest in a second.

    Notes
    -----
    Any thread may use it. Nothing about a disk is raised by `keep`: `counts` has it. Reading needs no `keep` before.
    """

    def __init__(
        self, folder: str | Path, *, most: int = _MAX_FAILURES, most_bytes: int = _MAX_BYTES, burst: int = _BURST
    ) -> None:
        self.folder = Path(folder)
        self._most, self._most_bytes = most, most_bytes
        self._throttle = _Throttle(burst)
        self._writer = Writer("epypes failures", self._throttle, lambda item: self._write(*item), self._sweep)
        self._lock = threading.Lock()
        self._counts = Counter(dict.fromkeys(_COUNTED, 0))
        self._causes: dict[str, object] = {}
        self._logged_s, self._unlogged = -_LOG_PAUSE_S, 0

    # -- keeping ------------------------------------------------------------------------------------------------

    def keep(self, record: FailureRecord, event: Envelope | EncodedEnvelope | bytes | None = None) -> FailureRecord:
        """Keep a failure; return its record with the id that it has got.

        Returns at once and raises nothing. The event's arrays must not change any more.
        """
        record = with_id(record)
        self._count("skipped", self._writer.put(lambda now_s: self._throttle.add(record.cause, (record, event), now_s)))
        return record

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Write all that waits now; return whether that was done in time."""
        return self._writer.flush(timeout_s)

    def counts(self) -> dict[str, int]:
        """Return how many failures were kept, skipped (in a storm), removed (for newer ones) and so on since the start.

        ``without_event`` of those that were kept are without their event; ``unwritten`` could not be written,
        ``unreadable`` is how often a damaged file was met.
        """
        with self._lock:
            return dict(self._counts)

    def _count(self, what: str, count: int = 1) -> None:
        with self._lock:
            self._counts[what] += count

    # on the writer's thread, to the end of this section

    def _write(self, record: FailureRecord, event: Any) -> None:
        packed, no_event = self._packed(event)
        with_event = replace(record, has_event=True)
        without = replace(record, has_event=False, no_event=no_event or "it could not be written")
        try:
            if packed is None or not self._is_put(with_event, packed):
                self._count("unwritten", not self._is_put(without, None))
        except Exception:  # the writer logs it
            self._count("unwritten")
            raise

    def _is_put(self, record: FailureRecord, packed: bytes | None) -> bool:
        try:
            self._make_room(len(packed or b""))
            self._put_both(record, packed)
        except OSError as error:
            self._log_unwritten(record, error)
            return False
        self._causes[record.id] = record.cause
        self._count("kept")
        self._count("without_event", packed is None)
        return True

    def _packed(self, event: Any) -> tuple[bytes | None, str]:
        """Return the event as bytes, or None and the reason."""
        from epypes.service.packing import pack_event

        if event is None:
            return None, "the service had none to give"
        most = int(self._most_bytes * _EVENT_SHARE)
        try:
            packed = pack_event(event)
        except EpypesError as error:
            return None, str(error)
        if len(packed) > most:
            return None, f"it has {len(packed) / 1e6:,.1f} MB, more than the {most / 1e6:,.1f} MB of one event"
        return packed, ""

    def _log_unwritten(self, record: FailureRecord, error: OSError) -> None:
        """Log that a failure can't be written; on a full disk once a minute, with the count of the others."""
        if monotonic() - self._logged_s < _LOG_PAUSE_S:
            self._unlogged += 1
            return
        others = f"; so could not {self._unlogged} others before" if self._unlogged else ""
        reason = error.strerror or error
        _log.warning("failure %s can't be written to %s: %s%s", record.id, self.folder, reason, others)
        self._logged_s, self._unlogged = monotonic(), 0

    def _put_both(self, record: FailureRecord, event: bytes | None) -> None:
        """Write a failure, its event first: a record that says so has its event."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        document: dict[str, Any] = {"record": asdict(record)}
        if event is not None:
            document["event"] = {"bytes": len(event), "sha256": hashlib.sha256(event).hexdigest()}
        try:
            if event is not None:
                self._put(record.id + _EVENT, event)
            self._put(record.id + _RECORD, json.dumps(document, default=str, indent=1).encode())
        except OSError:
            self._remove(record.id)
            raise

    def _put(self, name: str, data: bytes) -> None:
        """Write a file under another name first, so that no reader ever sees half of it."""
        part = self.folder / f".{name}.{os.getpid()}{_PART}"
        try:
            descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
            part.replace(self.folder / name)
        except OSError:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise

    def _remove(self, failure_id: str) -> None:
        """Remove a failure, its record first."""
        for ending in (_RECORD, _EVENT):
            with contextlib.suppress(OSError):
                (self.folder / f"{failure_id}{ending}").unlink()

    def _sweep(self) -> None:
        """Remove what processes that were killed have left: parts of files, and events without a record."""
        with contextlib.suppress(OSError):
            orphans = [self.folder / f"{each.id}{_EVENT}" for each in self._stored() if not each.has_record]
            for file in (*self.folder.glob(f".*{_PART}"), *orphans):
                with contextlib.suppress(OSError):
                    if file.lstat().st_mtime < time.time() - _PART_AGE_S:
                        file.unlink()

    def _make_room(self, size: int) -> None:
        """Remove failures until there is room for one more."""
        stored = self._stored()
        causes: dict[str, object] = {}
        for each in stored:
            record = None if each.id in self._causes or not each.has_record else self._readable(each.id)
            causes[each.id] = self._causes.get(each.id) or (record.cause if record is not None else None)
        self._causes = causes
        for failure_id in list(_to_remove(stored, causes, self._most - 1, self._most_bytes - size)):
            self._remove(failure_id)
            self._count("removed")

    # -- reading ------------------------------------------------------------------------------------------------

    def records(self, limit: int | None = None) -> list[FailureRecord]:
        """Return the records that can be read, the newest first."""
        try:
            stored = [each.id for each in self._stored() if each.has_record]
        except OSError:
            self._count("unreadable")
            return []
        found: list[FailureRecord] = []
        for failure_id in reversed(stored):
            if limit is not None and len(found) >= limit:
                break
            record = self._readable(failure_id)
            if record is not None:
                found.append(record)
        return found

    def record(self, failure_id: str) -> FailureRecord:
        """Return the record of a failure.

        Raises
        ------
        UnknownName
            There is none with this id; the nearest is named.
        FailureNotKept
            It can't be read.
        """
        return self._document(failure_id)[0]

    def packed_event(self, failure_id: str) -> bytes:
        """Return the event of a failure as `pack_event` packed it.

        Raises
        ------
        UnknownName
            There is no failure with this id.
        FailureNotKept
            Its event was not kept, or can't be read any more.
        """
        record, about = self._document(failure_id)
        if not isinstance(about, Mapping):
            reason = record.no_event or "the service had none to give"
            raise FailureNotKept(failure_id, self.folder, f"The event of failure {failure_id} was not kept: {reason}.")
        path = self.folder / f"{failure_id}{_EVENT}"
        try:
            if path.stat().st_size != about.get("bytes"):
                raise _damaged(failure_id, path, "it has another size than was written")
            data = path.read_bytes()
        except OSError as error:
            raise _damaged(failure_id, path, error.strerror or "it can't be read") from error
        if hashlib.sha256(data).hexdigest() != about.get("sha256"):
            raise _damaged(failure_id, path, "it is not what was written")
        return data

    def event(self, failure_id: str) -> Envelope | bytes:
        """Return the event of a failure: an Envelope, or the one frame of a message of 2019.

        Raises
        ------
        UnknownName, FailureNotKept
            As `packed_event`.
        """
        from epypes.service.packing import unpack_event

        return unpack_event(self.packed_event(failure_id))

    def _stored(self) -> list[_Stored]:
        """Return what the folder holds, the oldest first; raise OSError if it can't be read."""
        sizes: dict[str, dict[str, int]] = {}
        try:
            with os.scandir(self.folder) as files:
                for file in files:
                    stem, _, ending = file.name.partition(".")
                    if ID.fullmatch(stem) and f".{ending}" in (_RECORD, _EVENT):
                        with contextlib.suppress(FileNotFoundError):  # another service has just removed it
                            sizes.setdefault(stem, {})[f".{ending}"] = file.stat(follow_symlinks=False).st_size
        except FileNotFoundError:
            return []
        return [_Stored(name, _RECORD in files, sum(files.values())) for name, files in sorted(sizes.items())]

    def _readable(self, failure_id: str) -> FailureRecord | None:
        try:
            return self.record(failure_id)
        except UnknownName:  # it has just been removed
            return None
        except (FailureNotKept, OSError):
            self._count("unreadable")
            return None

    def _document(self, failure_id: str) -> tuple[FailureRecord, Any]:
        """Return what a failure's JSON holds: its record, and size and checksum of its event."""
        path = self.folder / f"{failure_id}{_RECORD}"
        if not ID.fullmatch(failure_id) or not path.exists():
            known = [each.id for each in self._stored() if each.has_record]
            raise UnknownName("failure", failure_id, reversed(known), f"in {self.folder}")
        try:
            if path.stat().st_size > _MAX_RECORD_BYTES:
                raise ValueError("it is too large")
            document = json.loads(path.read_bytes())
            record = read_record(document["record"])
            if record.id != failure_id:
                raise ValueError(f"it is the record of {record.id}")
        except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
            raise _damaged(failure_id, path, str(getattr(error, "strerror", None) or error)) from error
        return record, document.get("event")

    def __repr__(self) -> str:
        return f"<FailureStore {str(self.folder)[-40:]!r}>"


def _damaged(failure_id: str, path: Path, reason: str) -> FailureNotKept:
    return FailureNotKept(failure_id, path, f"{path} can't be read: {reason}. Remove it, or restore it.")


def _to_remove(stored: Iterable[_Stored], causes: Mapping[str, object], most: int, most_bytes: int) -> Iterator[str]:
    """Yield which failures have to go until no more than ``most`` of ``most_bytes`` together are left.

    Damaged ones go first. Then the cause that has the most loses the oldest after its first ones: a storm leaves other
    failures alone, and its beginning can be seen.
    """
    left = dict.fromkeys(stored)
    counts = Counter(causes[each.id] for each in left)
    size = sum(each.size for each in left)
    while left and (len(left) > most or size > most_bytes):
        if counts[None]:
            goes = next(each for each in left if causes[each.id] is None)
        else:
            cause, count = counts.most_common(1)[0]
            of_cause = [each for each in left if causes[each.id] == cause]
            goes = of_cause[_FIRST] if count > _FIRST else next(iter(left))
        del left[goes]
        counts[causes[goes.id]] -= 1
        size -= goes.size
        yield goes.id
