"""Drawings: charts of numbers, and marks drawn over images."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews import THUMBNAIL_PX, Backdrop, Chart, Marks, Picture, Scene
from epypes.display.previews.encoding import encode_image, encode_small, pillow_image
from epypes.display.previews.images import image_kind, sampled, some_of
from epypes.optional import LazyModule

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image, ImageDraw

    from epypes.display.previews import Floats
else:
    np, Image, ImageDraw = LazyModule("numpy"), LazyModule("PIL.Image"), LazyModule("PIL.ImageDraw")

# -- charts -----------------------------------------------------------------------------------------------------------

MOST_POINTS: Final = 128
MOST_LINES: Final = MOST_POINTS // 4
_BINS: Final = MOST_POINTS // 2
# Of the frame that a chart is painted into.
_ASPECT: Final = 4 / 3


def line_chart(values: Any) -> Chart:
    """Draw a signal; of a long one the least and the largest value of each part, so that no peak is lost."""
    signal = _finite_or_nan(values)
    if signal.size > MOST_POINTS:
        parts = np.array_split(signal, _BINS)
        signal = np.array([end for part in parts for end in _ends(part)])
    x = np.linspace(0.0, 1.0, max(signal.size, 2))[: signal.size]
    kept = np.isfinite(signal)
    return Chart("line", (_pairs(x[kept], _scaled(signal[kept])),))


def bar_chart(counts: Any) -> Chart:
    """Draw a histogram; of many bins several are added up to one bar."""
    bars = np.nan_to_num(_finite_or_nan(counts), nan=0.0)
    if bars.size > _BINS:
        bars = np.array([part.sum() for part in np.array_split(bars, _BINS)])
    largest = float(np.abs(bars).max(initial=0.0)) or 1.0
    x = (np.arange(bars.size) + 0.5) / max(bars.size, 1)
    return Chart("bars", (_pairs(x, np.clip(bars / largest, 0.0, 1.0)),))


def place_chart(marks: Marks) -> Chart:
    """Draw marks without their image: in their own extent, both axes alike, y downwards."""
    points = marks.points[spread(len(marks.points), MOST_POINTS)]
    series = _shortened(marks.lines) if marks.lines else (points,)
    every = np.concatenate([*series, np.empty((0, 2))])
    if not len(every):
        return Chart("points", ())
    low, high = every.min(axis=0), every.max(axis=0)
    size = max(float(high[0] - low[0]) / _ASPECT, float(high[1] - low[1])) or 1.0
    middle = (low + high) / 2
    placed = []
    for places in series:
        x = 0.5 + (places[:, 0] - middle[0]) / (size * _ASPECT)
        y = 0.5 - (places[:, 1] - middle[1]) / size
        placed.append(_pairs(x, y))
    return Chart("line" if marks.lines else "points", tuple(placed))


def spread(count: int, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of some of so many, from the first to the last."""
    return np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.intp)


