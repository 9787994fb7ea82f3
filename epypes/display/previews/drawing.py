"""Drawings: charts of numbers, and what was found in images drawn over them.

Keypoints, matches, contours, segments, boxes and points are drawn over the image that they were found in; where there
is none, they become a chart in their own extent.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews import THUMBNAIL_PX, Backdrop, Chart, Look, Marks, Most, Picture, Preview, Scene, Sketch
from epypes.display.previews.encoding import encode_image, encode_small, pillow_image
from epypes.display.previews.images import image_kind, sampled, some_of
from epypes.display.previews.introspection import dotted_name, is_of
from epypes.display.previews.short import array_text, row_texts
from epypes.display.text import cut
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


def _place_chart(marks: Marks) -> Chart:
    """Draw marks without their image: in their own extent, both axes alike, y downwards."""
    points = marks.points[_spread(len(marks.points), MOST_POINTS)]
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


def _spread(count: int, most: int) -> npt.NDArray[np.intp]:
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


def _some_points(points: Any, most: Most, total: int | None = None, extents: Floats | None = None) -> Marks:
    """Return points as marks: of many some, evenly spread in their order, none that is not finite."""
    total = len(points) if total is None else total
    chosen = _spread(len(points), most.marks)
    kept = points[chosen].reshape(-1, 2).astype(np.float64)
    is_drawn = _is_drawable(kept)
    return Marks(kept[is_drawn], total=total, extents=None if extents is None else extents[chosen][is_drawn])


def no_marks() -> Marks:
    """Return what is drawn where nothing was found."""
    return Marks(np.empty((0, 2)))


def _some_pairs(places: Any, most: Most) -> Floats:
    """Return pairs (n, 4) of places as they are drawn: of many some, none that is not finite or far away."""
    kept: Floats = places[_spread(len(places), most.pairs)].astype(np.float64)
    return kept[_is_drawable(kept)]


def _some_lines(lines: Any, are_closed: bool, most: Most, total: int | None = None) -> Marks:
    """Return lines, each (k, 2), as marks: of many the longest, each with at most so many points."""
    longest = sorted(lines, key=len, reverse=True)[: most.marks] if len(lines) > most.marks else lines
    room = min(most.line, _share([len(line) for line in longest], most.places))
    kept = [line[:: -(-len(line) // room) or 1].reshape(-1, 2) for line in longest if len(line)]
    count = len(lines) if total is None else total
    return Marks(np.empty((0, 2)), tuple(_drawable_lines(kept)), are_closed, count)


def _drawable_lines(lines: list[Any]) -> list[Floats]:
    """Return the lines without what can't be drawn of them; looked at together, since there may be thousands."""
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


def _share_on(points: Floats, backdrop: Backdrop) -> float:
    """Return which part of these points lie on the image, from 0 to 1."""
    height, width = backdrop.image.shape[:2]
    x, y = points[:, 0], points[:, 1]
    return float(((x >= -1) & (y >= -1) & (x <= width) & (y <= height)).mean()) if len(points) else 1.0


def _lie_on(points: Floats, backdrop: Backdrop) -> bool:
    """Whether most of these points lie on the image, and not all in its first pixel, where shares would be."""
    is_in_first_pixel = len(points) > 1 and float(abs(points).max()) <= 1.0
    return _share_on(points, backdrop) >= _INSIDE and not is_in_first_pixel


def scene_picture(scene: Scene, max_side_px: int, most_bytes: int) -> Picture:
    """Return a scene as one picture, its marks drawn, whose longer side and whose bytes are at most these."""
    seen = scene.backdrop
    if scene.marks is None:
        return encode_image(seen.image, max_side_px, seen.order, seen.ends, most_bytes)
    side = min(max_side_px, max(THUMBNAIL_PX, *seen.image.shape[:2]))
    return encode_small(_drawn_over(seen, scene.marks, side), most_bytes, has_small_marks=True)


