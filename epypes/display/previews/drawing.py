"""Charts of numbers, and marks drawn over the image that they were found in.

Without an image at hand marks become a chart in their own extent.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.encoding import encode_image, encode_small, pillow, pillow_image
from epypes.display.previews.images import image_kind, sampled, some_of
from epypes.display.previews.model import THUMBNAIL_PX, Backdrop, Chart, Marks, Most, Picture, Scene
from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image

    from epypes.display.previews.model import Floats

# -- charts -----------------------------------------------------------------------------------------------------------

MOST_POINTS: Final = 128
MOST_LINES: Final = MOST_POINTS // 4
_BINS: Final = MOST_POINTS // 2
# Of the frame that a chart is painted into.
_ASPECT: Final = 4 / 3


def line_chart(values: Any) -> Chart:
    """Draw a signal; of a long one the least and the largest value of each part, so that no peak is lost."""
    import numpy as np

    signal = _finite_or_nan(values)
    if signal.size > MOST_POINTS:
        parts = np.array_split(signal, _BINS)
        signal = np.array([end for part in parts for end in _ends(part)])
    x = np.linspace(0.0, 1.0, max(signal.size, 2))[: signal.size]
    kept = np.isfinite(signal)
    return Chart("line", (_pairs(x[kept], _scaled(signal[kept])),))


def bar_chart(counts: Any) -> Chart:
    """Draw a histogram; of many bins several are added up to one bar."""
    import numpy as np

    bars = np.nan_to_num(_finite_or_nan(counts), nan=0.0)
    if bars.size > _BINS:
        bars = np.array([part.sum() for part in np.array_split(bars, _BINS)])
    largest = float(np.abs(bars).max(initial=0.0)) or 1.0
    x = (np.arange(bars.size) + 0.5) / max(bars.size, 1)
    return Chart("bars", (_pairs(x, np.clip(bars / largest, 0.0, 1.0)),))


def place_chart(points: Floats, lines: tuple[Floats, ...]) -> Chart:
    """Draw places of an image without the image: in their own extent, both axes alike, y downwards."""
    import numpy as np

    series = _shortened(lines) if lines else (points[spread(len(points), MOST_POINTS)],)
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
    return Chart("line" if lines else "points", tuple(placed))


def spread(count: int, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of some of so many, from the first to the last."""
    import numpy as np

    return np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.intp)


def drawn_in_chart(points: int, lines: int) -> int:
    """Return how many of so many lines, or without lines of so many points, a chart has."""
    return min(lines, MOST_LINES) or min(points, MOST_POINTS)


