"""What was found in images: keypoints, matches, contours, segments, boxes, circles, points and optical flow.

They are drawn over the image that they were found in; where there is none, most become a chart in their own extent.

What an array or a list of numbers means is nowhere written. Circles, boxes in lists and flow are drawn only where
shape, dtype and image leave hardly another meaning, or where a name says what they are: that of the token, or one that
the function that made it uses. Each rule stands in the docstring of its function; what does not fit stays text.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews import Backdrop, Look, Marks, Most, Preview, Scene, Sketch
from epypes.display.previews.drawing import (
    MOST_LINES,
    MOST_POINTS,
    drawn_between,
    drawn_over,
    pair_scene,
    place_chart,
    spread,
)
from epypes.display.previews.encoding import encode_small
from epypes.display.previews.introspection import dotted_name, is_of
from epypes.display.previews.short import array_text, row_texts
from epypes.display.text import cut
from epypes.optional import LazyModule

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.display.previews import Floats
else:
    np = LazyModule("numpy")

# So many items of a list are looked at to know what it is a list of, and to choose the strongest keypoints.
_LOOKED_AT: Final = 100
_WEIGHED: Final = 10_000
_NAME_CHARACTERS: Final = 40
_MOST_ROWS: Final = 4
_FARTHEST_PX: Final = 1e6
_INSIDE: Final = 0.5

# -- marks ------------------------------------------------------------------------------------------------------------


def _some_points(points: Any, most: Most, total: int | None = None, extents: Floats | None = None) -> Marks:
    """Return points as marks: of many some, evenly spread in their order, none that is not finite."""
    total = len(points) if total is None else total
    chosen = spread(len(points), most.marks)
    kept = points[chosen].reshape(-1, 2).astype(np.float64)
    is_drawn = _is_drawable(kept)
    return Marks(kept[is_drawn], total=total, extents=None if extents is None else extents[chosen][is_drawn])


def no_marks() -> Marks:
    """Return what is drawn where nothing was found."""
    return Marks(np.empty((0, 2)))


def _some_pairs(places: Any, most: Most) -> Floats:
    """Return pairs (n, 4) of places as they are drawn: of many some, none that is not finite or far away."""
    kept: Floats = places[spread(len(places), most.pairs)].astype(np.float64)
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


def _is_drawable(places: Floats) -> npt.NDArray[np.bool_]:
    return np.asarray((np.abs(np.nan_to_num(places, nan=np.inf)) < _FARTHEST_PX).all(axis=1))


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
    are_boxes = _fit_as_sizes(array, backdrop)
    marks = _rectangles(array, look.most) if are_boxes else _segments(array, look.most)
    if not _lie_on(marks.places, backdrop):
        return None
    what = "boxes" if are_boxes else "segments"
    detail = f"{array_text(array)}, {what}{' (x, y, width, height)' * are_boxes}"
    return _over(marks, what, array_text(array), detail, look)


def _fit_as_sizes(boxes: Any, backdrop: Backdrop) -> bool:
    """Whether boxes (n, 4) lie within an image as x, y, width and height, none without extent."""
    height, width = backdrop.image.shape[:2]
    ends = boxes[:, :2].astype("f8") + boxes[:, 2:]
    return bool((boxes[:, 2:] > 0).all() and (ends <= (width, height)).all())


def says_circles(look: Look) -> bool:
    """Whether the token's name, or one that its function uses, has to do with circles."""
    return any("circle" in name.lower() for name in (look.around.name, *look.around.maker_names()))


