"""What is shown of one value: a line of text, and a thumbnail if it is an image?"""

from __future__ import annotations

import enum
import math
import reprlib
from dataclasses import dataclass
from typing import Any, Final, Literal

from epypes.display.previews.raster import Picture, encode_image, is_image, sampled
from epypes.images import Order

THUMBNAIL_PX: Final = 128
_TEXT_WIDTH: Final = 24
_MOST_ELONGATED: Final = 10
_LOOKED_AT: Final = 200
_PLAIN = (int, float, complex, str, bytes, bool, type(None))
_CONTAINERS = (tuple, list, dict, set, frozenset)


@dataclass(frozen=True, slots=True)
class Chart:
    """A drawing of lines, bars or points: a thumbnail that is painted, not encoded.

    Attributes
    ----------
    kind
        ``"line"``: each series is a polyline; ``"bars"``: from the bottom up to each point; ``"points"``: dots.
    series
        Points by series; x from 0 to 1 to the right, y from 0 to 1 upwards. At most 128 points in all.
    """

    kind: Literal["line", "bars", "points"]
    series: tuple[tuple[tuple[float, float], ...], ...]


@dataclass(frozen=True, slots=True)
class Preview:
    """What is shown of a value.

    Attributes
    ----------
    text
        A short line; for arrays dtype and shape.
    detail
        A longer line: dtype, shape, range and other statistics, parted by commas.
    picture
        A thumbnail of at most 128 x 128 pixels, or None.
    chart
        A thumbnail that is drawn, or None; there is one of the two at most.
    rows
        At most 4 short lines of what is inside, such as the first rows of a table.
    """

    text: str
    detail: str
    picture: Picture | None = None
    chart: Chart | None = None
    rows: tuple[str, ...] = ()


def preview(value: Any, order: Order = "bgr") -> Preview:
    """Look at a value; never raises, and never calls the ``__repr__`` of an object that is not Python's own.

    ``order`` is that of its colours, if it is an image.
    """
    try:
        return _array_preview(value, order) if _is_array(value) else _object_preview(value)
    except Exception as error:
        reason = f"no preview: {type(error).__name__}"
        return Preview(reason, f"{type(value).__name__}, {reason}")


def _is_array(value: Any) -> bool:
    return type(value).__module__.startswith("numpy") and hasattr(value, "dtype") and hasattr(value, "shape")


def _array_preview(array: Any, order: Order) -> Preview:
    if not array.shape:
        return Preview(_cut(str(array.item())), f"{array.dtype} {array.item()!s:.60}")
    text = f"{array.dtype} {' x '.join(map(str, array.shape))}"
    if not is_image(array) or _is_strip(array):
        return Preview(text, text + _range_text(array))
    colours = f" {order}" if order != "bgr" and array.ndim == 3 and array.shape[2] > 1 else ""
    return Preview(text, text + colours + _range_text(array), encode_image(array, THUMBNAIL_PX, order))


def _is_strip(array: Any) -> bool:
    """Whether a thumbnail would be a line of pixels, as of 500 descriptors of 32 bytes."""
    height, width = array.shape[:2]
    return bool(max(height, width) > _MOST_ELONGATED * min(height, width))


def _range_text(array: Any) -> str:
    """Return the least and the largest value, of a strided sample where the array is large."""
    import numpy as np

    if not array.size or array.dtype.kind not in "biuf":
        return ""
    looked_at = sampled(array) if array.ndim in (2, 3) else array.reshape(-1)[:1_000_000]
    finite = looked_at[np.isfinite(looked_at)] if array.dtype.kind == "f" else looked_at
    if not finite.size:
        return ", no finite value"
    marked = " of a sample" if looked_at.size < array.size else ""
    return f", {finite.min()} to {finite.max()}{marked}"


def _object_preview(value: Any) -> Preview:
    if isinstance(value, float) and math.isfinite(value):
        return Preview(f"{value:.6g}", f"float {value!r}")
    if isinstance(value, enum.Enum):
        return Preview(_cut(f"{type(value).__name__}.{value.name}"), f"{type(value).__name__}.{value.name}")
    if isinstance(value, _PLAIN):
        # reprlib cuts a text only after it has made all of it.
        short = value[:_LOOKED_AT] if isinstance(value, str | bytes) else value
        return Preview(_cut(reprlib.repr(short)), f"{type(value).__name__} {reprlib.repr(short)}")
    kind = type(value).__name__
    if isinstance(value, _CONTAINERS):
        return Preview(f"{kind} of {len(value)}", f"{kind} of {len(value)}")
    return Preview(_cut(kind), kind)


def _cut(text: str) -> str:
    return text if len(text) <= _TEXT_WIDTH else text[: _TEXT_WIDTH - 3] + "..."
