"""A folder of failures: a file for each, with its record as a line of JSON, and then the event as it came.

A thread of its own writes, so that no caller waits for a disk; what is wrong with the disk is counted and logged. Every
file appears whole or not at all, under a name that tells its place in time. Files of others in the folder are left
alone. Several stores, also of other processes, may use one folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from time import monotonic, time
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import EpypesError, FailureNotKept, InvalidValue, MessageError, UnknownName
from epypes.service.failures.record import ID, FailedEvent, read_record, with_id
from epypes.store.writer import BackgroundWriter
from epypes.transport.throttle import Throttle

if TYPE_CHECKING:
    from epypes.wire import EncodedEnvelope, Envelope

__all__ = ["FailedEvent", "FailureStore", "failures_folder"]

_log = logging.getLogger("epypes.service")

_MAX_FAILURES: Final = 100
_MAX_BYTES: Final = 256 * 1024**2
# The share of all bytes that one event may take; a larger one would push out too many others.
_EVENT_SHARE: Final = 0.25
_ENDING, _PART = ".failure", ".part"
# Older parts of files are those of a process that was killed.
_PART_AGE_S: Final = 600.0
# Of one cause so many first failures are kept for as long as there are others to remove.
_FIRST: Final = 3
_COUNTED: Final = ("kept", "skipped", "removed", "without_event", "unwritten", "unreadable")

# Of one cause, so many failures are written at once, then one each second.
_BURST: Final = 10
_PER_S: Final = 1.0
# What waits is in memory, with its images.
_MAX_WAITING: Final = 20
_MAX_CAUSES: Final = 256


def failures_folder(bundle: str | Path) -> Path:
    """Return the folder for the failures of a bundle's service: one of this user's, not in the bundle."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    name = hashlib.sha256(str(Path(bundle).resolve()).encode()).hexdigest()[:20]
    return Path(state) / "epypes" / "failures" / name


# -- the pace ---------------------------------------------------------------------------------------------------------


class _CauseBudgets:
    """How many failures of each cause may be written: some at once, then one each second (a token bucket).

    A camera with black frames fails thirty times a second, always alike: to write down each failure would take the disk
    from other processes, and push out the one failure that is different.
    """

    def __init__(self, burst: int) -> None:
        self._burst = burst
        # By cause: how many may be written now, and when that was computed.
        self._budgets: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()

    def spend(self, cause: Hashable, put: Callable[[], bool]) -> bool:
        """Put a failure if its cause has a budget; return whether it was put. Not for several threads at once."""
        now_s = monotonic()
        left, at_s = self._budgets.pop(cause, (self._burst, now_s))
        left = min(left + (now_s - at_s) * _PER_S, self._burst)
        is_put = left >= 1 and put()
        self._budgets[cause] = left - is_put, now_s
        if len(self._budgets) > _MAX_CAUSES:
            self._budgets.popitem(last=False)
        return is_put


