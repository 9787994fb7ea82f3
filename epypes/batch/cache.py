"""The cache of results: what a stored result is keyed by, and which results need not be computed again.

A series in a store is of one graph and of the hyperparameters that don't vary. Its name is the one that the user gives,
or the digest of both. An outcome's key is the item's name and content, the values that vary, the tokens that are shown,
and the state of the lists, arrays and objects that functions use; of a graph with state between runs also the content
of all items before it in its series. What can't be digested is never taken from the store.
The trials of a search are those of a study, whose name is given or digested too; it has no keys. No other module
decides what a result of a map, a sweep or a search is stored under.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, Final
from warnings import warn
from weakref import WeakKeyDictionary

from epypes.acquisition.video import Video, VideoFrame
from epypes.batch.cases import Case
from epypes.batch.items import Item, frames_of
from epypes.batch.results import Outcome
from epypes.bundle import to_source
from epypes.bundle.proof.fingerprint import Digester, combined_digest, file_digest, versions_of
from epypes.errors import EpypesError, PlaceholderNeeded, ScaleError, SourceRefused, StoreError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.run.guard import is_plain_array
from epypes.store import Series, Store, opened_store

# What is lost at most if the process is killed; to write each outcome by itself would take longer than to make it.
_WRITE_EVERY_S: Final = 0.5
_SHOWN_CHARACTERS: Final = 60
_SHORT: Final = (type(None), bool, int, float, complex, str)


# -- digests --------------------------------------------------------------------------------------------------------


class NoDigest(TypeError):
    """A value holds, or a function uses, an object whose content can't be digested."""


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """The digests of a graph.

    Attributes
    ----------
    code
        Of functions, classes, modules and immutable values: changes when code is edited.
    state
        Of what is in lists, dicts, arrays and objects that functions use: a call may change it.
    unknown
        The first object whose content can't be digested, as text; "" if there is none. A computation with one may be
        another one although the digests are the same.
    reader
        The first name by which a function reads files or the environment; "" if there is none.
    """

    code: str
    state: str
    unknown: str
    reader: str


def graph_fingerprint(cg: CompGraph) -> Fingerprint:
    """Return the fingerprint of what a graph computes."""
    digester = Digester()
    digester.add(cg)
    # An object whose content can't be digested, as a detector of OpenCV, counts by the expression that makes it.
    source = ""
    if digester.unknown:
        with suppress(SourceRefused, PlaceholderNeeded):
            source = to_source(cg)
    code = combined_digest("graph", source, digester.code.digest(), *versions_of(digester.modules)).hex()
    state = combined_digest("state", digester.state.digest(), *versions_of(digester.state_modules)).hex()
    return Fingerprint(code, state, "" if source else digester.unknown, digester.reader)


def function_digest(function: Any) -> str:
    """Return the digest of a function and of all that it uses; what is installed counts by its name.

    Raises
    ------
    NoDigest
        It uses an object whose content can't be digested, or reads files or the environment.
    """
    return _digest(Digester(), function)


def value_digest(value: Any) -> str:
    """Return the digest of a value: numbers, texts, arrays, files, what a message can carry, objects of own classes.

    Raises
    ------
    NoDigest
        It is, or holds, an object whose content can't be digested.
    """
    return _digest(Digester(of_data=True), value)


def _digest(digester: Digester, value: Any) -> str:
    digester.add(value)
    if digester.unknown or digester.reader:
        raise NoDigest(digester.unknown or reader_text(digester.reader))
    return digester.digest().hex()


def reader_text(name: str) -> str:
    """Return what a function reads from outside, for messages."""
    return f"a function that reads files or the environment ({name!r})"


def payload_digest(payload: Mapping[str, Any]) -> str:
    """Return the digest of a payload: of every token the content of the file, wherever it is, or the value.

    Of a frame of a video it is the content of the video with the number of the frame, so that what is stored is found
    without decoding.

    Raises
    ------
    NoDigest
        A file can't be read, or the content of a value can't be digested.
    """
    parts: list[str] = []
    for token, value in sorted(payload.items()):
        if isinstance(value, VideoFrame):
            digest = _frame_digest(value)
        else:
            digest = file_digest(value) if isinstance(value, Path) else value_digest(value)
        if not digest:
            raise NoDigest(f"{str(value)!r}, which can't be read")
        parts += token, digest
    return combined_digest("payload", *parts).hex()


