"""Which items have been run before, so that they need not be run again?"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import Any, Final, Self
from warnings import warn

from epypes.batch.digests import Untold, digest_of, file_digest, joined, told
from epypes.batch.fingerprint import Fingerprint, graph_fingerprint
from epypes.batch.items import Item
from epypes.batch.outcome import Outcome
from epypes.bundle import to_source
from epypes.errors import PlaceholderNeeded, ScaleError, SourceRefused, StoreError
from epypes.run import CompGraphRunner
from epypes.store import Series, Store

# What is lost at most if the process is killed; to write each outcome by itself would take longer than to make it.
_WRITE_EVERY_S: Final = 0.5
_NONE: Final[Mapping[str, Any]] = MappingProxyType({})


def series_of(
    store: Store, kind: str, runner: CompGraphRunner, name: str | None, varied: Collection[str] = ()
) -> tuple[Series, Fingerprint]:
    """Return the series in which outcomes of a runner are kept, and the fingerprint of its graph.

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
    varied
        The hyperparameters that each outcome has its own values of.

    Warns
    -----
    UserWarning
        A function uses something that can't be seen through, so nothing that is stored counts.

    Raises
    ------
    ScaleError
        There is no name and the graph can't be written as text; or the series is of another graph or of other
        hyperparameters.
    """
    fixed = {token: value for token, value in runner.hyperparameters.items() if token not in varied}
    source, hyperparameters = _source_of(runner), _hyperparameters(fixed)
    found = graph_fingerprint(runner.cg, source)
    if name is None:
        if source is None:
            text = "What this graph computes can't be written as text, which would tell it from others. Give name=."
            raise ScaleError(text)
        name = _digest(found.code, repr(hyperparameters))[:16]
    about = {"graph": found.code, "hyperparameters": hyperparameters}
    series = store.series(kind, name, about=about)
    _check_same(series, about)
    if found.unknown:
        text = f"The graph uses {found.unknown}, and nothing tells whether that has changed: every item is run again."
        warn(f"{text} Use functions, numbers, texts, arrays, or objects that can be pickled.", stacklevel=4)
    return series, found


def _source_of(runner: CompGraphRunner) -> str | None:
    try:
        return to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        return None


def _texts_of(values: Mapping[str, Any]) -> dict[str, str]:
    return {token: told(value) for token, value in values.items()}


def _hyperparameters(values: Mapping[str, Any]) -> dict[str, str]:
    found: dict[str, str] = {}
    for token in values:
        try:
            found |= _texts_of({token: values[token]})
        except Untold as error:
            text = f"Hyperparameter {token!r} is or holds {error}: nothing tells it from others, as a store has to."
            raise ScaleError(f"{text} Make it of numbers, texts, arrays, lists or dicts.") from error
    return found


def _digest(*texts: str) -> str:
    return joined("", *texts).hex()


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
    fingerprint
        That of the graph. Outcomes of another state don't count, and none does if it has an unknown.

    Notes
    -----
    An item is known again by its name and by what is in its files and values. One that holds something of which nobody
    can say what is in it is run each time, and not written.
    """

    def __init__(
        self, series: Series, how: str = "", are_whole: bool = True, fingerprint: Fingerprint | None = None
    ) -> None:
        self._series, self._how = series, how
        if fingerprint is not None:
            self._how = f"{how} state={fingerprint.state}"
            are_whole = are_whole and not fingerprint.unknown
        self._known = series.keys() if are_whole else frozenset()
        self._keys: dict[tuple[int, int], str] = {}
        self._of_item: tuple[int, str | None] = -1, None
        # With the settings themselves, so that no other has the identity of one.
        self._of_settings: dict[int, tuple[Mapping[str, Any], str | None]] = {id(_NONE): (_NONE, "")}
        self._waiting: list[tuple[str, dict[str, Any]]] = []
        self._written_s = monotonic()

    def recall(self, item: Item, setting: Mapping[str, Any] = _NONE) -> Outcome | None:
        """Return the outcome of an item, under a setting, that was run before; None if it has to be run."""
        of_item, of_setting = self._item_text(item), self._setting_text(setting)
        if of_item is None or of_setting is None:
            return None
        key = f"{of_item} {self._how}{of_setting}"
        found = self._series.get(key) if key in self._known else None
        if found is None:
            self._keys[item.number, id(setting or _NONE)] = key
            return None
        return replace(Outcome.from_json(found), number=item.number, name=item.name, setting=setting)

    def _item_text(self, item: Item) -> str | None:
        if self._of_item[0] != item.number:
            self._of_item = item.number, _told(lambda: f"{item.name} {contents_of(item.payload)}")
        return self._of_item[1]

    def _setting_text(self, setting: Mapping[str, Any]) -> str | None:
        setting = setting or _NONE
        if id(setting) not in self._of_settings:
            self._of_settings[id(setting)] = setting, _told(lambda: f" {_texts_of(setting)}")
        return self._of_settings[id(setting)][1]

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Take outcomes of items that had to be run."""
        for outcome in outcomes:
            key = self._keys.pop((outcome.number, id(outcome.setting or _NONE)), None)
            # A file that could not be read may be there the next time.
            if key is not None and (outcome.trouble is None or outcome.trouble.function):
                self._waiting.append((key, outcome.to_json()))
        if monotonic() - self._written_s >= _WRITE_EVERY_S:
            self.write()

    def write(self) -> None:
        """Write what waits.

        Raises
        ------
        StoreError
            The store can't be written; then it still waits.
        """
        try:
            self._series.append_all(self._waiting)
            self._waiting.clear()
        except TypeError:
            # All or none are written, and one of them can't be.
            self._write_each()
        self._written_s = monotonic()

    def _write_each(self) -> None:
        while self._waiting:
            try:
                self._series.append(*self._waiting[0])
            except TypeError as error:
                warn(f"{error} It is run again the next time.", stacklevel=2)
            del self._waiting[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Write what waits; if something else has gone wrong before, that is what is raised."""
        try:
            self.write()
        except StoreError as failed:
            if error is None:
                raise
            if error is not failed:
                error.add_note(f"What waited to be stored could not be: {failed}")


def _told(what: Callable[[], str]) -> str | None:
    try:
        return what()
    except Untold:
        return None


def contents_of(payload: Mapping[str, Any]) -> str:
    """Return what tells a payload from others: of every token the file's contents, or the value.

    Raises
    ------
    Untold
        A file can't be read, or nobody can say what is in a value.
    """
    parts = (
        (token, file_digest(value) if isinstance(value, Path) else digest_of(value))
        for token, value in sorted(payload.items())
    )
    return joined("payload", *(text for part in parts for text in part)).hex()