def _shortened(lines: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Return the longest of many lines, each with every n-th of its points."""
    longest = sorted(lines, key=len, reverse=True)[:MOST_LINES]
    most = MOST_POINTS // len(longest)
    return tuple(line[:: -(-len(line) // most)] for line in longest)


def _finite_or_nan(values: Any) -> Floats:
    """Return values as floats; of very many every n-th."""
    import numpy as np

    flat = some_of(values).reshape(-1).astype(np.float64)
    return np.where(np.isfinite(flat), flat, np.nan)


def _ends(part: Floats) -> tuple[float, float]:
    import numpy as np

    finite = part[np.isfinite(part)]
    if not finite.size:
        return np.nan, np.nan
    low, high = int(finite.argmin()), int(finite.argmax())
    first, last = sorted((low, high))
    return float(finite[first]), float(finite[last])


def _scaled(values: Floats) -> Floats:
    """Return values between 0 and 1; of a constant, the middle."""
    import numpy as np

    if not values.size:
        return values
    low, high = values.min() / 2, values.max() / 2
    return (values / 2 - low) / (high - low) if high > low else np.full_like(values, 0.5)


def _pairs(x: Floats, y: Floats) -> tuple[tuple[float, float], ...]:
    return tuple((round(float(a), 4), round(float(b), 4)) for a, b in zip(x, y, strict=True))


# -- marks ------------------------------------------------------------------------------------------------------------

# Marks are drawn at twice the size and made smaller with the image, which smooths their edges.
_OVERSAMPLED: Final = 2
_FARTHEST_PX: Final = 1e6
# What lies further off a canvas than its own size is not seen, and drawing it takes seconds.
_MARGIN: Final = 1.0
_INSIDE: Final = 0.5
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


def some_points(points: Any, most: Most, total: int | None = None, extents: Floats | None = None) -> Marks:
    """Return points as marks: of many some, evenly spread in their order, none that is not finite."""
    import numpy as np

    total = len(points) if total is None else total
    chosen = spread(len(points), most.marks)
    kept = points[chosen].reshape(-1, 2).astype(np.float64)
    is_drawn = _is_drawable(kept)
    return Marks(kept[is_drawn], total=total, extents=None if extents is None else extents[chosen][is_drawn])


def some_pairs(places: Any, most: Most) -> Floats:
    """Return pairs (n, 4) of places as they are drawn: of many some, none that is not finite or far away."""
    import numpy as np

    kept: Floats = places[spread(len(places), most.pairs)].astype(np.float64)
    return kept[_is_drawable(kept)]


def some_lines(lines: Any, are_closed: bool, most: Most, total: int | None = None) -> Marks:
    """Return lines, each (k, 2), as marks: of many the longest, each with at most so many points."""
    import numpy as np

    longest = sorted(lines, key=len, reverse=True)[: most.marks] if len(lines) > most.marks else lines
    room = min(most.line, _share([len(line) for line in longest], most.places))
    kept = [line[:: -(-len(line) // room) or 1].reshape(-1, 2) for line in longest if len(line)]
    count = len(lines) if total is None else total
    return Marks(np.empty((0, 2)), tuple(_drawable_lines(kept)), are_closed, count)


def _drawable_lines(lines: list[Any]) -> list[Floats]:
    """Return the lines without what can't be drawn of them; looked at together, since there may be thousands."""
    import numpy as np

    if not lines:
        return []
    places, ends = np.concatenate(lines).astype(np.float64), np.cumsum(list(map(len, lines)))[:-1]
    is_drawn, found = _is_drawable(places), np.split(places, ends)
    if is_drawn.all():
        return found
    return [kept for line, is_kept in zip(found, np.split(is_drawn, ends), strict=True) if len(kept := line[is_kept])]


def _share(lengths: Iterable[int], room: int) -> int:
    """Return the places that each line may have, so that short ones stay whole and all fit into the room."""
    waiting = sorted(lengths)
    for place, length in enumerate(waiting):
        share = room // (len(waiting) - place)
        if length > share:
            return max(share, 1)
        room -= length
    return max([1, *waiting[-1:]])


def rectangles(boxes: Any, most: Most) -> Marks:
    """Return boxes (n, 4) of x, y, width and height as marks."""
    import numpy as np

    x, y, width, height = boxes[: most.marks].astype(np.float64).T
    corners = np.stack([x, y, x + width, y, x + width, y + height, x, y + height], axis=1)
    return replace(some_lines(list(corners.reshape(-1, 4, 2)), True, most), total=len(boxes))


def lie_on(points: Floats, backdrop: Backdrop) -> bool:
    """Whether most of these points lie on the image, and not all in its first pixel, where shares would be."""
    import numpy as np

    if not len(points):
        return True
    return share_on(points, backdrop) >= _INSIDE and (len(points) == 1 or float(np.abs(points).max()) > 1.0)


def share_on(points: Floats, backdrop: Backdrop) -> float:
    """Return which part of these points lie on the image, from 0 to 1."""
    height, width = backdrop.image.shape[:2]
    x, y = points[:, 0], points[:, 1]
    return float(((x >= -1) & (y >= -1) & (x <= width) & (y <= height)).mean()) if len(points) else 1.0


def marks_lie_on(marks: Marks, backdrop: Backdrop) -> bool:
    """Whether marks are likely to have been found in this image."""
    import numpy as np

    return lie_on(np.concatenate(marks.lines) if marks.lines else marks.points, backdrop)


def drawer(marks: Marks, backdrop: Backdrop | None) -> Callable[[int], Picture | Chart]:
    """Return what draws marks: over an image, or in their own extent."""
    if backdrop is None:
        return lambda most_bytes: place_chart(marks.points, marks.lines)
    return lambda most_bytes: encode_small(_drawn_over(backdrop, marks), most_bytes, has_small_marks=True)


def scene_picture(scene: Scene, max_side_px: int, most_bytes: int) -> Picture:
    """Return a scene as one picture, its marks drawn, whose longer side and whose bytes are at most these."""
    seen = scene.backdrop
    if scene.marks is None:
        return encode_image(seen.image, max_side_px, seen.order, seen.ends, most_bytes)
    side = min(max_side_px, max(THUMBNAIL_PX, *seen.image.shape[:2]))
    return encode_small(_drawn_over(seen, scene.marks, side), most_bytes, has_small_marks=True)


def pair_drawer(backdrops: tuple[Backdrop, Backdrop], pairs: Floats) -> Callable[[int], Picture | Chart]:
    """Return what draws two images side by side, with lines; ``pairs`` are (n, 4): x and y in both."""
    return lambda most_bytes: encode_small(_drawn_between(backdrops, pairs), most_bytes, has_small_marks=True)


def pair_scene(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, what: str) -> Scene:
    """Return two images side by side, at their full size, with lines; ``pairs`` are (n, 4): x and y in both."""
    import numpy as np

    left, right = (np.asarray(_picture(backdrop, None)) for backdrop in backdrops)
    height, width = max(len(left), len(right)), left.shape[1]
    joined = np.zeros((height, width + right.shape[1], 3), np.uint8)
    joined[: len(left), :width] = left
    joined[: len(right), width:] = right
    ends = np.add(pairs, (0, 0, width, 0)).reshape(-1, 2, 2)
    marks = Marks(ends.reshape(-1, 2), tuple(ends), total=total)
    return Scene(Backdrop(joined, "rgb", (0.0, 255.0), ""), marks, what)


def _is_drawable(places: Floats) -> npt.NDArray[np.bool_]:
    import numpy as np

    return np.asarray((np.abs(np.nan_to_num(places, nan=np.inf)) < _FARTHEST_PX).all(axis=1))


def _drawn_over(backdrop: Backdrop, marks: Marks, side: int = THUMBNAIL_PX) -> Image.Image:
    canvas, scale = _canvas(backdrop, side * _OVERSAMPLED)
    pen = _Pen(canvas)
    for line in marks.lines:
        pen.line((line + 0.5) * scale, _GREEN, _LINE_PX, is_closed=marks.are_closed)
    radius = _LARGE_RADIUS_PX if len(marks.points) <= _FEW else _RADIUS_PX
    for x, y in (marks.points + 0.5) * scale:
        pen.point(x, y, _GREEN, radius)
    return canvas.reduce(_OVERSAMPLED)


def _drawn_between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats) -> Image.Image:
    import numpy as np

    side = THUMBNAIL_PX * _OVERSAMPLED // 2
    (left, left_scale), (right, right_scale) = (_canvas(backdrop, side) for backdrop in backdrops)
    canvas: Image.Image = pillow().new("RGB", (2 * side, max(left.height, right.height)))
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
    picture = picture.resize((width, height), pillow().Resampling.BILINEAR)
    return picture.point(lambda level: round(level * _DARKER)), scale


