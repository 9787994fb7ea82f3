"""Previews of arrays and of numbers of numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews import THUMBNAIL_PX, Backdrop, Look, Preview, Scene, Sketch
from epypes.display.previews.drawing import bar_chart, line_chart
from epypes.display.previews.encoding import encode_small, is_pooled, pillow_image
from epypes.display.previews.features import (
    circle_sketch,
    flow_sketch,
    has_flow_shape,
    point_sketch,
    quad_sketch,
    says_circles,
    segment_sketch,
)
from epypes.display.previews.images import (
    few_of,
    image_kind,
    is_image,
    is_of_dtype,
    label_areas,
    label_text,
    one_channel,
    sampled,
    some_of,
    statistics_text,
)
from epypes.display.previews.introspection import is_of
from epypes.display.previews.objects import record_sketch
from epypes.display.previews.short import array_text, float_text, row_texts, short_repr
from epypes.display.text import cut, memory_text
from epypes.optional import LazyModule

if TYPE_CHECKING:
    import numpy as np

    from epypes.display.previews import Array
else:
    np = LazyModule("numpy")

_MOST_ELONGATED: Final = 6
_SMALL_SIDE: Final = 4
_MOST_COLUMNS: Final = 6
_MOST_ROWS: Final = 4
_LEAST_BINS: Final = 8
# Of points, contours, segments, and pairs of points or boxes.
_PLACES: Final = ((2,), (1, 2), (1, 4), (4,))


def number_preview(number: Any, look: Look) -> Preview:
    """Look at a number of numpy, which has a dtype and no axes."""
    if number.dtype.kind in "mM":
        return Preview(str(number), f"{number.dtype} {number}")
    value = number.item()
    text = float_text(value) if isinstance(value, float) else short_repr(value)
    return Preview(text, f"{number.dtype} {short_repr(value)}")


def plain_array(array: Any) -> Array:
    """Return an array without what a subclass of numpy's makes of it."""
    return np.asarray(array)


def array_sketch(array: Any, look: Look) -> Sketch | Preview:
    """Look at an array by its shape and dtype."""
    array = plain_array(array)
    if not array.ndim:
        return number_preview(array, look)
    if array.dtype.names:
        return record_sketch(array)
    if array.dtype.kind not in "biuf" or not array.size:
        return _plain(array)
    closer = _closer(array, look)
    if closer is None:
        return _plain(array)
    text = array_text(array) + _order_text(array, look) * (closer is image_sketch)
    detail = f"{text}, {statistics_text(few_of(array), array)}"
    brief = Preview(text, detail, rows=_rows(array) if array.ndim > 1 else ())
    return Sketch(brief, is_image=closer is image_sketch, closer=lambda: closer(array, look) or _plain(array))


def _closer(array: Array, look: Look) -> Callable[[Array, Look], Sketch | None] | None:
    """Return what draws an array of its shape; None if nothing can be drawn."""
    if is_image(array) and not is_strip(array):
        return image_sketch
    if array.shape[1:] in _PLACES:
        return _places
    if has_flow_shape(array):
        return flow_sketch
    is_of_hough = array.ndim == 3 and array.dtype.str[1:] == "f4"
    if _has_circle_shape(array) and (is_of_hough or says_circles(look)):
        return circle_sketch
    is_line = array.size == max(array.shape) > _SMALL_SIDE
    return _drawn_numbers if is_line else None


def _has_circle_shape(array: Array) -> bool:
    return array.shape[-1] == 3 and array.dtype.itemsize > 1 and (array.ndim == 2 or array.shape[:-2] == (1,))


def is_strip(array: Array) -> bool:
    """Whether a thumbnail would be a line of pixels, as of 500 descriptors of 32 bytes."""
    height, width = array.shape[:2]
    return bool(max(height, width) > _MOST_ELONGATED * min(height, width))


def image_sketch(array: Array, look: Look) -> Sketch:
    """Look at an array that is an image."""
    sample = sampled(array)
    kind = image_kind(array, sample)
    ends = look.around.range_of(array)
    text = array_text(array) + _order_text(array, look)
    detail, note = [text, statistics_text(sample, array)], ""
    if kind == "labels":
        # Labels are names: their range and mean say nothing.
        areas = label_areas(one_channel(sample), array.size)
        detail[1:] = [label_text(areas, is_sample=sample is not array), memory_text(array.nbytes)]
    elif kind == "mask":
        detail.append("mask" if is_pooled(array) else "mask, of a sample: thin lines may be missing")
    elif not is_of_dtype(array.dtype, ends):
        note = f"shown from {ends[0]:.6g} to {ends[1]:.6g}"
        detail.append(note)
    return Sketch(
        Preview(text, ", ".join(detail)),
        lambda most_bytes: encode_small(pillow_image(array, THUMBNAIL_PX, look.order, ends, kind), most_bytes),
        is_image=True,
        scene=lambda: Scene(Backdrop(array, look.order, ends, "")),
        note=note,
    )


def _order_text(array: Array, look: Look) -> str:
    return f" {look.order}" if array.ndim == 3 and array.shape[2] > 1 else ""


def _places(array: Array, look: Look) -> Sketch | None:
    """Look at an array of places in an image; None if the image is needed and there is none."""
    shape = array.shape
    if shape[1:] in ((2,), (1, 2)):
        # Four corners are a small matrix, too, where there is no image that they lie on.
        return point_sketch(array, look, needs_image=array.ndim == 2 and len(array) <= _SMALL_SIDE)
    if shape[1:] == (1, 4):
        return segment_sketch(array, look)
    return quad_sketch(array, look)


def _drawn_numbers(array: Array, look: Look) -> Sketch:
    """Look at an array of one column, or one row, as a histogram or signal."""
    text = array_text(array)
    is_histogram = _are_counts(array)
    name = "histogram" if is_histogram else "signal"
    detail = f"{text} {name}, {statistics_text(some_of(array), array)}"
    return Sketch(Preview(text, detail), lambda most_bytes: bar_chart(array) if is_histogram else line_chart(array))


def _are_counts(array: Array) -> bool:
    """Whether numbers are what cv2.calcHist returns: whole, but float32; of one axis in newer OpenCV."""
    if array.dtype.str[1:] != "f4" or len(array) < _LEAST_BINS or array.ndim > 2:
        return False
    some = some_of(array)
    return array.ndim == 2 or bool(((some >= 0) & (some % 1 == 0)).all())


def _plain(array: Array) -> Preview:
    """Look at an array of which nothing can be drawn."""
    text = array_text(array)
    return Preview(text, cut(f"{text}, {statistics_text(some_of(array), array)}", 280), rows=_rows(array))


def _rows(array: Array) -> tuple[str, ...]:
    if not array.size or array.ndim > 2 or (array.ndim == 2 and array.shape[1] > _MOST_COLUMNS):
        return ()
    if array.ndim == 1:
        return (
            row_texts(map(short_repr, array), len(array), _MOST_ROWS)
            if array.dtype.kind not in "biuf"
            else (" ".join(_cells(array)),)
        )
    kept = len(array) if len(array) <= _MOST_ROWS else _MOST_ROWS - 1
    cells = [_cells(row) for row in array[:kept]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rows = tuple(" ".join(map(str.rjust, row, widths)) for row in cells)
    return (*rows, f"... {len(array) - kept} more") if kept < len(array) else rows


def _cells(row: Array) -> list[str]:
    if row.dtype.kind == "f":
        return [f"{value:.4g}" for value in row]
    return [short_repr(value.item() if is_of(value, "numpy", "generic") else value) for value in row]
