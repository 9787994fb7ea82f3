"""Which values do all stages have at one pixel of the one that is shown?"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final
from weakref import ReferenceType, WeakKeyDictionary, ref

from epypes.display import Scene, is_image
from epypes.display.previews.arrays import plain_array
from epypes.display.previews.images import image_kind, one_channel, sampled
from epypes.display.previews.introspection import silent_numpy
from epypes.graph import colour_order
from epypes.images import Order
from epypes.run import Run
from epypes.run.program import Program
from epypes_widgets.looking.stages import Stage

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]

# Whether a token's last image was one of labels: a pointer asks for many pixels of one image.
_seen: Final[WeakKeyDictionary[Program, dict[str, tuple[ReferenceType[Any], bool]]]] = WeakKeyDictionary()
_CHANNELS: Final = {"bgr": "BGRA", "rgb": "RGBA"}


def probe(run: Run, stages: Iterable[Stage], x: float, y: float, shown: Scene) -> list[dict[str, str]]:
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
        place is taken, and its column and row are told.

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
        for token in (stage.token for stage in stages if stage.is_picture):
            value = _value(run, token)
            if is_image(value):
                image = one_channel(plain_array(value))
                noun = "label " * (image.ndim == 2 and _are_labels(run, token, value))
                text = noun + _text_at(image, x, y, (width, height), colour_order(run.cg, token))
                state = "stale" if run.tokens.is_stale(token) else "fresh"
                rows.append({"token": token, "text": text, "state": state})
    return rows


def _value(run: Run, token: str) -> Any:
    return run.tokens.values[run.tokens.program.slots[token]]


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


def _are_labels(run: Run, token: str, value: Array) -> bool:
    if value.dtype.kind not in "iu":
        return False
    seen = _seen.setdefault(run.tokens.program, {})
    known = seen.get(token)
    if known is None or known[0]() is not value:
        image = one_channel(plain_array(value))
        known = seen[token] = ref(value), image_kind(image, sampled(image)) == "labels"
    return known[1]


def _number(level: float) -> str:
    return f"{level:.4g}" if isinstance(level, float) else str(level)