def _picture(backdrop: Backdrop, side: int | None) -> Image.Image:
    array = backdrop.image
    return pillow_image(array, side, backdrop.order, backdrop.ends, image_kind(array, sampled(array))).convert("RGB")


class _Pen:
    """Draws upon a canvas, and nothing that is far off: Pillow would visit each pixel of a line, wherever it is."""

    def __init__(self, canvas: Image.Image) -> None:
        with optional_import():
            from PIL import ImageDraw

        self._draw = ImageDraw.Draw(canvas)
        self._low = -_MARGIN * canvas.width, -_MARGIN * canvas.height
        self._high = (1 + _MARGIN) * canvas.width, (1 + _MARGIN) * canvas.height

    def point(self, x: float, y: float, colour: _Colour, radius: float = _RADIUS_PX) -> None:
        """Draw a dot."""
        if self._is_near(((x, y),)):
            self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline=(0, 0, 0))

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
            near = self._near_part(start, end)
            if near:
                self._draw.line(near, fill=colour, width=width)

    def _is_near(self, places: Iterable[_Place]) -> bool:
        (left, top), (right, bottom) = self._low, self._high
        return all(left <= x <= right and top <= y <= bottom for x, y in places)

    def _near_part(self, start: _Place, end: _Place) -> list[_Place]:
        """Return the ends of the part of a line that is near (Liang and Barsky); none if there is none."""
        axes = list(zip(start, end, self._low, self._high, strict=True))
        first, last = 0.0, 1.0
        for a, b, low, high in axes:
            if not math.isfinite(b - a) or (a == b and not low <= a <= high):
                return []
            if a != b:
                enters, leaves = sorted(((low - a) / (b - a), (high - a) / (b - a)))
                first, last = max(first, enters), min(last, leaves)
        if first > last:
            return []
        # Within limits once more: of very large numbers the difference is not exact.
        parts = [[min(max(a + share * (b - a), low), high) for a, b, low, high in axes] for share in (first, last)]
        return [(x, y) for x, y in parts]