def _content_digest(item: Item, runner: CompGraphRunner) -> str:
    """Return the digest of an item's payload, or of those of its frames; NoDigest as `payload_digest`."""
    if item.frames is None:
        return payload_digest(item.payload)
    return combined_digest("frames", *(payload_digest(frame.payload) for frame in frames_of(item, runner))).hex()


# Of videos that are open, since each of their frames asks for it.
_VIDEO_DIGESTS: Final[WeakKeyDictionary[Video, str]] = WeakKeyDictionary()


def _frame_digest(frame: VideoFrame) -> str:
    video = frame.video
    if video not in _VIDEO_DIGESTS:
        video.require_unchanged()
        _VIDEO_DIGESTS[video] = file_digest(video.path)
    file = _VIDEO_DIGESTS[video]
    return combined_digest("frame", file, str(frame.number)).hex() if file else ""


def value_label(value: Any) -> str:
    """Return a value as a person reads it, with its digest if that does not say all.

    Raises
    ------
    NoDigest
        As for `value_digest`.
    """
    digest = value_digest(value)
    if _is_short(value) and len(text := repr(value)) <= _SHOWN_CHARACTERS:
        return text
    what = f"{value.dtype} {value.shape}" if is_plain_array(value) else type(value).__name__
    return f"{value if isinstance(value, enum.Enum) else what} {digest}"


def _is_short(value: Any) -> bool:
    if type(value) in (tuple, list):
        return len(value) <= _SHOWN_CHARACTERS and all(map(_is_short, value))
    # A long number takes long to write, and Python refuses to write one that is too long.
    return type(value) in _SHORT and not (type(value) is int and value.bit_length() > _SHOWN_CHARACTERS * 4)


# -- searches -------------------------------------------------------------------------------------------------------


class SearchKey:
    """What the trials of a search are stored under: the name of their study, and what the study searches.

    Parameters
    ----------
    title
        What a name that is computed begins with.
    name
        The name that the user gives; "" computes one.
    runner
        Its graph and the hyperparameters that do not vary are compared.
    metric
        The function that measures a run, or the name of a token.
    choices
        By token of what varies, the values; None of a range.
    items, cases
        The inputs, and the cases with their labels.
    readable
        What else decides about trials, such as ranges: texts by what they are of.

    Attributes
    ----------
    name
        The name of the study.
    about
        By what they are of, the readable texts, and digests; "" where there is none.

    Raises
    ------
    ScaleError
        Something has no digest, and the search no name.
    """

    def __init__(
        self,
        title: str,
        name: str,
        runner: CompGraphRunner,
        metric: Any,
        choices: Mapping[str, Any],
        items: Sequence[Item],
        cases: Sequence[Case],
        readable: Mapping[str, str],
    ) -> None:
        fixed = {token: value for token, value in runner.hyperparameters.items() if token not in choices}
        labels = [(case.name, dict(case.expected or {}), dict(case.hyperparameters or {})) for case in cases]
        self._readable = readable
        self._code: dict[str, Callable[[], str]] = {
            "graph": lambda: _graph_digest(runner.cg),
            "metric": lambda: "token" if isinstance(metric, str) else function_digest(metric),
        }
        data: dict[str, Callable[[], str]] = {
            "hyperparameters": lambda: value_digest((fixed, choices)),
            "inputs of the cases": lambda: value_digest([(item.name, _content_digest(item, runner)) for item in items]),
            "labels of the cases": lambda: value_digest(labels),
        }
        self.about = {**readable, **_digests({**self._code, **data}, is_named=bool(name))}
        self.name = name or f"{title} {combined_digest('search', repr(sorted(self.about.items()))).hex()[:12]}"

    def difference(self, before: Mapping[str, str]) -> str:
        """Return how a study differs from this search by what it is about; "" if it is the same search."""
        found = []
        for what, now in self.about.items():
            was = before.get(what, "unknown")
            if now and was and now != was:
                found.append(f"{what}: {was:.200}" if what in self._readable else f"other {what}")
        return ", ".join(found)

    def changed(self) -> list[str]:
        """Return what has another digest by now, as a function that notes its calls in a list."""
        return [what for what, digest in _digests(self._code, is_named=True).items() if digest != self.about[what]]