def circle_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at circles (1, n, 3) or (n, 3) of x, y and radius; None if they don't fit an image as circles.

    ``cv2.HoughCircles`` returns float32 (1, n, 3), which few other functions do. Its circles are often rounded or taken
    out of the first axis: (n, 3) is as well a point cloud or the colours of a palette, so ``says_circles`` must hold
    for any other array (the caller asks). In any case all middles must lie on the nearest image, and not all in its
    first pixel, no radius may be negative or larger than the image, and all must be finite.
    """
    circles, backdrop = array.reshape(-1, 3).astype(np.float64), look.around.nearest_image()
    if backdrop is None or not len(circles) or not np.isfinite(circles).all():
        return None
    middles, radii = circles[:, :2], circles[:, 2]
    are_inside = (middles >= 0).all() and (middles <= backdrop.image.shape[1::-1]).all()
    has_sizes = (radii >= 0).all() and radii.max() <= max(backdrop.image.shape[:2])
    if not (are_inside and has_sizes and _lie_on(middles, backdrop)):
        return None
    # The first ones: the detector lists the strongest first.
    kept = circles[: look.most.marks]
    extents = np.stack([2 * kept[:, 2], np.full(len(kept), -1.0)], axis=1)
    marks = Marks(kept[:, :2], total=len(circles), extents=extents, are_circles=True)
    detail = f"{array_text(array)}, circles (x, y, radius), radius {radii.min():.4g} to {radii.max():.4g}"
    return _over(marks, "circles", array_text(array), detail, look)


# -- optical flow --------------------------------------------------------------------------------------------------

# So many pairs of neighbours are looked at.
_FLOW_PX: Final = 60_000
_LANDS: Final = 0.9
_SMOOTH: Final = 0.25
_MOST_ARROWS_ALONG: Final = 32
# An arrow may be so many times as long as from one to the next; it has a head of a third of its length.
_REACH: Final = 1.5
_LEAST_REACH: Final = 0.1
_HEAD: Final = 0.3
_HEAD_RADIANS: Final = 0.45


def has_flow_shape(array: Any) -> bool:
    """Whether an array is float32 (height, width, 2), as of OpenCV, or (2, height, width), as of scikit-image."""
    return bool(array.ndim == 3 and array.dtype.str[1:] == "f4" and 2 in (array.shape[0], array.shape[2]))


def flow_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at optical flow: how far, x and y, each pixel moves from one image to the next; None if it is none.

    A spectrum (``cv2.dft``), a map of coordinates (``cv2.remap``), gradients and two images in one array have this
    shape, too. So it must have been made from two photographs of its size, each by an input of its own; all is finite,
    and nothing moves farther than the image is wide and high; nine tenths of the pixels stay on the image; neighbours
    move alike; and not all is between 0 and 1 or whole, as levels are.
    """
    is_of_opencv, pair = array.shape[2] == 2, look.around.image_pair()
    flow = array if is_of_opencv else np.moveaxis(array, 0, -1)[..., ::-1]
    if pair is None or any(each.image.shape[:2] != flow.shape[:2] for each in pair) or not _is_flow(flow):
        return None
    height, width = flow.shape[:2]
    cell = max(4, -(-max(height, width) // _MOST_ARROWS_ALONG), int(np.ceil(np.sqrt(height * width / look.most.marks))))
    y, x = np.mgrid[cell // 2 : height : cell, cell // 2 : width : cell].reshape(2, -1)
    moves = flow[y, x].astype(np.float64)
    lengths = np.hypot(*moves.T)
    factor = _round_down(_REACH * cell / largest) if (largest := float(lengths.max(initial=0.0))) > 0 else 1.0
    is_seen = lengths * factor >= _LEAST_REACH * cell
    starts = np.stack([x, y], axis=1)[is_seen].astype(np.float64)
    arrows = _arrows(starts, moves[is_seen] * factor)
    marks = Marks(np.empty((0, 2)), tuple(arrows), total=len(arrows))
    times = f", {factor:g} times as long" if factor > 1 else ""
    detail = f"{array_text(array)}, optical flow of {lengths.min():.3g} to {largest:.3g} px"
    backdrop = pair[0]
    return Sketch(
        Preview(array_text(array), f"{detail}, drawn over {cut(backdrop.name, _NAME_CHARACTERS)}{times}"),
        lambda most_bytes: encode_small(drawn_over(backdrop, marks), most_bytes, has_small_marks=True),
        scene=partial(Scene, backdrop, marks, f"arrows of flow{times}"),
    )


def _is_flow(flow: Any) -> bool:
    """Whether the values of an array (height, width, 2) are those of a flow."""
    height, width = flow.shape[:2]
    stride = int(np.ceil(np.sqrt(height * width / _FLOW_PX)))
    at, right, below = flow[:-1:stride, :-1:stride], flow[:-1:stride, 1::stride], flow[1::stride, :-1:stride]
    at, right, below = (part[: at.shape[0], : at.shape[1]].astype(np.float64) for part in (at, right, below))
    if not at.size or not np.isfinite(at).all() or not (np.abs(at) < (width, height)).all():
        return False
    if not at.any():
        return True
    ends = at + np.stack(np.meshgrid(np.arange(at.shape[1]), np.arange(at.shape[0])), axis=-1) * stride
    stays = ((ends >= -1) & (ends <= (width, height))).all(axis=-1).mean() >= _LANDS
    are_levels = (at.min() >= 0 and at.max() <= 1) or not (at % 1).any()
    is_smooth = ((at - right) ** 2 + (at - below) ** 2).mean() / 2 <= _SMOOTH * (at**2).mean()
    return bool(stays and is_smooth and not are_levels)


def _round_down(number: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, 50, ... that is not larger; at least 1."""
    power = 10.0 ** np.floor(np.log10(max(number, 1.0)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= max(number, 1.0)))


def _arrows(starts: Floats, moves: Floats) -> list[Floats]:
    """Return arrows as lines (5, 2): to the tip, and from there to each end of the head and back."""
    tips = starts + moves
    cos, sin = np.cos(_HEAD_RADIANS), np.sin(_HEAD_RADIANS)
    turned = [moves @ np.array([[cos, side * sin], [-side * sin, cos]]) * _HEAD for side in (1, -1)]
    return list(np.stack([starts, tips, tips - turned[0], tips, tips - turned[1]], axis=1))


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
        return Sketch(Preview(text, detail + _left_out(drawn, marks.total)), lambda most_bytes: place_chart(marks))
    detail += f", drawn over {cut(backdrop.name, _NAME_CHARACTERS)}{_left_out(marks.drawn, marks.total)}"
    return Sketch(
        Preview(text, detail),
        lambda most_bytes: encode_small(drawn_over(backdrop, marks), most_bytes, has_small_marks=True),
        scene=partial(Scene, backdrop, marks, what),
    )


def _backdrop(marks: Marks, look: Look) -> Backdrop | None:
    backdrop = look.around.nearest_image()
    return backdrop if backdrop is not None and _lie_on(marks.places, backdrop) else None


def _between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, shown: Preview, what: str) -> Sketch:
    """Draw pairs (n, 4) of places, x and y in both images, as lines from one image to the other."""
    return Sketch(
        replace(shown, detail=f"{shown.detail}, drawn between the images{_left_out(len(pairs), total)}"),
        lambda most_bytes: encode_small(drawn_between(backdrops, pairs), most_bytes, has_small_marks=True),
        scene=partial(pair_scene, backdrops, pairs, total, what),
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
    found = next((each for each in _LISTS if each[0](value)), None)
    if found is None:
        return None
    _, noun, closer = found
    text = f"{len(value)} {noun}{('es' if noun.endswith(('ch', 'x')) else 's') * (len(value) != 1)}"
    shown = Preview(text, f"{name} of {text}")
    if found in _UNPROVED:
        return Sketch(plain(), closer=lambda: closer(value, shown, look) or plain())
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


def _is_number(item: Any) -> bool:
    return type(item) in (int, float) or (is_of(item, "numpy", "generic") and item.dtype.kind in "iuf")


def _is_box(item: Any) -> bool:
    return type(item) in (tuple, list) and len(item) == 4 and all(_is_number(n) and n == int(n) for n in item)


def _is_circle(item: Any) -> bool:
    """Whether an item is what ``cv2.minEnclosingCircle`` returns, ((x, y), radius)."""
    if type(item) is not tuple or len(item) != 2:
        return False
    middle, radius = item
    return _is_number(radius) and type(middle) is tuple and len(middle) == 2 and all(map(_is_number, middle))


_OPENCV_BOXES: Final = frozenset({"boundingRect", "detectMultiScale", "groupRectangles"})


def _boxes(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    """Look at a list of tuples of four whole numbers; None if they may be anything else than boxes.

    OpenCV's boxes are x, y, width, height, those of scikit-image (``regionprops``' ``bbox``) row and column of two
    corners, those of many networks x and y of two corners, and four whole numbers may be counts or a colour. So the
    token's name must have "box" or "rect" in it, or the function that made it use ``boundingRect``,
    ``detectMultiScale``, ``groupRectangles`` or ``bbox``. All must lie within the nearest image; and where no function
    shows which they are, they are x, y, width, height only if they can't be two corners.
    """
    backdrop, used, name = look.around.nearest_image(), look.around.maker_names(), look.around.name.lower()
    are_of_opencv = bool(used & _OPENCV_BOXES)
    is_said = are_of_opencv or "bbox" in used or "box" in name or "rect" in name
    known = value[:_WEIGHED]
    if backdrop is None or not is_said or not all(map(_is_box, known)):
        return None
    boxes = np.array(known, dtype=np.float64)
    height, width = backdrop.image.shape[:2]
    starts, ends = boxes[:, :2], boxes[:, 2:]
    may_be_corners = bool((ends > starts).all())
    if (starts < 0).any():
        return None
    if "bbox" in used and not are_of_opencv:
        if not may_be_corners or not (ends <= (height, width)).all():
            return None
        boxes, form = np.concatenate([starts, ends - starts], axis=1)[:, [1, 0, 3, 2]], "row, column of two corners"
    elif _fit_as_sizes(boxes, backdrop) and (are_of_opencv or not may_be_corners):
        form = "x, y, width, height"
    else:
        return None
    marks = replace(_rectangles(boxes, look.most), total=len(value))
    return _over(marks, "boxes", shown.text, f"{shown.detail} ({form})", look)


def _circles(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    known = value[:_WEIGHED]
    circles = np.array([(*middle, radius) for middle, radius in known]) if all(map(_is_circle, known)) else None
    found = None if circles is None else circle_sketch(circles, look)
    return None if found is None else replace(found, shown=replace(found.shown, text=shown.text))


_Closer = Callable[[Any, Preview, Look], Sketch | None]
# What the numbers in a list mean is known on a closer look.
_UNPROVED: Final[tuple[tuple[Callable[[Any], bool], str, _Closer], ...]] = (
    (lambda value: _are_all(value, _is_box), "box", _boxes),
    (lambda value: _are_all(value, _is_circle), "circle", _circles),
)
_LISTS: Final = (
    (are_keypoints, "keypoint", _keypoints),
    (_are_matches, "match", _matches),
    (_are_contours, "contour", _contours),
    *_UNPROVED,
)
