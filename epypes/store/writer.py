"""Writing on a background thread, so that no caller waits for a disk or a database."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from time import monotonic
from typing import Any, Final, Generic, TypeVar

from epypes.errors import StoreError
from epypes.optional import optional_import
from epypes.store.store import Series, Store

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# A write that failed is tried again after the first pause, then after twice as long, up to the longest; while a caller
# waits in flush(), after the short one.
_FIRST_PAUSE_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 30.0
_FLUSHING_PAUSE_S: Final = 0.1

# Waiting rows are in memory; a row of an event has about 1 KB.
_MAX_ROWS: Final = 10_000
_ROWS_AT_A_TIME: Final = 200


class BackgroundWriter(Generic[_T]):
    """Writes items in order on a daemon thread, which begins with the first item and ends when none waits.

    Parameters
    ----------
    name
        The thread's name.
    write
        Called on the thread with the next items. If it returns False, they stay and are tried again later, with pauses
        that grow to 30 seconds. If it raises, that is logged and they are dropped.
    most
        How many items may wait.
    at_a_time
        How many items are written at a time.
    """

    def __init__(self, name: str, write: Callable[[list[_T]], bool], *, most: int, at_a_time: int = 1) -> None:
        self._name, self._write = name, write
        self._most, self._at_a_time = most, at_a_time
        self._items: deque[_T] = deque()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._flushing = 0

    def __len__(self) -> int:
        """Return how many items wait or are being written."""
        return len(self._items)

    def put(self, item: _T) -> bool:
        """Have an item written; return at once, and whether there was room for it."""
        with self._changed:
            fits = len(self._items) < self._most
            if fits:
                self._items.append(item)
            self._start()
        return fits

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Write all that waits now; return whether that was done in time."""
        with self._changed:
            self._flushing += 1
            self._start()
            try:
                return self._changed.wait_for(lambda: not self._items, timeout_s)
            finally:
                self._flushing -= 1

    def _start(self) -> None:
        if self._thread is None and self._items:
            thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            try:
                thread.start()
            except RuntimeError:  # no more threads, or the interpreter ends: the next put tries again
                return
            self._thread = thread
        self._changed.notify_all()

    def _run(self) -> None:
        pause_s = 0.0
        while items := self._next(pause_s):
            try:
                is_done = self._write(items)
            except Exception:  # the next items must be written, whatever is wrong with these
                _log.exception("%s could not write", self._name)
                is_done = True
            with self._changed:
                pause_s = 0.0 if is_done else min(max(2 * pause_s, _FIRST_PAUSE_S), _LONGEST_PAUSE_S)
                if is_done:
                    for _ in items:
                        self._items.popleft()
                self._changed.notify_all()
            del items  # their memory is given back while the next ones are waited for

    def _next(self, pause_s: float) -> list[_T]:
        """Return the next items after a pause; none if none wait."""
        began_s = monotonic()
        with self._changed:
            while self._items:
                due_s = began_s + (min(pause_s, _FLUSHING_PAUSE_S) if self._flushing else pause_s)
                if due_s <= monotonic():
                    return list(islice(self._items, self._at_a_time))
                self._changed.wait(due_s - monotonic())
            self._thread = None
            return []


class SeriesWriter:
    """Writes rows to a series on a background thread; while the database is away, they wait.

    Parameters
    ----------
    store
        A path, a URL or a Store. It is opened on the thread too, so that it may be away for now.
    kind, name, about
        As for `Store.series`.
    most
        How many rows may wait.
    report
        Called on the thread with a sentence on what goes wrong; without, it goes to the log.

    Raises
    ------
    StoreError
        There can be no such database, or there is no driver for it.

    Notes
    -----
    Any thread may use it. Close it, so that all rows are written.
    """

    def __init__(
        self,
        store: str | Path | Store,
        kind: str,
        name: str,
        *,
        about: Mapping[str, Any] | None = None,
        most: int = _MAX_ROWS,
        report: Callable[[str], object] = _log.warning,
    ) -> None:
        self._kind, self._name, self._about = kind, name, about
        self._store = store if isinstance(store, Store) else None
        # Of a store that is opened here, and closed here too.
        self._place = None if isinstance(store, Store) else store
        if self._place is not None:
            with optional_import():
                from epypes.store.database import check_database
            check_database(self._place)
        self._series: Series | None = None
        self._on_problem = report
        self._is_away = False
        self._counts = {"written": 0, "skipped": 0, "unwritten": 0}
        self._lock = threading.Lock()
        self._writer = BackgroundWriter(f"epypes {kind}", self._write, most=most, at_a_time=_ROWS_AT_A_TIME)

    def append(self, key: str, data: Mapping[str, Any]) -> bool:
        """Have a row written; return at once, and whether there was room for it. ``data`` must not change any more."""
        fits = self._writer.put((key, data))
        with self._lock:
            self._counts["skipped"] += not fits
        return fits

    def counts(self) -> dict[str, int]:
        """Return how many rows were written, were skipped (no room), are no JSON (unwritten), and wait."""
        with self._lock:
            return {**self._counts, "waiting": len(self._writer)}

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Write all rows that wait now; return whether that was done in time."""
        return self._writer.flush(timeout_s)

    def close(self, timeout_s: float = 5.0) -> bool:
        """Write all rows that wait, and close a store that was opened for it; return whether that was done in time."""
        is_done = self.flush(timeout_s)
        if is_done and self._place is not None and self._store is not None:
            self._store.close()
            # A later row opens it again.
            self._store = self._series = None
        return is_done

    # on the thread, to the end of the class

    def _write(self, rows: list[tuple[str, Mapping[str, Any]]]) -> bool:
        try:
            unwritten = self._put(rows)
        except StoreError as error:
            is_first, self._is_away = not self._is_away, True
            if is_first:
                self._report(f"{error} Rows of {self._kind} {self._name!r} wait for it.")
            return False
        with self._lock:
            self._counts["written"] += len(rows) - unwritten
            self._counts["unwritten"] += unwritten
        if self._is_away:
            _log.info("Rows of %s %r are written again.", self._kind, self._name)
        self._is_away = False
        return True

    def _put(self, rows: list[tuple[str, Mapping[str, Any]]]) -> int:
        """Write rows; return how many can never be written, since they are no JSON."""
        if self._series is None:
            self._store = Store(self._place or "") if self._store is None else self._store
            self._series = self._store.series(self._kind, self._name, about=self._about)
        try:
            self._series.append_all(rows)
            return 0
        except TypeError:  # of one row; the others are written
            unwritten = 0
        for key, data in rows:
            try:
                self._series.append(key, data)
            except TypeError as error:
                unwritten += 1
                self._report(str(error))
        return unwritten

    def _report(self, text: str) -> None:
        try:
            self._on_problem(text)
        except Exception:  # the rows must be written, whatever is wrong with the caller's function
            _log.exception("the function that gets reports of %s %r failed", self._kind, self._name)
