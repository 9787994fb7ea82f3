"""How is what the hand stopped at kept in a database, from one session to the next?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

from epypes.store import Store, opened_store
from epypes.store.writer import SeriesWriter
from epypes_widgets.history import Entry, History, changed
from epypes_widgets.places import Tunable
from epypes_widgets.plain import plain

if TYPE_CHECKING:
    import pandas as pd

_log = logging.getLogger(__name__)

KIND: Final = "tuning"


# What tells the entries of one history from those of others, which count from 1 too.
_words: WeakKeyDictionary[History, str] = WeakKeyDictionary()


class StoredHistory:
    """Writes each entry of a history to a series, also those that it has already; nobody waits for the database.

    Parameters
    ----------
    runner
        What is tuned.
    store
        A path, a URL or a Store; None to keep nothing.
    name
        Of the series; None for those of the sink tokens.

    Raises
    ------
    StoreError
        There can be no such database.
    """

    def __init__(self, runner: Tunable, store: str | Path | Store | None, name: str | None) -> None:
        self._runner, self._given = runner, store
        self._name = ", ".join(runner.cg.sink_tokens) if name is None else name
        self._told: Callable[[str], object] = _log.warning
        self._writer: SeriesWriter | None = None
        if store is not None:
            self._writer = SeriesWriter(store, KIND, self._name, report=lambda text: self._told(text))
        self._lock = threading.Lock()
        self._last: Entry | None = None
        self._forget: Callable[[], None] | None = None

    def follow(self, history: History, told: Callable[[str], object]) -> None:
        """Write what is committed from now on, and was; ``told`` is called with what goes wrong, on a thread."""
        writer = self._writer
        if writer is None:
            return
        self._told = told
        self._forget = history.watch(lambda _entry: self._write_new(history, writer))
        self._write_new(history, writer)

    def _write_new(self, history: History, writer: SeriesWriter) -> None:
        with self._lock:
            word = _words.setdefault(history, str(time_ns()))
            for entry in history.entries:
                if self._last is None or entry.number > self._last.number:
                    writer.append(f"{word}-{entry.number}", self._row(entry))
                    self._last = entry

    def _row(self, entry: Entry) -> dict[str, Any]:
        return {
            "at": entry.at.isoformat(),
            "values": _plain(entry.values),
            "changed": changed(self._last, entry),
            "total_ms": entry.compute_ms,
            # Of a service's hyperparameters.
            "revision": getattr(self._runner, "revision", None),
            "token": entry.token,
            "image": entry.image,
            "label": entry.label,
        }

    def to_frame(self, timeout_s: float = 5.0) -> pd.DataFrame:
        """Return all that was ever committed under this name, in earlier sessions too, as a pandas table.

        Raises
        ------
        StoreError
            It can't be read.
        RuntimeError
            There is no store.
        """
        with opened_store(self._given) as store:
            if store is None or self._writer is None:
                raise RuntimeError("This panel has no store. Name one: tune(runner, store='history.sqlite').")
            self._writer.flush(timeout_s)
            return store.series(KIND, self._name).to_frame()

    def close(self, timeout_s: float) -> None:
        """Write what waits, and hear of no more."""
        if self._forget is not None:
            self._forget()
        if self._writer is not None:
            self._writer.close(timeout_s)


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as a store takes them, which knows NaN and infinities."""
    return {name: value if isinstance(value, float) else plain(value) for name, value in values.items()}