# -- the store --------------------------------------------------------------------------------------------------------


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
        How many failures of one cause are kept one right after the other; of a storm's others one in a second.

    Notes
    -----
    Any thread may use it. Nothing about a disk is raised by `keep`: `counts` has it. Reading needs no `keep` before.
    """

    def __init__(
        self, folder: str | Path, *, most: int = _MAX_FAILURES, most_bytes: int = _MAX_BYTES, burst: int = _BURST
    ) -> None:
        self.folder = Path(folder)
        self._most, self._most_bytes = most, most_bytes
        self._budgets = _CauseBudgets(burst)
        self._writer = BackgroundWriter("epypes failures", self._write_next, most=_MAX_WAITING)
        self._lock = threading.Lock()
        self._counts = Counter(dict.fromkeys(_COUNTED, 0))
        self._causes: dict[str, object] = {}
        self._throttle = Throttle(_log)

    # -- keeping ------------------------------------------------------------------------------------------------

    def keep(
        self, record: FailedEvent, event: Envelope | EncodedEnvelope | bytes | None = None, state: bytes = b""
    ) -> FailedEvent:
        """Keep a failure; return its record with the id that it has got.

        Returns at once and raises nothing. The event's arrays must not change any more.

        Parameters
        ----------
        event
            What failed.
        state
            The encoded state between events that it began with; empty for the initial one.
        """
        record = with_id(record)
        with self._lock:
            is_put = self._budgets.spend(record.cause, lambda: self._writer.put((record, event, state)))
            self._counts["skipped"] += not is_put
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

    def _write_next(self, items: list[tuple[FailedEvent, Any, bytes]]) -> bool:
        self._sweep()
        for record, event, state in items:
            self._write(record, event, state)
        return True

    def _write(self, record: FailedEvent, event: Any, state: bytes) -> None:
        packed, no_event = self._packed(event, state)
        with_event = replace(record, has_event=True, state_bytes=len(state))
        without = replace(record, has_event=False, no_event=no_event or "it could not be written")
        try:
            if packed is None or not self._is_put(with_event, packed):
                self._count("unwritten", not self._is_put(without, b""))
        except Exception:  # the writer logs it
            self._count("unwritten")
            raise

    def _is_put(self, record: FailedEvent, packed: bytes) -> bool:
        try:
            self._make_room(len(packed))
            self._put(record, packed)
        except OSError as error:
            text = f"failure {record.id} can't be written to {self.folder}: {error.strerror or error}"
            self._throttle.warning("unwritten", text)
            return False
        self._causes[record.id] = record.cause
        self._count("kept")
        self._count("without_event", not record.has_event)
        return True

    def _packed(self, event: Any, state: bytes) -> tuple[bytes | None, str]:
        """Return the state and the event as bytes, or None and the reason."""
        from epypes.service.supervision.packing import pack_event

        if event is None:
            return None, "the service had none to give"
        most = int(self._most_bytes * _EVENT_SHARE)
        try:
            packed = state + pack_event(event)
        except EpypesError as error:
            return None, str(error)
        if len(packed) > most:
            size = f"{len(packed) / 1e6:,.1f} MB{' with its state' if state else ''}"
            return None, f"it has {size}, more than the {most / 1e6:,.1f} MB of one event"
        return packed, ""

    def _put(self, record: FailedEvent, packed: bytes) -> None:
        """Write a file under another name first, so that no reader ever sees half of it."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = self._path(record.id)
        part = self.folder / f".{path.name}.{os.getpid()}{_PART}"
        try:
            descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(json.dumps(asdict(record), default=str).encode() + b"\n")
                file.write(packed)
            part.replace(path)
        except OSError:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise

    def _sweep(self) -> None:
        """Remove the parts of files that processes which were killed have left."""
        for file in self.folder.glob(f".*{_PART}"):
            with contextlib.suppress(OSError):
                if file.lstat().st_mtime < time() - _PART_AGE_S:
                    file.unlink()

    def _make_room(self, size: int) -> None:
        """Remove failures until there is room for one more."""
        stored = self._stored()
        causes: dict[str, object] = {}
        for failure_id in stored:
            record = None if failure_id in self._causes else self._readable(failure_id)
            causes[failure_id] = self._causes.get(failure_id) or (record.cause if record is not None else None)
        self._causes = causes
        for failure_id in list(_to_remove(stored, causes, self._most - 1, self._most_bytes - size)):
            with contextlib.suppress(OSError):
                self._path(failure_id).unlink()
            self._count("removed")

    def _path(self, failure_id: str) -> Path:
        return self.folder / f"{failure_id}{_ENDING}"

    # -- reading ------------------------------------------------------------------------------------------------

    def records(self, limit: int | None = None) -> list[FailedEvent]:
        """Return the records that can be read, the newest first."""
        try:
            stored = self._stored()
        except OSError:
            self._count("unreadable")
            return []
        found: list[FailedEvent] = []
        for failure_id in reversed(stored):
            if limit is not None and len(found) >= limit:
                break
            record = self._readable(failure_id)
            if record is not None:
                found.append(record)
        return found

    def record(self, failure_id: str) -> FailedEvent:
        """Return the record of a failure.

        Raises
        ------
        UnknownName
            There is none with this id; the nearest is named.
        FailureNotKept
            It can't be read.
        """
        return self._read(failure_id, with_event=False)[0]

    def _read(self, failure_id: str, *, with_event: bool) -> tuple[FailedEvent, bytes, bytes]:
        """Return what is in a failure's file: its record; and its state and its packed event if they are wanted."""
        path = self._path(failure_id)
        if not ID.fullmatch(failure_id) or not path.exists():
            raise UnknownName("failure", failure_id, reversed(self._stored()), f"in {self.folder}")
        try:
            with path.open("rb") as file:
                record = read_record(json.loads(file.readline()))
                state = file.read(record.state_bytes) if with_event else b""
                packed = file.read() if with_event else b""
            if record.id != failure_id:
                raise InvalidValue(f"it is the record of {record.id}")
        except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
            raise _damaged(failure_id, path, error) from error
        return record, state, packed

    def packed_event(self, failure_id: str) -> bytes:
        """Return the event of a failure as `pack_event` packed it.

        Raises
        ------
        UnknownName
            There is no failure with this id.
        FailureNotKept
            Its event was not kept, or can't be read any more.
        """
        record, _, packed = self._read(failure_id, with_event=True)
        if not record.has_event:
            reason = record.no_event or "the service had none to give"
            raise FailureNotKept(failure_id, self.folder, f"The event of failure {failure_id} was not kept: {reason}.")
        return packed

    def event(self, failure_id: str) -> Envelope | bytes:
        """Return the event of a failure: an Envelope, or the one frame of a message of 2019.

        Raises
        ------
        UnknownName, FailureNotKept
            As `packed_event`.
        """
        from epypes.service.supervision.packing import unpack_event

        packed = self.packed_event(failure_id)
        try:
            return unpack_event(packed)
        except MessageError as error:
            raise _damaged(failure_id, self._path(failure_id), error) from error

    def state(self, failure_id: str) -> bytes:
        """Return the encoded state between events that a failure began with; empty for the initial one.

        Raises
        ------
        UnknownName, FailureNotKept
            As `packed_event`.
        """
        self.packed_event(failure_id)
        return self._read(failure_id, with_event=True)[1]

    def _stored(self) -> dict[str, int]:
        """Return the size of each file by its failure's id, the oldest first; raise OSError if that can't be read."""
        sizes: dict[str, int] = {}
        with contextlib.suppress(FileNotFoundError), os.scandir(self.folder) as files:
            for file in files:
                failure_id = file.name.removesuffix(_ENDING)
                if ID.fullmatch(failure_id) and file.name.endswith(_ENDING):
                    with contextlib.suppress(FileNotFoundError):  # another service has just removed it
                        sizes[failure_id] = file.stat(follow_symlinks=False).st_size
        return dict(sorted(sizes.items()))

    def _readable(self, failure_id: str) -> FailedEvent | None:
        try:
            return self.record(failure_id)
        except UnknownName:  # it has just been removed
            return None
        except (FailureNotKept, OSError):
            self._count("unreadable")
            return None

    def __repr__(self) -> str:
        return f"<FailureStore {str(self.folder)[-40:]!r}>"


def _damaged(failure_id: str, path: Path, error: Exception) -> FailureNotKept:
    reason = getattr(error, "strerror", None) or error
    return FailureNotKept(failure_id, path, f"{path} can't be read: {reason}. Remove it, or restore it.")


def _to_remove(stored: Mapping[str, int], causes: Mapping[str, object], most: int, most_bytes: int) -> Iterator[str]:
    """Yield which failures have to go until no more than ``most`` of ``most_bytes`` together are left.

    Damaged ones go first. Then the cause that has the most loses the oldest after its first ones: a storm leaves other
    failures alone, and its beginning can be seen.
    """
    left = dict(stored)
    counts = Counter(causes[failure_id] for failure_id in left)
    size = sum(left.values())
    while left and (len(left) > most or size > most_bytes):
        cause, count = (None, 0) if counts[None] else counts.most_common(1)[0]
        of_cause = [failure_id for failure_id in left if causes[failure_id] == cause]
        goes = of_cause[_FIRST] if count > _FIRST else next(iter(of_cause if cause is None else left))
        size -= left.pop(goes)
        counts[causes[goes]] -= 1
        yield goes