def _shortened(lines: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Return the longest of many lines, each with every n-th of its points."""
    longest = sorted(lines, key=len, reverse=True)[:MOST_LINES]
    most = MOST_POINTS // len(longest)
    return tuple(line[:: -(-len(line) // most)] for line in longest)


def _finite_or_nan(values: Any) -> Floats:
    """Return values as floats; of very many every n-th."""
    flat = some_of(values).reshape(-1).astype(np.float64)
    return np.where(np.isfinite(flat), flat, np.nan)


def _ends(part: Floats) -> tuple[float, float]:
    finite = part[np.isfinite(part)]
    if not finite.size:
        return np.nan, np.nan
    low, high = int(finite.argmin()), int(finite.argmax())
    first, last = sorted((low, high))
    return float(finite[first]), float(finite[last])


def _scaled(values: Floats) -> Floats:
    """Return values between 0 and 1; of a constant, the middle."""
    if not values.size:
        return values
    low, high = values.min() / 2, values.max() / 2
    return (values / 2 - low) / (high - low) if high > low else np.full_like(values, 0.5)


def _pairs(x: Floats, y: Floats) -> tuple[tuple[float, float], ...]:
    return tuple((round(float(a), 4), round(float(b), 4)) for a, b in zip(x, y, strict=True))


# -- marks ------------------------------------------------------------------------------------------------------------

# Marks are drawn at twice the size and made smaller with the image, which smooths their edges.
_OVERSAMPLED: Final = 2
# What lies further off a canvas than its own size is not seen, and drawing it takes seconds.
_MARGIN: Final = 1.0
# Few points are larger than many.
_FEW: Final = 50
_RADIUS_PX: Final = 3.0
_LARGE_RADIUS_PX: Final = 4.0
_PAIR_RADIUS_PX: Final = 2.0
_LINE_PX: Final = 2
_DARKER: Final = 0.75
_Colour = tuple[int, int, int]
_Place = tuple[float, float]
_GREEN: Final = (60, 255, 120)
_COLOURS: Final = ((255, 90, 90), (90, 220, 255), (255, 215, 70), (120, 255, 130), (240, 130, 255), (255, 165, 80))


def scene_picture(scene: Scene, max_side_px: int, most_bytes: int) -> Picture:
    """Return a scene as one picture, its marks drawn, whose longer side and whose bytes are at most these."""
    seen = scene.backdrop
    if scene.marks is None:
        return encode_image(seen.image, max_side_px, seen.order, seen.ends, most_bytes)
    side = min(max_side_px, max(THUMBNAIL_PX, *seen.image.shape[:2]))
    return encode_small(drawn_over(seen, scene.marks, side), most_bytes, has_small_marks=True)


def pair_scene(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, what: str) -> Scene:
    """Return two images side by side, at their full size, with lines; ``pairs`` are (n, 4): x and y in both."""
    left, right = (np.asarray(_picture(backdrop, None)) for backdrop in backdrops)
    height, width = max(len(left), len(right)), left.shape[1]
    joined = np.zeros((height, width + right.shape[1], 3), np.uint8)
    joined[: len(left), :width] = left
    joined[: len(right), width:] = right
    ends = np.add(pairs, (0, 0, width, 0)).reshape(-1, 2, 2)
    marks = Marks(ends.reshape(-1, 2), tuple(ends), total=total)
    return Scene(Backdrop(joined, "rgb", (0.0, 255.0), ""), marks, what)


def drawn_over(backdrop: Backdrop, marks: Marks, side: int = THUMBNAIL_PX) -> Image.Image:
    """Return an image whose longer side is so long, with marks over it."""
    canvas, scale = _canvas(backdrop, side * _OVERSAMPLED)
    pen = _Pen(canvas)
    for line in marks.lines:
        pen.line((line + 0.5) * scale, _GREEN, _LINE_PX, is_closed=marks.are_closed)
    radius = _LARGE_RADIUS_PX if len(marks.points) <= _FEW else _RADIUS_PX
    for place, (x, y) in enumerate((marks.points + 0.5) * scale):
        if marks.are_circles and marks.extents is not None:
            pen.circle(x, y, _GREEN, marks.extents[place, 0] / 2 * scale)
        else:
            pen.point(x, y, _GREEN, radius)
    return canvas.reduce(_OVERSAMPLED)


def drawn_between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats) -> Image.Image:
    """Return the thumbnail of two images side by side, with a line from one to the other for each pair."""
    side = THUMBNAIL_PX * _OVERSAMPLED // 2
    (left, left_scale), (right, right_scale) = (_canvas(backdrop, side) for backdrop in backdrops)
    canvas = Image.new("RGB", (2 * side, max(left.height, right.height)))
    canvas.paste(left, (side - left.width, 0))
    canvas.paste(right, (side, 0))
    pen = _Pen(canvas)
    for index, (x0, y0, x1, y1) in enumerate(pairs + 0.5):
        start = x0 * left_scale + side - left.width, y0 * left_scale
        end = x1 * right_scale + side, y1 * right_scale
        colour = _COLOURS[index % len(_COLOURS)]
        pen.line(np.array([start, end]), colour)
        pen.point(*start, colour, _PAIR_RADIUS_PX)
        pen.point(*end, colour, _PAIR_RADIUS_PX)
    return canvas.reduce(_OVERSAMPLED)


def _canvas(backdrop: Backdrop, side: int) -> tuple[Image.Image, float]:
    """Return an image to be drawn upon, a little darker, and how many of its pixels are one of the image."""
    array, picture = backdrop.image, _picture(backdrop, side)
    scale = side / max(array.shape[:2])
    # Even sides, so that each pixel of the thumbnail is made of four.
    height, width = (max(1, round(length * scale / _OVERSAMPLED)) * _OVERSAMPLED for length in array.shape[:2])
    picture = picture.resize((width, height), Image.Resampling.BILINEAR)
    return picture.point(lambda level: round(level * _DARKER)), scale


def _picture(backdrop: Backdrop, side: int | None) -> Image.Image:
    array = backdrop.image
    return pillow_image(array, side, backdrop.order, backdrop.ends, image_kind(array, sampled(array))).convert("RGB")


class _Pen:
    """Draws upon a canvas, and nothing that is far off: Pillow would visit each pixel of a line, wherever it is."""

    def __init__(self, canvas: Image.Image) -> None:
        self._draw = ImageDraw.Draw(canvas)
        self._low = -_MARGIN * canvas.width, -_MARGIN * canvas.height
        self._high = (1 + _MARGIN) * canvas.width, (1 + _MARGIN) * canvas.height

    def point(self, x: float, y: float, colour: _Colour, radius: float = _RADIUS_PX) -> None:
        """Draw a dot."""
        if self._is_near(((x, y),)):
            self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline=(0, 0, 0))

    def circle(self, x: float, y: float, colour: _Colour, radius: float) -> None:
        """Draw the outline of a circle whose middle is near."""
        if self._is_near(((x, y),)):
            self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=colour, width=_LINE_PX)

    def line(self, line: Floats, colour: _Colour, width: int = 1, *, is_closed: bool = False) -> None:
        """Draw a line through places (k, 2); of one place, a dot."""
        places: list[_Place] = [(float(x), float(y)) for x, y in line]
        if len(places) == 1:
            self.point(*places[0], colour)
            return
        places += places[:1] * is_closed
        if self._is_near(places):
            self._draw.line(places, fill=colour, width=width)
            return
        for start, end in itertools.pairwise(places):
            if near := self._near_part(start, end):
                self._draw.line(near, fill=colour, width=width)

    def _is_near(self, places: Iterable[_Place]) -> bool:
        (left, top), (right, bottom) = self._low, self._high
        return all(left <= x <= right and top <= y <= bottom for x, y in places)

    def _near_part(self, start: _Place, end: _Place) -> list[_Place]:
        """Return the ends of the part of a line that is near (Liang and Barsky); none if there is none."""
        first, last = 0.0, 1.0
        for a, b, low, high in zip(start, end, self._low, self._high, strict=True):
            if a != b:
                enters, leaves = sorted(((low - a) / (b - a), (high - a) / (b - a)))
                first, last = max(first, enters), min(last, leaves)
            elif not low <= a <= high:
                return []
        (x0, y0), (x1, y1) = start, end
        return [(x0 + share * (x1 - x0), y0 + share * (y1 - y0)) for share in (first, last)] if first <= last else []
