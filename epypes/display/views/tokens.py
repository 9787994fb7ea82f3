"""The tokens of a view: their states, their previews, and which of them get a thumbnail."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

from epypes.display.previews.introspection import preview_context
from epypes.display.previews.kept import ValuePreview, kept_previews, kept_range
from epypes.display.previews.model import THUMBNAIL_BYTES, Look, Preview
from epypes.display.text import MOST_THUMBNAILS, THUMBNAIL_CHARACTERS
from epypes.display.views.graphview import GraphView, TokenState, TokenView
from epypes.display.views.surroundings import RunSurroundings
from epypes.run import Run
from epypes.run.staleness import NOT_COMPUTED, is_same_value

# What a picture of so few bytes shows is hardly seen; rather are some left out.
_LEAST_BYTES: Final = 1_500
_ELEMENT_CHARACTERS: Final = 150
_POINT_CHARACTERS: Final = 12

Rank = Callable[[str], Any]


class _Found(NamedTuple):
    shown: ValuePreview
    value: Any
    look: Look


class _Known(NamedTuple):
    """The previews that are kept of a program's tokens; in a nested look, each value is named only."""

    kept: dict[tuple[str, bool], ValuePreview]
    is_nested: bool

    def find(self, name: str, value: Any, look: Look, *, is_first: bool = False) -> _Found:
        key = name, is_first
        shown = self.kept.get(key)
        if shown is None or self.is_nested or not shown.is_of(value, look):
            shown = ValuePreview(value, look, self.is_nested)
            if shown.is_constant:
                self.kept[key] = shown
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
    program = None if run is None else run.tokens.program
    values = {**_computed(run), **hparams.values}
    with preview_context() as is_nested:
        known = _Known({} if program is None else kept_previews(program), is_nested)
        found: dict[str, _Found] = {}
        for token in structure.tokens:
            if (name := token.name) in values:
                look = Look(token.order)
                if run is not None and program is not None:
                    look = Look(token.order, partial(kept_range, program, name), RunSurroundings(run, name))
                found[name] = known.find(name, values[name], look)
        previews, dropped = _with_thumbnails(found, _rank(run, found, targets), room)
        first = _first_texts(structure, hparams, known)
    for each in found.values():
        each.shown.sketch = None

    def view(token: TokenView) -> TokenView:
        name, is_hyperparameter = token.name, token.name in hparams.values
        state = token.state if token.state == "left out" else "fresh" if is_hyperparameter else state_of(name)
        role = "hyperparameter" if is_hyperparameter else token.role
        before, by = token.delayed, token.order_by
        return TokenView(name, role, state, previews.get(name), token.order, first.get(name, ""), by, before)

    return tuple(map(view, structure.tokens)), dropped


def _computed(run: Run | None) -> dict[str, Any]:
    if run is None:
        return {}
    pairs = zip(run.tokens.program.tokens, run.tokens.values, strict=True)
    return {name: value for name, value in pairs if value is not NOT_COMPUTED}


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


def _first_texts(structure: GraphView, hparams: HyperparameterValues, known: _Known) -> dict[str, str]:
    """Return the texts of the first values of hyperparameters that have another one now."""
    texts = {}
    for token in structure.tokens:
        name = token.name
        if name in hparams.first and name in hparams.values:
            first, value = hparams.first[name], hparams.values[name]
            if first is not value and not is_same_value(first, value):
                shown = known.find(name, first, Look(token.order), is_first=True).shown
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
