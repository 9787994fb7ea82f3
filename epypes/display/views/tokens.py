"""What is to be seen of the tokens of a graph, and which of them get a thumbnail?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

from epypes.display.previews.encoding import THUMBNAIL_BYTES
from epypes.display.previews.images import kept_range
from epypes.display.previews.model import Look, Sketch
from epypes.display.previews.preview import Preview, finished, sketch
from epypes.display.text import MOST_THUMBNAILS, THUMBNAIL_CHARACTERS
from epypes.display.views.graphview import TokenState, TokenView
from epypes.display.views.surroundings import RunSurroundings
from epypes.run import Run

# What a picture of so few bytes shows is hardly seen; rather are some left out.
_LEAST_BYTES: Final = 1_500
_ELEMENT_CHARACTERS: Final = 150
_POINT_CHARACTERS: Final = 12


class Room(NamedTuple):
    """How many thumbnails a picture has at most, and how many characters they take together."""

    thumbnails: int = MOST_THUMBNAILS
    characters: int = THUMBNAIL_CHARACTERS


ROOM: Final = Room()


def token_view(token: TokenView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> TokenView:
    """Look at a token of a run; functions in ``stale`` are out of date since."""
    if token.name in hparams or not run.tokens.is_computed(token.name):
        return valueless_view(token, hparams, "not computed")
    is_old = run.cg.digraph.producer.get(token.name) in stale
    return _in_state(token, "stale" if is_old else "fresh")


def valueless_view(token: TokenView, hparams: Mapping[str, Any], state: TokenState) -> TokenView:
    """Look at a token of which only a hyperparameter's value is known; any other has this state."""
    if token.name not in hparams:
        return _in_state(token, state)
    return replace(_in_state(token, "fresh"), role="hyperparameter")


def _in_state(token: TokenView, state: TokenState) -> TokenView:
    """Return a token in this state, unless it is left out."""
    return token if token.state == "left out" else replace(token, state=state)


def with_values(
    tokens: Iterable[TokenView],
    hparams: Mapping[str, Any],
    first: Iterable[str] = (),
    room: Room = ROOM,
) -> tuple[tuple[TokenView, ...], int]:
    """Add the previews of hyperparameters; those of ``first`` get a thumbnail before others.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were left out.
    """
    tokens, chosen = tuple(tokens), frozenset(first)
    sketches = {token.name: sketch(hparams[token.name], Look(token.order)) for token in tokens if token.name in hparams}
    return _with_previews(tokens, sketches, lambda name: name not in chosen, room)


def with_run_values(
    tokens: Iterable[TokenView],
    run: Run,
    hparams: Mapping[str, Any],
    room: Room = ROOM,
    seen: frozenset[str] = frozenset(),
) -> tuple[tuple[TokenView, ...], int]:
    """Add the previews of a run's values and of these hyperparameters.

    Sink tokens get a thumbnail first, then source tokens that are images, then what the run made, then the others.

    Parameters
    ----------
    room
        How many thumbnails there are at most, and how many characters they take together.
    seen
        The tokens that are seen at once, if only some are: they come before all others.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were left out.
    """
    tokens = tuple(tokens)
    program, values = run.tokens.program, run.tokens.values
    sketches = {}
    for token in tokens:
        look = Look(token.order, partial(kept_range, program, token.name), RunSurroundings(run, token.name))
        if token.name in hparams:
            sketches[token.name] = sketch(hparams[token.name], look)
        elif run.tokens.is_computed(token.name):
            sketches[token.name] = sketch(values[program.slots[token.name]], look)
    return _with_previews(tokens, sketches, _relevance(run, sketches, seen), room)


def _relevance(run: Run, sketches: Mapping[str, Sketch], seen: frozenset[str]) -> Callable[[str], tuple[bool, int]]:
    sinks, producer = frozenset(run.cg.sink_tokens), run.cg.digraph.producer
    ran = {entry.function for entry in run.report.functions if entry.ran}

    def rank(token: str) -> int:
        if token in sinks:
            return 0
        if token not in producer and sketches[token].is_image:
            return 1
        return 2 if producer.get(token) in ran else 3

    return lambda token: (bool(seen) and token not in seen, rank(token))


def _with_previews(
    tokens: tuple[TokenView, ...], sketches: Mapping[str, Sketch], rank: Callable[[str], Any], room: Room
) -> tuple[tuple[TokenView, ...], int]:
    """Finish the sketches: with a thumbnail those of the lowest ranks, in graph order, as far as there is room.

    Each may take the same part of the room that is left, so that all of them are shown, if need be with less detail.
    """
    by_rank = sorted((name for name, found in sketches.items() if found.may_be_drawn), key=rank)
    chosen, left = by_rank[: min(room.thumbnails, room.characters // _characters(_LEAST_BYTES))], room.characters
    previews = {name: found.shown for name, found in sketches.items()}
    for index, name in enumerate(chosen):
        share = (left // (len(chosen) - index) - _ELEMENT_CHARACTERS) * 3 // 4
        previews[name] = finished(sketches[name], min(share, THUMBNAIL_BYTES))
        left -= _cost(previews[name])
    shown = tuple(replace(token, preview=previews.get(token.name)) for token in tokens)
    return shown, len(by_rank) - len(chosen)


def _cost(shown: Preview) -> int:
    """Return how many characters a thumbnail takes in a picture."""
    if shown.chart is not None:
        return _ELEMENT_CHARACTERS + _POINT_CHARACTERS * sum(map(len, shown.chart.series))
    return _characters(len(shown.picture.data)) if shown.picture is not None else 0


def _characters(size: int) -> int:
    return size * 4 // 3 + _ELEMENT_CHARACTERS
