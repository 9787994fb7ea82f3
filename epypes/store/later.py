"""How are rows written without waiting for the database, also while it is away?

They wait in a line of bounded length. A database that is away is told once and tried again, less and less often; a row
that does not fit meanwhile is counted.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Final

from epypes.errors import StoreError
from epypes.store.database import check_place
from epypes.store.series import Series
from epypes.store.store import Store, as_store
from epypes.store.writer import Writer

_log = logging.getLogger(__name__)

Row = tuple[str, Mapping[str, Any]]

# What waits is in memory; a row of an event has about 1 KB.
MOST: Final = 10_000
_AT_A_TIME: Final = 200
_SHORTEST_S: Final = 0.5
_LONGEST_S: Final = 30.0
# While somebody waits for it, it is not tried more often than that.
_AT_ONCE_S: Final = 0.1


class Line:
    """Rows that wait, in the order in which they came."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._rows: deque[Row] = deque()
        self._failed_s, self._pause_s = 0.0, 0.0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: Row) -> bool:
        """Take a row in; return whether there was room for it."""
        if len(self._rows) >= self._most:
            return False
        self._rows.append(row)
        return True

    def take(self, now_s: float, *, at_once: bool = False) -> list[Row] | None:
        """Return the next rows, which stay in the line until they are `done`."""
        pause_s = min(self._pause_s, _AT_ONCE_S) if at_once else self._pause_s
        if not self._rows or now_s < self._failed_s + pause_s:
            return None
        return list(islice(self._rows, _AT_A_TIME))

    def due_in_s(self, now_s: float) -> float | None:
        """Return in how many seconds the next are to be written; None if none wait."""
        return max(self._failed_s + self._pause_s - now_s, 0.0) if self._rows else None

    def done(self, count: int) -> bool:
        """Forget the first rows, which were written; return whether the try before had failed."""
        is_back, self._pause_s = self._pause_s > 0, 0.0
        for _ in range(count):
            self._rows.popleft()
        return is_back

    def failed(self, now_s: float) -> bool:
        """Wait before the next try, longer each time; return whether it is the first one that failed."""
        is_first = not self._pause_s
        self._failed_s, self._pause_s = now_s, min(max(2 * self._pause_s, _SHORTEST_S), _LONGEST_S)
        return is_first


class SeriesWriter:
    """Writes rows to a series on a thread of its own; that the database is away is not raised.

    Parameters
    ----------
    store
        A path, a URL or a Store. It is opened on the thread too, so that it may be away for now.
    kind, name, about
        As for `Store.series`.
    most
        How many rows may wait.
    told
        Called on the thread with what goes wrong, a sentence; without, it goes to the log.

    Raises
    ------
    StoreError
        There can be no such database, or there is no driver for it.

    Notes
    -----
    Any thread may use it. Close it, so that what waits is written.
    """

    def __init__(
        self,
        store: str | Path | Store,
        kind: str,
        name: str,
        *,
        about: Mapping[str, Any] | None = None,
        most: int = MOST,
        told: Callable[[str], object] = _log.warning,
    ) -> None:
        self._given, self._kind, self._name, self._about = store, kind, name, about
        self._store: Store | None = None
        if isinstance(store, Store):
            self._store = store
        else:
            check_place(store)
        self._series: Series | None = None
        self._told = told
        self._line = Line(most)
        self._writer = Writer(f"epypes {kind}", self._line, self._write)
        self._counts = {"written": 0, "skipped": 0, "unwritten": 0}

    def append(self, key: str, data: Mapping[str, Any]) -> bool:
        """Have a row written; return at once, and whether there was room for it. ``data`` must not change any more."""

        def add(_now_s: float) -> bool:
            fits = self._line.add((key, data))
            self._counts["skipped"] += not fits
            return fits

        return self._writer.put(add)

    def counts(self) -> dict[str, int]:
        """Return how many rows were written, skipped (no room), not to be written as they are, and how many wait."""
        return self._writer.put(lambda _now_s: {**self._counts, "waiting": len(self._line)})

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Have all that waits written now; return whether that was done in time."""
        return self._writer.flush(timeout_s)

    def close(self, timeout_s: float = 5.0) -> bool:
        """Have all that waits written, and close what was opened for it; return whether that was done in time."""
        is_done = self.flush(timeout_s)
        if is_done and self._store is not None and self._store is not self._given:
            self._store.close()
            # What comes later opens it again.
            self._store = self._series = None
        return is_done

    # -- on the thread --------------------------------------------------------------------------------------------

    def _write(self, rows: list[Row]) -> None:
        try:
            unwritten = self._put(rows)
        except StoreError as error:
            if self._writer.put(self._line.failed):
                self._told(f"{error} Rows of {self._kind} {self._name!r} wait for it.")
            return
        if self._writer.put(lambda _now_s: self._done(len(rows), unwritten)):
            _log.info("Rows of %s %r are written again.", self._kind, self._name)

    def _done(self, count: int, unwritten: int) -> bool:
        self._counts["written"] += count - unwritten
        self._counts["unwritten"] += unwritten
        return self._line.done(count)

    def _put(self, rows: list[Row]) -> int:
        """Write rows; return how many are of a kind that can't be written at all."""
        series = self._opened()
        try:
            series.append_all(rows)
        except TypeError:
            return sum(not self._is_put(series, row) for row in rows)
        return 0

    def _is_put(self, series: Series, row: Row) -> bool:
        try:
            series.append(*row)
        except TypeError as error:
            self._told(str(error))
            return False
        return True

    def _opened(self) -> Series:
        if self._series is None:
            if self._store is None:
                self._store = as_store(self._given)
            self._series = self._store.series(self._kind, self._name, about=self._about)
        return self._series
