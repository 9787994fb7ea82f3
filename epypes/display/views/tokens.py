"""The tokens of a view: their states, their previews, and which of them get a thumbnail."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakKeyDictionary, ref

from epypes.display.previews import THUMBNAIL_BYTES, Look, Preview, Sketch
from epypes.display.previews.images import Range
from epypes.display.previews.introspection import is_in_users_code
from epypes.display.previews.preview import finished, is_shown_by_user, sketch, users_functions
from epypes.display.text import MOST_THUMBNAILS, THUMBNAIL_CHARACTERS
from epypes.display.views.graphview import GraphView, TokenState, TokenView
from epypes.display.views.surroundings import RunSurroundings
from epypes.nothing import NothingType
from epypes.optional import LazyModule
from epypes.run import Run
from epypes.run.program import Program
from epypes.run.staleness import NOT_COMPUTED, is_same_value

# What a picture of so few bytes shows is hardly seen; rather are some left out.
_LEAST_BYTES: Final = 1_500
_ELEMENT_CHARACTERS: Final = 150
_POINT_CHARACTERS: Final = 12

if TYPE_CHECKING:
    import numpy as np
else:
    np = LazyModule("numpy")


_SCALARS: Final = frozenset({int, float, complex, bool, type(None), NothingType})
_SHORT_TEXT: Final = 200

Rank = Callable[[str], Any]


class _TokenPreview:
    """The preview of a token's value, and its thumbnail once that was made.

    Attributes
    ----------
    brief
        The preview without a thumbnail.
    is_drawable
        Whether it may get one.
    is_image
        Whether the value is an image.
    sketch
        Refers to the value's memory, so it is forgotten once a picture is painted.
    is_constant
        Whether the value can't be changed, and the preview is made of nothing else: such a preview may be kept. A
        payload is not constant, since its owner may fill it again.
    """

    __slots__ = (
        "_made",
        "_range",
        "_reference",
        "_revision",
        "brief",
        "is_constant",
        "is_drawable",
        "is_image",
        "sketch",
    )

    def __init__(self, value: Any, look: Look) -> None:
        self.sketch: Sketch | None = (sketched := sketch(value, look))
        self.brief, self.is_drawable, self.is_image = sketched.shown, sketched.may_be_drawn, sketched.is_image
        self._made: tuple[Preview, int] | None = None
        self._range: Range | None = None
        self._reference: Callable[[], Any] = lambda: value
        self._revision = users_functions.revision
        is_locked = self.is_image and is_locked_array(value)
        if is_locked:
            # A preview that is kept keeps no array.
            self._reference, self._range = ref(value), look.around.range_of(value)
        is_scalar = type(value) in _SCALARS or (type(value) is str and len(value) <= _SHORT_TEXT)
        self.is_constant = (is_locked or is_scalar) and not is_in_users_code() and not is_shown_by_user(type(value))

    def is_of(self, value: Any, look: Look) -> bool:
        """Whether it is the preview of this value, as it is looked at now: in this range, by these functions."""
        if self._reference() is not value or self._revision != users_functions.revision:
            return False
        return self._range is None or self._range == look.around.range_of(value)

    def finished(self, value: Any, look: Look, most_bytes: int) -> Preview:
        """Return the preview with a thumbnail of at most so many bytes."""
        made = self._made
        if made is None or made[1] != most_bytes:
            self._made = made = finished(self.sketch or sketch(value, look), most_bytes), most_bytes
        return made[0]


def is_locked_array(array: Any) -> bool:
    """Whether no part of an array can be written, through whatever array that has its memory."""
    while type(array) is np.ndarray:
        if array.flags.writeable:
            return False
        array = array.base
    return array is None


# By name, and by whether it is of a hyperparameter's first value.
_Kept = dict[tuple[str, bool], _TokenPreview]
_kept: WeakKeyDictionary[Program, _Kept] = WeakKeyDictionary()


class _Found(NamedTuple):
    shown: _TokenPreview
    value: Any
    look: Look


def _find(kept: _Kept, key: tuple[str, bool], value: Any, look: Look) -> _Found:
    """Look at a value, if its preview is not kept."""
    shown = kept.get(key)
    if shown is None or not shown.is_of(value, look):
        shown = _TokenPreview(value, look)
        if shown.is_constant:
            kept[key] = shown
    return _Found(shown, value, look)


class Room(NamedTuple):
    """How many thumbnails a picture has at most, and how many characters they take together."""

    thumbnails: int = MOST_THUMBNAILS
    characters: int = THUMBNAIL_CHARACTERS


ROOM: Final = Room()


class HyperparameterValues(NamedTuple):
    """The values of hyperparameters by token, and those that they had first."""

    values: Mapping[str, Any]
    first: Mapping[str, Any] = {}


def token_views(
    structure: GraphView,
    hparams: HyperparameterValues,
    state_of: Callable[[str], TokenState],
    room: Room,
    targets: Collection[str] = (),
    run: Run | None = None,
) -> tuple[tuple[TokenView, ...], int]:
    """Look at hyperparameters and, if there is one, at the values of a run.

    Of a run sink tokens get a thumbnail first, then source tokens that are images, then what the run made, then the
    others. What can't have changed since the last picture is not looked at again.

    Parameters
    ----------
    state_of
        Returns the state of a token that is no hyperparameter.
    targets
        The tokens that get a thumbnail before others.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were left out.
    """
    values, kept = dict(hparams.values), _Kept()
    if run is not None:
        kept = _kept.setdefault(run.tokens.program, kept)
        pairs = zip(run.tokens.program.tokens, run.tokens.values, strict=True)
        values = {name: value for name, value in pairs if value is not NOT_COMPUTED} | values
    found: dict[str, _Found] = {}
    for token in structure.tokens:
        if (name := token.name) in values:
            look = Look(token.order) if run is None else Look(token.order, RunSurroundings(run, name))
            found[name] = _find(kept, (name, False), values[name], look)
    previews, dropped = _with_thumbnails(found, _rank(run, found, targets), room)
    first = _first_texts(structure, hparams, kept)
    for each in found.values():
        each.shown.sketch = None

    def view(token: TokenView) -> TokenView:
        name, is_hyperparameter = token.name, token.name in hparams.values
        state = token.state if token.state == "left out" else "fresh" if is_hyperparameter else state_of(name)
        role = "hyperparameter" if is_hyperparameter else token.role
        before, by = token.delayed, token.order_by
        return TokenView(name, role, state, previews.get(name), token.order, first.get(name, ""), by, before)

    return tuple(map(view, structure.tokens)), dropped


def _rank(run: Run | None, found: Mapping[str, _Found], targets: Collection[str]) -> Rank:
    if run is None:
        return lambda token: token not in targets
    sinks, producer, ran = frozenset(run.cg.sink_tokens), run.cg.digraph.producer, run.report.durations_ns

    def rank(token: str) -> tuple[bool, int]:
        if token in sinks:
            place = 0
        elif token not in producer and found[token].shown.is_image:
            place = 1
        else:
            place = 2 if producer.get(token) in ran else 3
        return token not in targets, place

    return rank


def _first_texts(structure: GraphView, hparams: HyperparameterValues, kept: _Kept) -> dict[str, str]:
    """Return the texts of the first values of hyperparameters that have another one now."""
    texts = {}
    for token in structure.tokens:
        name = token.name
        if name in hparams.first and name in hparams.values:
            first, value = hparams.first[name], hparams.values[name]
            if first is not value and not is_same_value(first, value):
                shown = _find(kept, (name, True), first, Look(token.order)).shown
                texts[name], shown.sketch = shown.brief.text, None
    return texts


def _with_thumbnails(found: Mapping[str, _Found], rank: Rank, room: Room) -> tuple[dict[str, Preview], int]:
    """Return previews, with a thumbnail those of the lowest ranks, in graph order, as far as there is room.

    Each may take the same part of the room that is left, so that all of them are shown, if need be with less detail.
    """
    by_rank = sorted((name for name, each in found.items() if each.shown.is_drawable), key=rank)
    chosen, left = by_rank[: min(room.thumbnails, room.characters // _characters(_LEAST_BYTES))], room.characters
    previews = {name: each.shown.brief for name, each in found.items()}
    for index, name in enumerate(chosen):
        share = (left // (len(chosen) - index) - _ELEMENT_CHARACTERS) * 3 // 4
        shown, value, look = found[name]
        previews[name] = finished = shown.finished(value, look, min(share, THUMBNAIL_BYTES))
        if finished.chart is not None:
            left -= _ELEMENT_CHARACTERS + _POINT_CHARACTERS * sum(map(len, finished.chart.series))
        elif finished.picture is not None:
            left -= _characters(len(finished.picture.data))
    return previews, len(by_rank) - len(chosen)


def _characters(size: int) -> int:
    return size * 4 // 3 + _ELEMENT_CHARACTERS
