"""Writing on a background thread, so that no caller waits for a disk or a database."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from epypes.errors import StoreError
from epypes.optional import optional_import
from epypes.store.store import Series, Store

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# A write that failed is tried again after this, and at once when a caller begins to wait in flush().
_RETRY_S: Final = 1.0

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
        Called on the thread with the next items. If it returns False, they stay and are tried again a second later. If
        it raises, that is logged and they are dropped.
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
            self._start()
            self._changed.notify_all()
            return self._changed.wait_for(lambda: not self._items, timeout_s)

    def _start(self) -> None:
        if self._thread is None and self._items:
            thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            with suppress(RuntimeError):  # no more threads, or the interpreter ends: the next put tries again
                thread.start()
                self._thread = thread

    def _run(self) -> None:
        while items := self._next():
            try:
                is_done = self._write(items)
            except Exception:  # the next items must be written, whatever is wrong with these
                _log.exception("%s could not write", self._name)
                is_done = True
            with self._changed:
                if is_done:
                    for _ in items:
                        self._items.popleft()
                    self._changed.notify_all()
                else:
                    self._changed.wait(_RETRY_S)

    def _next(self) -> list[_T]:
        with self._changed:
            if not self._items:
                self._thread = None
            return list(islice(self._items, self._at_a_time))


class SeriesWriter(BackgroundWriter[tuple[str, str]]):
    """Writes rows to a series on a background thread; while the database is away, they wait.

    Parameters
    ----------
    store
        A path, a URL or a Store. It is opened on the thread, so that it may be away for now.
    kind, name
        As for `Store.series`; the first row makes the series.
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
        most: int = _MAX_ROWS,
        report: Callable[[str], object] = _log.warning,
    ) -> None:
        super().__init__(f"epypes {kind}", self._write_rows, most=most, at_a_time=_ROWS_AT_A_TIME)
        with optional_import():
            from epypes.store.database import Database
        self._is_own = not isinstance(store, Store)
        self._database = store.database if isinstance(store, Store) else Database(store)
        self._series = Series(self._database, kind, name)
        self._report = report
        self._is_away = False
        self._written = self._skipped = 0

    def append(self, key: str, data: Mapping[str, Any]) -> bool:
        """Have a row written; return at once, and whether there was room for it.

        Raises
        ------
        TypeError
            data contains an object that JSON has no type for.
        """
        fits = self.put((key, self._series.encode(key, data)))
        with self._changed:
            self._skipped += not fits
        return fits

    def counts(self) -> dict[str, int]:
        """Return how many rows were written, were skipped (no room), and wait."""
        return {"written": self._written, "skipped": self._skipped, "waiting": len(self)}

    def close(self, timeout_s: float = 5.0) -> bool:
        """Write all rows that wait, and disconnect from a store that was opened; return whether that was in time."""
        is_done = self.flush(timeout_s)
        if self._is_own:
            # A later row connects again.
            self._database.engine.dispose()
        return is_done

    def _write_rows(self, rows: list[tuple[str, str]]) -> bool:
        about = f"{self._series.kind} {self._series.name!r}"
        try:
            self._series.put(dict(rows))
        except StoreError as error:
            is_first, self._is_away = not self._is_away, True
            if is_first:
                self._report(f"{error} Rows of {about} wait for it.")
            return False
        if self._is_away:
            _log.info("Rows of %s are written again.", about)
        self._is_away = False
        self._written += len(rows)
        return True