def _graph_digest(cg: CompGraph) -> str:
    found = graph_fingerprint(cg)
    if found.unknown or found.reader:
        raise NoDigest(found.unknown or reader_text(found.reader))
    return combined_digest("graph", found.code, found.state).hex()


def _digests(ways: Mapping[str, Callable[[], str]], *, is_named: bool) -> dict[str, str]:
    """Return digests by what they are of; what has none has "" in a search with a name."""
    digests = {}
    for what, way in ways.items():
        try:
            digests[what] = way()
        except (EpypesError, NoDigest) as error:
            if not is_named:
                text = f"The search has no name for the store, and one can't be computed from its {what}: {error}"
                raise ScaleError(f"{text}.\nGive one: name='...'.") from error
            digests[what] = ""
    return digests


# -- series ---------------------------------------------------------------------------------------------------------


@contextmanager
def outcome_cache(
    store: str | Path | Store | None,
    kind: str,
    runner: CompGraphRunner,
    name: str | None,
    *,
    keep: Sequence[str] = (),
    show: Sequence[str] | None = (),
    settings: Sequence[Mapping[str, Any]],
    state: Mapping[str, Any] | None = None,
    is_read: bool = True,
) -> Iterator[OutcomeCache | None]:
    """Open the series of a runner's outcomes; what waits to be written is written at the end.

    Parameters
    ----------
    store
        Path, URL or ``ep.Store``; None: there is no cache.
    kind
        ``"map"`` or ``"sweep"``.
    runner
        Its graph and hyperparameters are what the series is of.
    name
        What the series is called; a digest of graph and hyperparameters without.
    keep
        Tokens whose whole values are wanted. They are not in the store, so with one everything is run.
    show
        Tokens of which thumbnails are made.
    settings
        The hyperparameters of which each outcome has its own values, by token.
    state
        What each series of items begins with; None of a graph without state between runs.
    is_read
        Whether outcomes may be taken from the store.

    Warns
    -----
    UserWarning
        Nothing that is stored counts, since the graph uses an object whose content can't be digested, or, without a
        name, reads files or the environment.

    Raises
    ------
    ScaleError
        The series is of another graph or of other hyperparameters.
    """
    with opened_store(store) as opened:
        if opened is None:
            yield None
            return
        found = graph_fingerprint(runner.cg)
        fixed = {token: value for token, value in runner.hyperparameters.items() if token not in settings[0]}
        about = {"graph": found.code, "hyperparameters": _hyperparameter_labels(fixed)}
        own_name = combined_digest(found.code, repr(about["hyperparameters"])).hex()[:16]
        series = opened.series(kind, name or own_name, about=about)
        _check_same(series, about)
        doubt = _doubt(found, has_name=bool(name))
        if doubt:
            warn(doubt, stacklevel=5)
        shown = "" if show == () else f"show={show and list(show)}"
        reads = is_read and not keep and not doubt
        cache = OutcomeCache(series, settings, f"{shown} state={found.state}", reads=reads, state=state)
        try:
            yield cache
        except BaseException as error:  # that is what is raised, whatever the store does
            try:
                cache.write()
            except StoreError as failed:
                if error is not failed:
                    error.add_note(f"What waited to be stored could not be: {failed}")
            raise
        cache.write()


def _doubt(found: Fingerprint, *, has_name: bool) -> str:
    """Return why stored outcomes may be those of another computation; "" if they can't be."""
    if found.unknown:
        text = f"The graph uses {found.unknown}, whose content can't be compared: every item is run again."
        return f"{text} Use functions, numbers, texts, arrays, or objects that can be pickled."
    if found.reader and not has_name:
        text = f"The graph uses {reader_text(found.reader)}, which may have changed: every item is run again."
        return f"{text} To reuse what is stored, give name=, and another name once such a file or variable has changed."
    return ""


