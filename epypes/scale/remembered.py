"""Which items have been run before, so that they need not be run again?"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from time import monotonic
from typing import Any, Final

from epypes.bundle import to_source
from epypes.errors import PlaceholderNeeded, ScaleError, SourceRefused
from epypes.run import CompGraphRunner
from epypes.run.guard import is_plain_array
from epypes.scale.items import Item
from epypes.scale.outcome import Outcome
from epypes.store import Series, Store

# What is lost at most if the process is killed; to write each outcome by itself would take longer than to make it.
_WRITE_EVERY_S: Final = 0.5


def series_of(store: Store, kind: str, runner: CompGraphRunner, name: str | None) -> Series:
    """Return the series in which outcomes of a runner are kept.

    Parameters
    ----------
    store
        Where it is.
    kind
        ``"map"``, or what else made the outcomes.
    runner
        Its graph and hyperparameters are what the series is of.
    name
        What it is called; a digest of graph and hyperparameters without.

    Raises
    ------
    ScaleError
        There is no name and the graph can't be written as text; or the series is of another graph or of other
        hyperparameters.
    """
    source, hyperparameters = _source_of(runner), _texts_of(runner.hyperparameters)
    if name is None:
        if source is None:
            text = "What this graph computes can't be written as text, which would tell it from others. Give name=."
            raise ScaleError(text)
        name = _digest(source, repr(hyperparameters))[:16]
    about = {"graph": "" if source is None else _digest(source), "hyperparameters": hyperparameters}
    series = store.series(kind, name, about=about)
    _check_same(series, about)
    return series


def _source_of(runner: CompGraphRunner) -> str | None:
    try:
        return to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        return None


def _texts_of(values: Mapping[str, Any]) -> dict[str, str]:
    return {token: _text_of(value) for token, value in values.items()}


def _text_of(value: Any) -> str:
    if is_plain_array(value):
        return f"{value.dtype} {value.shape} {content_of(value)}"
    return repr(value)


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode("utf-8", "surrogatepass")).hexdigest()


def _check_same(series: Series, about: Mapping[str, Any]) -> None:
    before = series.about
    was, now = before.get("hyperparameters", {}), about["hyperparameters"]
    changed = [token for token in {**was, **now} if was.get(token) != now.get(token)]
    if not changed and before.get("graph") == about["graph"]:
        return
    told = ", ".join(f"{token} was {was.get(token, 'free')} and is {now.get(token, 'free')}" for token in changed)
    raise ScaleError(
        f"Series {series.name!r} in the store is of another computation: {told or 'the graph has changed'}. "
        "Give another name=, or none."
    )


class Remembered:
    """The outcomes of a series; new ones are written a few at a time.

    Parameters
    ----------
    series
        The series.
    how
        What else decides about an outcome, such as the tokens of which thumbnails are made.
    are_whole
        Whether all that is wanted of an outcome is in the store; whole values of tokens are not.
    """

    def __init__(self, series: Series, how: str = "", are_whole: bool = True) -> None:
        self._series, self._how = series, how
        self._known = series.keys() if are_whole else frozenset()
        self._keys: dict[int, str] = {}
        self._waiting: list[tuple[str, dict[str, Any]]] = []
        self._written_s = monotonic()

    def recall(self, item: Item) -> Outcome | None:
        """Return the outcome of an item that was run before; None if it has to be run."""
        key = f"{item.name} {item.stamp or _contents_of(item.payload)} {self._how}"
        found = self._series.get(key) if key in self._known else None
        if found is None:
            self._keys[item.number] = key
            return None
        return replace(Outcome.from_json(found), number=item.number, name=item.name)

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Take outcomes of items that had to be run."""
        for outcome in outcomes:
            key = self._keys.pop(outcome.number)
            # A file that could not be read may be there the next time.
            if outcome.trouble is None or outcome.trouble.function:
                self._waiting.append((key, outcome.to_json()))
        if monotonic() - self._written_s >= _WRITE_EVERY_S:
            self.write()

    def write(self) -> None:
        """Write what waits."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._series.append_all(waiting)
        self._written_s = monotonic()


def _contents_of(payload: Mapping[str, Any]) -> str:
    return _digest(*(f"{token}={_text_of(value)}" for token, value in payload.items()))[:32]


def content_of(array: Any) -> str:
    """Return a digest of what is in an array."""
    import numpy as np

    return hashlib.blake2b(np.ascontiguousarray(array).view(np.uint8).data, digest_size=16).hexdigest()