def _pair_scene(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, what: str) -> Scene:
    """Return two images side by side, at their full size, with lines; ``pairs`` are (n, 4): x and y in both."""
    left, right = (np.asarray(_picture(backdrop, None)) for backdrop in backdrops)
    height, width = max(len(left), len(right)), left.shape[1]
    joined = np.zeros((height, width + right.shape[1], 3), np.uint8)
    joined[: len(left), :width] = left
    joined[: len(right), width:] = right
    ends = np.add(pairs, (0, 0, width, 0)).reshape(-1, 2, 2)
    marks = Marks(ends.reshape(-1, 2), tuple(ends), total=total)
    return Scene(Backdrop(joined, "rgb", (0.0, 255.0), ""), marks, what)


def _is_drawable(places: Floats) -> npt.NDArray[np.bool_]:
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


# -- previews of what was found in images ----------------------------------------

# So many items of a list are looked at to know what it is a list of, and to choose the strongest keypoints.
_LOOKED_AT: Final = 100
_WEIGHED: Final = 10_000
_NAME_CHARACTERS: Final = 40
_MOST_ROWS: Final = 4

# -- arrays of places ----------------------------------------------------------------------------------------------


def point_sketch(array: Any, look: Look, *, needs_image: bool = False) -> Sketch | None:
    """Look at an array (n, 2) or (n, 1, 2) of places; None if it needs an image that they lie on, and has none.

    OpenCV gives x and y, as int32 or float32 or with an axis of their own; scikit-image and NumPy give row and column,
    as int64 or float64. If more of them lie on the image the other way round, they are taken so.
    """
    places = array.reshape(-1, 2)
    are_rows = array.ndim == 2 and array.dtype.itemsize == 8
    as_rows, as_points = (_some_points(each, look.most) for each in (places[:, ::-1], places))
    image = look.around.nearest_image() if array.ndim == 2 else None
    if image is not None:
        on_rows, on_points = _share_on(as_rows.points, image), _share_on(as_points.points, image)
        are_rows = on_rows >= on_points if are_rows else on_rows > on_points
    marks = as_rows if are_rows else as_points
    if needs_image and _backdrop(marks, look) is None:
        return None
    order = "(row, column)" if are_rows else "(x, y)"
    detail = f"{array_text(array)}, points {order}{_extent(places[:, ::-1] if are_rows else places)}"
    return _over(marks, "points", array_text(array), detail, look)


def segment_sketch(array: Any, look: Look) -> Sketch:
    """Look at an array (n, 1, 4) of the two ends of line segments."""
    detail = f"{array_text(array)}, segments{_extent(array)}"
    return _over(_segments(array, look.most), "segments", array_text(array), detail, look)


def _segments(array: Any, most: Most) -> Marks:
    # The first ones: detectors list the strongest first.
    return replace(_some_lines(list(array.reshape(-1, 2, 2)[: most.marks]), False, most), total=len(array))


def _rectangles(boxes: Any, most: Most) -> Marks:
    """Return boxes (n, 4) of x, y, width and height as marks."""
    x, y, width, height = boxes[: most.marks].astype(np.float64).T
    corners = np.stack([x, y, x + width, y, x + width, y + height, x, y + height], axis=1)
    return replace(_some_lines(list(corners.reshape(-1, 4, 2)), True, most), total=len(boxes))


def quad_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at an array (n, 4): places in two images, boxes, or segments as newer OpenCV has them.

    None if they lie on no image. The numbers do not show which they are: boxes are what lies, with width and height,
    within the image.
    """
    paired, backdrop = _pair_sketch(array, look), look.around.nearest_image()
    if paired is not None or backdrop is None or array.dtype.kind not in "iu" or not len(array):
        return paired
    height, width = backdrop.image.shape[:2]
    ends = array[:, :2].astype("f8") + array[:, 2:]
    are_boxes = bool((array[:, 2:] > 0).all() and (ends <= (width, height)).all())
    marks = _rectangles(array, look.most) if are_boxes else _segments(array, look.most)
    if not _lie_on(marks.places, backdrop):
        return None
    what = "boxes" if are_boxes else "segments"
    detail = f"{array_text(array)}, {what}{' (x, y, width, height)' * are_boxes}"
    return _over(marks, what, array_text(array), detail, look)


def _pair_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at an array (n, 4) of places in two images; None if there are no such images."""
    backdrops = look.around.image_pair()
    if backdrops is None or not len(array):
        return None
    pairs = _some_pairs(array, look.most)
    first, second = backdrops
    if not len(pairs) or not _lie_on(pairs[:, :2], first) or not _lie_on(pairs[:, 2:], second):
        return None
    text = array_text(array)
    return _between(backdrops, pairs, len(array), Preview(text, f"{text}, places in two images"), "pairs")


