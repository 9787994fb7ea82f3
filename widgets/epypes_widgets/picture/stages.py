"""The stages of a run: the tokens that can be looked at, whether they are up to date, and their values at a pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from epypes.display import Scene, is_image, scalar_owners, scene_of
from epypes.display.previews.arrays import is_strip, plain_array
from epypes.display.previews.images import image_kind, one_channel, sampled
from epypes.display.previews.introspection import silent_numpy
from epypes.graph import colour_order
from epypes.images import Order
from epypes.nothing import Nothing
from epypes.run import Run
from epypes.run.guard import ARRAYLESS
from epypes.run.staleness import NOT_COMPUTED

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]

_CHANNELS: Final = {"bgr": "BGRA", "rgb": "RGBA"}

State = Literal["fresh", "stale", "failed", "absent", "nothing"]


# The tokens that can be looked at, in graph order, and whether each is an image or can be drawn over one; any other is
# shown as text.
Stages: TypeAlias = Mapping[str, bool]
NO_STAGES: Final[Stages] = MappingProxyType({})


def stages(run: Run, kept: Stages = NO_STAGES, asked: str | None = None) -> dict[str, bool]:
    """Return the tokens that have a picture, and the sink tokens whatever they are, in graph order.

    Parameters
    ----------
    run
        Its values are looked at, those that are stale only for whether they are images.
    kept
        The stages of an earlier run: what had a picture stays, whether or not it has one now, so that nothing comes
        and goes while values are moved.
    asked
        A token that is a stage in any case.

    Returns
    -------
    dict of bool
        Whether it has a picture, by token. Of a run that has neither pictures nor sink tokens, all tokens that have a
        value.
    """
    sinks = run.cg.sink_tokens
    found: dict[str, bool] = {}
    for token in run.cg.tokens:
        is_picture = kept.get(token, False) or _has_picture(run, token)
        if is_picture or token == asked or token in kept or token in sinks:
            found[token] = is_picture
    return found or dict.fromkeys(run, False)


def best_stage(run: Run, stages: Stages) -> str | None:
    """Return the token to show first: the last that has a picture, of sink tokens if one has; None of none.

    An image of a few columns, such as descriptors are, comes after all other pictures.
    """
    sinks = run.cg.sink_tokens

    def rank(token: str) -> tuple[int, bool]:
        value = _value(run, token)
        is_wide = not (is_image(value) and is_strip(value))
        return stages[token] * (1 + is_wide), token in sinks

    return max(reversed([*stages]), key=rank, default=None)  # of equals the last


def states(run: Run, stages: Stages) -> dict[str, State]:
    """Return the state of every stage.

    ``"failed"`` is what the function that failed would have made, ``"absent"`` what was not computed,
    ``"nothing"`` that for which nothing was found.
    """
    slots, values, makers = run.tokens.program.slots, run.tokens.values, run.tokens.program.makers
    stale, has_completed, found = run.tokens.stale, run.failure is None, dict[str, State]()
    for token in stages:
        value, maker = values[slots[token]], makers[slots[token]]
        # Most are fresh, and this is asked for each frame.
        is_fresh = has_completed and maker not in stale and value is not NOT_COMPUTED and value is not Nothing
        found[token] = "fresh" if is_fresh else _state(run, token)
    return found


def _state(run: Run, token: str) -> State:
    maker = run.cg.digraph.producer.get(token)
    if run.failure is not None and maker == run.failure.function:
        return "failed"
    if not run.tokens.is_computed(token):
        return "fresh" if run.failure is None and _was_in(run, token, maker) else "absent"
    if run.tokens.is_stale(token):
        return "stale"
    return "nothing" if run.tokens.is_nothing(token) else "fresh"


def _was_in(run: Run, token: str, maker: str | None) -> bool:
    """Whether a run had a token whose value is not here: that of a service sends what is looked at."""
    ran = run.report.ran
    return any(name in ran for name in ((maker,) if maker else run.cg.digraph.consumers.get(token, ())))


def _has_picture(run: Run, token: str) -> bool:
    value = _value(run, token)
    # Numbers and texts are known at a glance: a graph of a thousand of them is looked at after every run.
    return type(value) not in ARRAYLESS and (is_image(value) or scene_of(run, token) is not None)


def _value(run: Run, token: str) -> Any:
    """Return a token's value even if it is stale; what stands for none of a token that was not computed."""
    return run.tokens.values[run.tokens.program.slots[token]]


# -- numbers of a picture ---------------------------------------------------------------------------------------------


def scalars(run: Run, token: str) -> tuple[str, ...]:
    """Return the numbers and short texts that belong to a picture: to the stage, or to what it is drawn over."""
    scene, owners = scene_of(run, token, had_marks=True), scalar_owners(run)
    images = {token, scene.backdrop.name} if scene is not None else {token}
    return tuple(name for name, image in owners.items() if image in images)


# -- at a pixel -------------------------------------------------------------------------------------------------------


def probe(run: Run, stages: Stages, x: float, y: float, shown: Scene) -> list[dict[str, str]]:
    """Return the values of all stages that are images at a pixel, ready for JSON; nothing is computed.

    Parameters
    ----------
    run
        Its values are read, those that are stale, too.
    stages
        In the order in which they are listed.
    x, y
        Where, in pixels of the picture that is shown; the first pixel reaches from 0 to 1.
    shown
        The picture in which the pixel was chosen. In an image of another size than its backdrop's the pixel at the same
        place is taken, and its column and row are given.

    Returns
    -------
    list of dict
        ``token``, ``text``, as ``"B 12 G 40 R 200"``, and ``state``: ``"fresh"`` or ``"stale"``. Empty if the pixel
        lies outside, or if the picture is none of the images of the run: two of them side by side, or what a preview
        function has drawn.
    """
    height, width = shown.backdrop.image.shape[:2]
    if not is_image(_value(run, shown.backdrop.name)) or not (0 <= x < width and 0 <= y < height):  # false for NaN, too
        return []
    rows = []
    with silent_numpy():
        for token in (token for token, is_picture in stages.items() if is_picture):
            value = _value(run, token)
            if is_image(value):
                image = one_channel(plain_array(value))
                is_label = (
                    image.ndim == 2 and image.dtype.kind in "iu" and image_kind(image, sampled(image)) == "labels"
                )
                text = "label " * is_label + _text_at(image, x, y, (width, height), colour_order(run.cg, token))
                state = "stale" if run.tokens.is_stale(token) else "fresh"
                rows.append({"token": token, "text": text, "state": state})
    return rows


def _text_at(image: Array, x: float, y: float, size: tuple[int, int], order: Order) -> str:
    width, height = size
    if image.shape[:2] == (height, width):
        return _pixel_text(image, int(x), int(y), order)
    column = int((math.floor(x) + 0.5) * image.shape[1] / width)
    row = int((math.floor(y) + 0.5) * image.shape[0] / height)
    return f"{_pixel_text(image, column, row, order)} (at {column}, {row})"


def _pixel_text(image: Array, column: int, row: int, order: Order) -> str:
    pixel = image[row, column].tolist()
    if image.ndim == 2:
        return _number(pixel)
    return " ".join(f"{name} {_number(level)}" for name, level in zip(_CHANNELS[order], pixel, strict=False))


def _number(level: float) -> str:
    return f"{level:.4g}" if isinstance(level, float) else str(level)