def _hyperparameter_labels(values: Mapping[str, Any]) -> dict[str, str]:
    labels: dict[str, str] = {}
    for token, value in values.items():
        try:
            labels[token] = value_label(value)
        except NoDigest as error:
            text = f"Hyperparameter {token!r} is or holds {error}, whose content a store can't compare with another."
            raise ScaleError(f"{text} Make it of numbers, texts, arrays, lists or dicts.") from error
    return labels


def _check_same(series: Series, about: Mapping[str, Any]) -> None:
    before = series.about
    was, now = before.get("hyperparameters", {}), about["hyperparameters"]
    changed = [token for token in {**was, **now} if was.get(token) != now.get(token)]
    if not changed and before.get("graph") == about["graph"]:
        return
    changes = ", ".join(f"{token} was {was.get(token, 'free')} and is {now.get(token, 'free')}" for token in changed)
    raise ScaleError(
        f"Series {series.name!r} in the store is of another computation: {changes or 'the graph has changed'}. "
        "Give another name=, or none."
    )


def _setting_label(setting: Mapping[str, Any]) -> str:
    """Return the values of a setting as a part of a key; "" if one has no digest."""
    try:
        return repr({token: value_label(value) for token, value in setting.items()})
    except NoDigest:
        return ""


class OutcomeCache:
    """The outcomes of a series; new ones are written a few at a time.

    Parameters
    ----------
    series
        The series.
    settings
        With which items are run.
    suffix
        What else than the item and its setting decides about an outcome.
    reads
        Whether outcomes are taken from the series.
    state
        What each series of items begins with; None of a graph without state between runs.

    Notes
    -----
    An item whose content can't be digested is run each time, and not written; of a graph with state, neither are those
    after it in its series.
    """

    def __init__(
        self,
        series: Series,
        settings: Sequence[Mapping[str, Any]],
        suffix: str = "",
        *,
        reads: bool = True,
        state: Mapping[str, Any] | None = None,
    ) -> None:
        self._series, self._settings, self._suffix = series, settings, suffix
        self._known = series.keys() if reads else frozenset()
        self._labels = [_setting_label(setting) for setting in settings]
        self._keys: dict[tuple[int, int], str] = {}
        self._waiting: list[tuple[str, dict[str, Any]]] = []
        self._written_s = monotonic()
        self._state = state
        # Of each series of items, the digest of those that were looked for and of the state before them; "" if one has
        # none.
        self._prefixes: dict[Hashable, str] = {}

    @property
    def has_outcomes(self) -> bool:
        """Whether there are outcomes that can be taken."""
        return bool(self._known)

    def noting(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield items that are all to be run; their outcomes can then be added."""
        for item in items:
            self.found(item)
            yield item
            del item

    def found(self, item: Item) -> list[Outcome | None]:
        """Return the stored outcomes of an item, by setting; None for those that have to be run.

        Of a graph with state, the items of a series are to be looked for in their order.
        """
        try:
            of_item = f"{item.name} {self._digest_of(item)} {self._suffix}"
        except NoDigest:
            return [None for _ in self._settings]
        outcomes: list[Outcome | None] = []
        for setting, label in zip(self._settings, self._labels, strict=True):
            key = f"{of_item} {label}"
            stored = self._series.get(key) if label and key in self._known else None
            outcomes.append(None if stored is None else Outcome.from_json(stored, item, setting))
            if label and stored is None:
                self._keys[item.number, id(setting)] = key
        return outcomes

    def _digest_of(self, item: Item) -> str:
        """Return the digest of what decides about an item's outcome: its payload, and with state those before it.

        Raises
        ------
        NoDigest
            One of these has none.
        """
        if self._state is None:
            return payload_digest(item.payload)
        before, self._prefixes[item.series] = self._prefixes.get(item.series), ""
        before = value_digest(dict(self._state)) if before is None else before
        if not before:
            raise NoDigest("an item before it in its series")
        self._prefixes[item.series] = digest = combined_digest("item", before, payload_digest(item.payload)).hex()
        return digest

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Take outcomes of items that had to be run."""
        for outcome in outcomes:
            key = self._keys.pop((outcome.number, id(outcome.setting)), None)
            # A file that could not be read may be there the next time.
            if key is not None and (outcome.error_info is None or outcome.error_info.function):
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
        self._series.append_all(self._waiting)
        self._waiting.clear()
        self._written_s = monotonic()
