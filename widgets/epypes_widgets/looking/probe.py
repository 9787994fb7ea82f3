"""Which values do all stages have at one pixel of the one that is shown?"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from epypes.display import is_image
from epypes.display.previews.arrays import plain_array
from epypes.display.previews.imagekinds import image_kind, one_channel
from epypes.display.previews.looking import silent_numpy
from epypes.graph import colour_order
from epypes.images import Order
from epypes.run import Run
from epypes_widgets.looking.stages import Stage

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]

# Of each side: enough to tell that an image is one of labels, in microseconds.
_LOOKED_AT_PX: Final = 32
_CHANNELS: Final = {"bgr": "BGRA", "rgb": "RGBA"}


def probe(run: Run, stages: Iterable[Stage], x: float, y: float, size: tuple[int, int]) -> list[dict[str, str]]:
    """Return the values of all stages that are images at a pixel, ready for JSON; nothing is computed.

    Parameters
    ----------
    run
        Its values are read, those that are stale, too.
    stages
        In the order in which they are listed.
    x, y
        Where, in pixels of the picture that is shown; the first pixel reaches from 0 to 1.
    size
        Width and height of the picture that is shown, in its own pixels. In an image of another size the pixel at the
        same place is taken, and its column and row are told.

    Returns
    -------
    list of dict
        ``token``, ``text``, as ``"B 12 G 40 R 200"``, and ``state``: ``"fresh"`` or ``"stale"``. Empty if the pixel
        lies outside.
    """
    width, height = size
    if not (0 <= x < width and 0 <= y < height):  # false for NaN, too
        return []
    rows = []
    with silent_numpy():
        for token in (stage.token for stage in stages if stage.is_picture):
            value = run.tokens.values[run.tokens.program.slots[token]]
            if is_image(value):
                text = _text_at(plain_array(value), x, y, size, colour_order(run.cg, token))
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
    image = one_channel(image)
    pixel = image[row, column].tolist()
    if image.ndim == 2:
        return f"{'label ' * _are_labels(image)}{_number(pixel)}"
    return " ".join(f"{name} {_number(level)}" for name, level in zip(_CHANNELS[order], pixel, strict=False))


def _are_labels(image: Array) -> bool:
    if image.dtype.kind not in "iu":
        return False
    height, width = image.shape
    rows, columns = (max(1, side // _LOOKED_AT_PX) for side in (height, width))
    return image_kind(image, image[::rows, ::columns]) == "labels"


def _number(level: float) -> str:
    return f"{level:.4g}" if isinstance(level, float) else str(level)
