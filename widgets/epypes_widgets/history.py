"""The history of a runner: the values that were committed, undo and redo, and a store that keeps them."""

from __future__ import annotations

import copy
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from time import time_ns
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast
from weakref import WeakKeyDictionary

from epypes.display import Picture
from epypes.optional import optional_import
from epypes.store import Store, opened_store
from epypes.store.writer import SeriesWriter
from epypes_widgets.session import Tunable
from epypes_widgets.values import change_text, differing, json_value

if TYPE_CHECKING:
    import pandas as pd

    from epypes_widgets.history_table import HistoryTable

_MAX_ENTRIES: Final = 1_000
_KIND: Final = "tuning"
_histories: WeakKeyDictionary[Tunable, History] = WeakKeyDictionary()
_lock = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """Values that were committed; entries are compared by identity, since values may be arrays.

    Attributes
    ----------
    number
        From 1, rising.
    values
        By hyperparameter; read-only.
    at
        When, to the second, with the time zone of this machine.
    token
        The token that was shown; None if none was.
    picture
        Its thumbnail, or None.
    compute_ms
        How long the run took; None if it is not known.
    label
        A word of the user's or the panel's on it; may be empty.
    image
        Which of the panel's images it was computed on, from 0; None if it has no list of them.
    left
        The number of the entry that was left for it; 0 for the first.
    """

    number: int
    values: Mapping[str, Any]
    at: datetime
    token: str | None = None
    picture: Picture | None = field(default=None, repr=False)
    compute_ms: float | None = None
    label: str = ""
    image: int | None = None
    left: int = 0