def _extent(points: Any) -> str:
    """Return where points lie; of very many, where some of them do."""
    some = points[:: -(-len(points) // _WEIGHED) or 1].reshape(-1, 2).astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return ""
    (left, top), (right, bottom) = some.min(axis=0), some.max(axis=0)
    return f", x {left:.4g} to {right:.4g}, y {top:.4g} to {bottom:.4g}"


# -- drawn over images ---------------------------------------------------------------------------------------------


def _over(marks: Marks, what: str, text: str, detail: str, look: Look) -> Sketch:
    """Draw marks over the nearest image if they lie on it, else as a chart in their own extent."""
    backdrop = _backdrop(marks, look)
    if backdrop is None:
        drawn = min(len(marks.lines), MOST_LINES) or min(len(marks.points), MOST_POINTS)
        return Sketch(Preview(text, detail + _left_out(drawn, marks.total)), lambda most_bytes: _place_chart(marks))
    detail += f", drawn over {cut(backdrop.name, _NAME_CHARACTERS)}{_left_out(marks.drawn, marks.total)}"
    return Sketch(
        Preview(text, detail),
        lambda most_bytes: encode_small(_drawn_over(backdrop, marks), most_bytes, has_small_marks=True),
        scene=partial(Scene, backdrop, marks, what),
    )


def _backdrop(marks: Marks, look: Look) -> Backdrop | None:
    backdrop = look.around.nearest_image()
    return backdrop if backdrop is not None and _lie_on(marks.places, backdrop) else None


def _between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, shown: Preview, what: str) -> Sketch:
    """Draw pairs (n, 4) of places, x and y in both images, as lines from one image to the other."""
    return Sketch(
        replace(shown, detail=f"{shown.detail}, drawn between the images{_left_out(len(pairs), total)}"),
        lambda most_bytes: encode_small(_drawn_between(backdrops, pairs), most_bytes, has_small_marks=True),
        scene=partial(_pair_scene, backdrops, pairs, total, what),
    )


def _left_out(drawn: int, total: int) -> str:
    return f", {drawn} of {total} drawn" * (drawn < total)


# -- lists of OpenCV's objects -------------------------------------------------------------------------------------


def list_sketch(value: Sequence[Any], name: str, look: Look, plain: Callable[[], Preview]) -> Sketch | None:
    """Look at a list or tuple of what can be drawn; None if it is any other.

    Parameters
    ----------
    name
        What such a list is called.
    plain
        Looks at it if on a closer look it is any other.
    """
    found = next(((noun, closer) for is_kind, noun, closer in _LISTS if is_kind(value)), None)
    if found is None:
        return None
    noun, closer = found
    text = f"{len(value)} {noun}{('es' if noun.endswith('ch') else 's') * (len(value) != 1)}"
    shown = Preview(text, f"{name} of {text}")
    return Sketch(shown, closer=lambda: closer(value, shown, look) or plain())


def are_keypoints(value: Any) -> bool:
    """Whether a value is a list or tuple of OpenCV's keypoints."""
    return type(value) in (list, tuple) and _are_all(value, _is_keypoint)


def _are_matches(value: Sequence[Any]) -> bool:
    return _are_all(value, _is_match) or (_are_all(value, _is_match_list) and any(value[:_WEIGHED]))


def _are_contours(value: Sequence[Any]) -> bool:
    return _are_all(value, lambda item: is_of(item, "numpy", "ndarray") and _has_contour_shape(item))


def _are_all(value: Sequence[Any], is_kind: Callable[[Any], bool]) -> bool:
    """Whether all items are of a kind, as far as some of them, and the classes of many, show; no item, no kind."""
    step = -(-len(value) // _LOOKED_AT) or 1
    if not value or not all(is_kind(item) for item in itertools.islice(value, 0, None, step)):
        return False
    return _are_of_one_class(value)


def _are_of_one_class(value: Sequence[Any]) -> bool:
    first = type(value[0])
    return all(type(item) is first for item in itertools.islice(value, _WEIGHED))


def _is_keypoint(item: Any) -> bool:
    return dotted_name(type(item)) == "cv2.KeyPoint"


def _is_match(item: Any) -> bool:
    return dotted_name(type(item)) == "cv2.DMatch"


def _is_match_list(item: Any) -> bool:
    return type(item) in (list, tuple) and len(item) <= 16 and all(map(_is_match, item))


def _has_contour_shape(array: Any) -> bool:
    axes = array.shape[1:]
    return bool(array.dtype.kind in "iuf" and (axes == (1, 2) or (axes == (2,) and array.dtype.str[1:] == "f8")))


def _keypoints(value: Sequence[Any], shown: Preview, look: Look) -> Sketch:
    weighed = sorted(value[:_WEIGHED], key=lambda keypoint: -keypoint.response)[: look.most.marks]
    extents = np.array([(keypoint.size, keypoint.angle) for keypoint in weighed], dtype=np.float64)
    points = np.array([keypoint.pt for keypoint in weighed], dtype=np.float64)
    marks, sizes = _some_points(points, look.most, len(value), extents), extents[:, 0]
    detail = f"{shown.detail}{_extent(marks.points)}, size {min(sizes):.4g} to {max(sizes):.4g}"
    return _over(marks, "keypoints", shown.text, detail, look)


def _matches(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    known = value[:_WEIGHED]
    flat = known if _is_match(value[0]) else [item[0] for item in known if len(item)]
    if not _is_match(flat[0]) or not _are_of_one_class(flat):
        return None
    distances = [match.distance for match in flat]
    detail = f"{shown.detail}, distance {min(distances):.4g} to {max(distances):.4g}"
    backdrops, keypoints = look.around.image_pair(), look.around.keypoint_pair()
    kept = flat[: look.most.pairs]
    if backdrops is not None and keypoints is not None and _indices_fit(kept, *keypoints):
        first, second = keypoints
        pairs = _some_pairs(np.array([(*first[m.queryIdx].pt, *second[m.trainIdx].pt) for m in kept]), look.most)
        if len(pairs):
            return _between(backdrops, pairs, len(value), Preview(shown.text, detail), "matches")
    rows = (f"{match.queryIdx} - {match.trainIdx}: {match.distance:.4g}" for match in flat)
    return Sketch(Preview(shown.text, detail, rows=row_texts(rows, len(value), _MOST_ROWS)))


def _indices_fit(matches: Sequence[Any], first: Sequence[Any], second: Sequence[Any]) -> bool:
    def is_index(keypoints: Sequence[Any], index: int) -> bool:
        return 0 <= index < len(keypoints) and _is_keypoint(keypoints[index])

    return all(is_index(first, match.queryIdx) and is_index(second, match.trainIdx) for match in matches)


def _contours(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    known, axes = value[:_WEIGHED], value[0].ndim
    if not all(line.ndim == axes and _has_contour_shape(line) for line in known):
        return None
    are_rows = axes == 2
    turned = [line[:, ::-1] for line in known] if are_rows else known
    marks = _some_lines(turned, not are_rows, look.most, len(value))
    order = ", (row, column) as scikit-image has them" if are_rows else ""
    first = f" in the first {_WEIGHED}" * (len(known) < len(value))
    detail = f"{shown.detail}, {sum(map(len, known))} points{first}, {value[0].dtype}{order}"
    return _over(marks, "contours", shown.text, detail, look)


_LISTS: Final[tuple[tuple[Callable[[Any], bool], str, Callable[[Any, Preview, Look], Sketch | None]], ...]] = (
    (are_keypoints, "keypoint", _keypoints),
    (_are_matches, "match", _matches),
    (_are_contours, "contour", _contours),
)
