"""Where are the failures of a service kept, so that they can be run again?

In a folder that outlives it, by a thread of its own: whoever hands over a failure waits for no disk, and whatever is
wrong with the disk is counted.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import EpypesError, FailureNotKept, UnknownName
from epypes.service.failures.files import Entry, entries, read_event, read_record, remove, sweep, to_remove, write
from epypes.service.failures.pace import BURST, Waiting
from epypes.service.failures.record import FailureRecord, record_of, with_id
from epypes.store.writer import Writer

if TYPE_CHECKING:
    from epypes.wire import EncodedEnvelope, Envelope

__all__ = ["FailureRecord", "FailureStore", "failures_folder", "record_of"]

_log = logging.getLogger("epypes.service")

_MOST: Final = 100
_MOST_BYTES: Final = 256 * 1024**2
# An event larger than this share of all would push out too many others.
_EVENT_SHARE: Final = 0.25
_COUNTED: Final = ("kept", "skipped", "removed", "without_event", "unwritten", "unreadable")


def failures_folder(bundle: str | Path) -> Path:
    """Return where the failures of a bundle's service are kept: in a folder of this user's, not in the bundle."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    name = hashlib.sha256(str(Path(bundle).resolve()).encode()).hexdigest()[:20]
    return Path(state) / "epypes" / "failures" / name


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
    Any thread may use it. Nothing about a disk is raised: `counts` tells. Reading needs no `keep` before.
    """

    def __init__(
        self, folder: str | Path, *, most: int = _MOST, most_bytes: int = _MOST_BYTES, burst: int = BURST
    ) -> None:
        self.folder = Path(folder)
        self._most, self._most_bytes = most, most_bytes
        self._waiting = Waiting(burst)
        self._writer = Writer(
            "epypes failures", self._waiting, lambda found: self._write(*found), lambda: sweep(self.folder)
        )
        self._lock = threading.Lock()
        self._counts = Counter(dict.fromkeys(_COUNTED, 0))
        self._causes: dict[str, object] = {}

    # -- keeping ------------------------------------------------------------------------------------------------

    def keep(self, record: FailureRecord, event: Envelope | EncodedEnvelope | bytes | None = None) -> FailureRecord:
        """Have a failure kept; return its record with the id that it has got.

        Returns at once and raises nothing. The event's arrays must not change any more.
        """
        record = with_id(record)
        what = record.cause, (record, event)
        self._count("skipped", self._writer.put(lambda now_s: self._waiting.add(*what, now_s)))
        return record

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Have all that waits written now; return whether that was done in time."""
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

    def _write(self, record: FailureRecord, event: Any) -> None:
        try:
            packed, no_event = self._packed(event)
            if packed is not None and self._put(replace(record, has_event=True), packed):
                return
            self._put(replace(record, has_event=False, no_event=no_event or "it could not be written"), None)
        except Exception:
            # The writer tells what it was.
            self._count("unwritten")
            raise

    def _put(self, record: FailureRecord, packed: bytes | None) -> bool:
        try:
            self._make_room(len(packed or b""))
            write(self.folder, record, packed)
        except OSError as error:
            _log.warning("failure %s can't be written to %s: %s", record.id, self.folder, error.strerror or error)
            self._count("unwritten", packed is None)
            return False
        self._causes[record.id] = record.cause
        self._count("kept")
        self._count("without_event", packed is None)
        return True

    def _packed(self, event: Any) -> tuple[bytes | None, str]:
        """Return the event as bytes, or None and why not."""
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

    def _make_room(self, size: int) -> None:
        """Remove failures until there is room for one more."""
        present = entries(self.folder)
        self._causes = {entry.id: self._causes.get(entry.id) or self._cause(entry) for entry in present}
        for failure_id in list(to_remove(present, self._causes, self._most - 1, self._most_bytes - size)):
            remove(self.folder, failure_id)
            self._count("removed")

    def _cause(self, entry: Entry) -> object:
        """Return the cause of a failure; None if it is damaged."""
        record = self._record(entry.id) if entry.has_record else None
        return record.cause if record is not None else None

    # -- reading ------------------------------------------------------------------------------------------------

    def records(self, limit: int | None = None) -> list[FailureRecord]:
        """Return the records that can be read, the newest first."""
        found: list[FailureRecord] = []
        for failure_id in reversed(self._present()):
            if limit is not None and len(found) >= limit:
                break
            record = self._record(failure_id)
            if record is not None:
                found.append(record)
        return found

    def _present(self) -> list[str]:
        try:
            return [entry.id for entry in entries(self.folder) if entry.has_record]
        except OSError:
            self._count("unreadable")
            return []

    def _record(self, failure_id: str) -> FailureRecord | None:
        try:
            return read_record(self.folder, failure_id)
        except UnknownName:
            # It has just been removed.
            return None
        except (FailureNotKept, OSError):
            self._count("unreadable")
            return None

    def record(self, failure_id: str) -> FailureRecord:
        """Return the record of a failure.

        Raises
        ------
        UnknownName
            There is none with this id; the nearest is named.
        FailureNotKept
            It can't be read.
        """
        return read_record(self.folder, failure_id)

    def packed_event(self, failure_id: str) -> bytes:
        """Return the event of a failure as `pack_event` packed it.

        Raises
        ------
        UnknownName
            There is no failure with this id.
        FailureNotKept
            Its event was not kept, or can't be read any more.
        """
        return read_event(self.folder, failure_id)

    def event(self, failure_id: str) -> Envelope | bytes:
        """Return the event of a failure: an Envelope, or the one frame of a message of 2019.

        Raises
        ------
        UnknownName, FailureNotKept
            As `packed_event`.
        """
        from epypes.service.packing import unpack_event

        return unpack_event(self.packed_event(failure_id))

    def __repr__(self) -> str:
        return f"<FailureStore {str(self.folder)[-40:]!r}>"