class History:
    """The committed values of a runner, in the order in which they were committed; may be used from any thread.

    Undo and redo walk along a path. A commit after an undo cuts off the path ahead; the entries that were on it stay
    in ``entries`` and can be gone to.

    Parameters
    ----------
    limit
        How many entries are kept; the oldest are dropped.

    Examples
    --------
    >>> history = History()
    >>> for threshold in (70, 70, 90):
    ...     entry = history.commit({"threshold": threshold})
    >>> len(history), history.can_undo
    (2, True)
    >>> dict(history.undo().values)
    {'threshold': 70}
    """

    def __init__(self, limit: int = _MAX_ENTRIES) -> None:
        self.limit = limit
        self._lock = threading.RLock()
        self._entries: tuple[Entry, ...] = ()
        self._path: tuple[Entry, ...] = ()
        self._place = -1
        self._committed = 0
        self._watchers: tuple[Callable[[Entry], object], ...] = ()

    def watch(self, callback: Callable[[Entry], object]) -> Callable[[], None]:
        """Call something with each entry that is added or gone to, on that thread; return what ends that."""

        def forget() -> None:
            with self._lock:
                self._watchers = tuple(watcher for watcher in self._watchers if watcher is not callback)

        with self._lock:
            self._watchers = (*self._watchers, callback)
        return forget

    def commit(self, values: Mapping[str, Any], *, image: int | None = None, **about: Any) -> Entry | None:
        """Add an entry and make it the current one.

        Parameters
        ----------
        values, image
            As in ``Entry``.
        about
            What else ``Entry`` has: token, picture, compute_ms, label.

        Returns
        -------
        Entry or None
            None if values and image are those of the current entry: nothing is added then.
        """
        with self._lock:
            current = self.current
            if current is not None and current.image == image and not differing(current.values, values):
                return None
            # The user may write to a list or dict later.
            mutable = (list, dict, set)
            kept = {name: copy.copy(value) if type(value) in mutable else value for name, value in values.items()}
            self._committed += 1
            now = datetime.now().astimezone().replace(microsecond=0)
            left = 0 if current is None else current.number
            entry = Entry(self._committed, MappingProxyType(kept), now, image=image, left=left, **about)
            self._entries = (*self._entries, entry)[-self.limit :]
            oldest = self._entries[0].number
            walked = self._path[: self._place + 1]
            self._path = (*(old for old in walked if old.number >= oldest), entry)
            self._place = len(self._path) - 1
        return self._report(entry)

    def undo(self) -> Entry | None:
        """Go one entry back and return it; None if there is none."""
        return self._step(-1)

    def redo(self) -> Entry | None:
        """Go one entry on and return it; None if there is none."""
        return self._step(1)

    def goto(self, number: int) -> Entry:
        """Go to an entry and return it. One that is no longer on the path becomes its end.

        Raises
        ------
        LookupError
            There is none of this number.
        """
        with self._lock:
            entry = next((entry for entry in self._entries if entry.number == number), None)
            if entry is None:
                known = f"has {self._entries[0].number} to {self._entries[-1].number}" if self._entries else "is empty"
                raise LookupError(f"No entry {number!r} in this history. It {known}.")
            if entry not in self._path:
                self._path = (*self._path[: self._place + 1], entry)
            self._place = self._path.index(entry)
        return self._report(entry)

    @property
    def current(self) -> Entry | None:
        """The entry that was committed or gone to last; None before the first."""
        with self._lock:
            return self._path[self._place] if self._path else None

    @property
    def can_undo(self) -> bool:
        """Whether there is an entry to go back to."""
        return self._place > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is an entry to go on to."""
        with self._lock:
            return self._place < len(self._path) - 1

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries that are kept, the oldest first, wherever undo and redo lead."""
        return self._entries

    def left_for(self, entry: Entry) -> Entry | None:
        """Return the entry that was left for another; None for the first, and if it is no longer kept."""
        return next((each for each in self._entries if each.number == entry.left), None)

    def to_frame(self) -> HistoryTable:
        """Return a pandas table by number that shows its thumbnails in a notebook.

        Its columns are the hyperparameters, then at, token, image, compute_ms, label and picture; if a hyperparameter
        is called like one of these, the latter has an underscore after its name.
        """
        with optional_import():
            from epypes_widgets.history_table import table_of

        return table_of(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def _step(self, by: int) -> Entry | None:
        with self._lock:
            if not 0 <= self._place + by < len(self._path):
                return None
            self._place += by
            entry = self._path[self._place]
        return self._report(entry)

    def _report(self, entry: Entry) -> Entry:
        for watcher in self._watchers:
            watcher(entry)
        return entry


def history_of(runner: Tunable) -> History:
    """Return the history of a runner: the same for all its panels, so that a cell that runs again goes on with it."""
    with _lock:
        return _histories.setdefault(runner, History())


def changed(before: Entry | None, after: Entry, frames: Sequence[int] | None = None, most: int = 3) -> str:
    """Return what an entry has changed, as ``"canny_lo 70 -> 90, blur 3 -> 5"``; empty for the first.

    ``frames``: the numbers of the frames, where the images are those of a video. ``most``: so many names at most.
    """
    if before is None:
        return ""
    # As they are counted on the screen.
    numbers = range(1, sys.maxsize) if frames is None else frames
    one, other = (
        "-" if entry.image is None or entry.image >= len(numbers) else numbers[entry.image] for entry in (before, after)
    )
    moved = f"{'image' if frames is None else 'frame'} {one} -> {other}" if one != other else ""
    return ", ".join(filter(None, (change_text(before.values, after.values, most), moved)))


# The prefix of the row keys of a history: the entries of every history count from 1.
_prefixes: WeakKeyDictionary[History, str] = WeakKeyDictionary()


class StoredHistory:
    """Writes each entry of a history to a series, also those that it has already; nothing waits for the database.

    Parameters
    ----------
    runner
        What is tuned.
    store
        A path, a URL or a Store.
    name
        Of the series; None for those of the sink tokens.
    history
        Its entries are written.
    failed
        Is called with a text on what goes wrong, on a thread.

    Raises
    ------
    StoreError
        There can be no such database.
    """

    def __init__(
        self,
        runner: Tunable,
        store: str | Path | Store,
        name: str | None,
        history: History,
        failed: Callable[[str], object],
    ) -> None:
        self._runner, self._store, self._history = runner, store, history
        self._name = ", ".join(runner.cg.sink_tokens) if name is None else name
        self._writer = SeriesWriter(store, _KIND, self._name, report=failed)
        self._lock = threading.Lock()
        self._last: Entry | None = None
        self._forget = history.watch(lambda _entry: self._write_new())
        self._write_new()

    def to_frame(self, timeout_s: float = 5.0) -> pd.DataFrame:
        """Return all that was ever committed under this name, in earlier sessions too, as a pandas table.

        Raises
        ------
        StoreError
            It can't be read.
        """
        with opened_store(self._store) as store:
            self._writer.flush(timeout_s)
            return cast(Store, store).series(_KIND, self._name).to_frame()

    def close(self, timeout_s: float) -> None:
        """Write what waits, and nothing more."""
        self._forget()
        self._writer.close(timeout_s)

    def _write_new(self) -> None:
        with self._lock:
            prefix = _prefixes.setdefault(self._history, str(time_ns()))
            for entry in self._history.entries:
                if self._last is None or entry.number > self._last.number:
                    self._writer.append(f"{prefix}-{entry.number}", self._row(entry))
                    self._last = entry

    def _row(self, entry: Entry) -> dict[str, Any]:
        # A store knows NaN and infinities, JSON does not.
        values = {name: v if isinstance(v, float) else json_value(v) for name, v in entry.values.items()}
        return {
            "at": entry.at.isoformat(),
            "values": values,
            "changed": changed(self._history.left_for(entry), entry),
            "total_ms": entry.compute_ms,
            # Of a service's hyperparameters.
            "revision": getattr(self._runner, "revision", None),
            "token": entry.token,
            "image": entry.image,
            "label": entry.label,
        }
