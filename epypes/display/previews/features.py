"""Previews of keypoints, matches, contours, segments, boxes and points: what was found in images, drawn over them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.drawing import (
    drawer,
    drawn_in_chart,
    lie_on,
    marks_lie_on,
    pair_drawer,
    pair_scene,
    rectangles,
    share_on,
    some_lines,
    some_pairs,
    some_points,
)
from epypes.display.previews.introspection import dotted_name, is_of
from epypes.display.previews.model import Backdrop, Look, Marks, Most, Preview, Scene, Sketch
from epypes.display.previews.short import array_text
from epypes.display.text import cut

if TYPE_CHECKING:
    from epypes.display.previews.model import Floats

# So many items of a list are looked at to know what it is a list of, and to choose the strongest keypoints.
_LOOKED_AT: Final = 100
_WEIGHED: Final = 10_000
_NAME_CHARACTERS: Final = 40

# -- arrays of places ----------------------------------------------------------------------------------------------


def point_sketch(array: Any, look: Look, *, needs_image: bool = False) -> Sketch | None:
    """Look at an array (n, 2) or (n, 1, 2) of places; None if it needs an image that they lie on, and has none.

    OpenCV gives x and y, as int32 or float32 or with an axis of their own; scikit-image and NumPy give row and column,
    as int64 or float64. If more of them lie on the image the other way round, they are taken so.
    """
    places = array.reshape(-1, 2)
    are_rows = array.ndim == 2 and array.dtype.itemsize == 8
    as_rows, as_points = (some_points(each, look.most) for each in (places[:, ::-1], places))
    image = look.around.nearest_image() if array.ndim == 2 else None
    if image is not None:
        on_rows, on_points = share_on(as_rows.points, image), share_on(as_points.points, image)
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
    return replace(some_lines(list(array.reshape(-1, 2, 2)[: most.marks]), False, most), total=len(array))


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
    marks = rectangles(array, look.most) if are_boxes else _segments(array, look.most)
    if not marks_lie_on(marks, backdrop):
        return None
    what = "boxes" if are_boxes else "segments"
    detail = f"{array_text(array)}, {what}{' (x, y, width, height)' * are_boxes}"
    return _over(marks, what, array_text(array), detail, look)


def _pair_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at an array (n, 4) of places in two images; None if there are no such images."""
    backdrops = look.around.image_pair()
    if backdrops is None or not len(array):
        return None
    pairs = some_pairs(array, look.most)
    first, second = backdrops
    if not len(pairs) or not lie_on(pairs[:, :2], first) or not lie_on(pairs[:, 2:], second):
        return None
    text = array_text(array)
    return _between(backdrops, pairs, len(array), Preview(text, f"{text}, places in two images"), "pairs")


def _extent(points: Any) -> str:
    """Return where points lie; of very many, where some of them do."""
    import numpy as np

    some = points[:: -(-len(points) // _WEIGHED) or 1].reshape(-1, 2).astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return ""
    (left, top), (right, bottom) = some.min(axis=0), some.max(axis=0)
    return f", x {left:.4g} to {right:.4g}, y {top:.4g} to {bottom:.4g}"


# -- drawn over images ---------------------------------------------------------------------------------------------


def _over(marks: Marks, what: str, text: str, detail: str, look: Look) -> Sketch:
    backdrop = _backdrop(marks, look)
    scene = None if backdrop is None else partial(Scene, backdrop, marks, what)
    drawn = marks.drawn if backdrop else drawn_in_chart(len(marks.points), len(marks.lines))
    if backdrop is not None:
        detail += f", drawn over {cut(backdrop.name, _NAME_CHARACTERS)}"
    if drawn < marks.total:
        detail += f", {drawn} of {marks.total} drawn"
    return Sketch(Preview(text, detail), drawer(marks, backdrop), scene=scene)


def _backdrop(marks: Marks, look: Look) -> Backdrop | None:
    backdrop = look.around.nearest_image()
    return backdrop if backdrop is not None and marks_lie_on(marks, backdrop) else None


def _between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, shown: Preview, what: str) -> Sketch:
    detail = f"{shown.detail}, drawn between the images"
    if len(pairs) < total:
        detail += f", {len(pairs)} of {total} drawn"
    scene = partial(pair_scene, backdrops, pairs, total, what)
    return Sketch(Preview(shown.text, detail), pair_drawer(backdrops, pairs), scene=scene)


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
    import numpy as np

    weighed = sorted(value[:_WEIGHED], key=lambda keypoint: -keypoint.response)[: look.most.marks]
    extents = np.array([(keypoint.size, keypoint.angle) for keypoint in weighed], dtype=np.float64)
    points = np.array([keypoint.pt for keypoint in weighed], dtype=np.float64)
    marks, sizes = some_points(points, look.most, len(value), extents), extents[:, 0]
    detail = f"{shown.detail}{_extent(marks.points)}, size {min(sizes):.4g} to {max(sizes):.4g}"
    return _over(marks, "keypoints", shown.text, detail, look)


def _matches(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    import numpy as np

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
        pairs = some_pairs(np.array([(*first[m.queryIdx].pt, *second[m.trainIdx].pt) for m in kept]), look.most)
        if len(pairs):
            return _between(backdrops, pairs, len(value), Preview(shown.text, detail), "matches")
    rows = [f"{m.queryIdx} - {m.trainIdx}: {m.distance:.4g}" for m in flat[:3]]
    rows += [f"... {len(value) - 3} more"] * (len(value) > 3)
    return Sketch(Preview(shown.text, detail, rows=tuple(rows)))


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
    marks = some_lines(turned, not are_rows, look.most, len(value))
    order = ", (row, column) as scikit-image has them" if are_rows else ""
    first = f" in the first {_WEIGHED}" * (len(known) < len(value))
    detail = f"{shown.detail}, {sum(map(len, known))} points{first}, {value[0].dtype}{order}"
    return _over(marks, "contours", shown.text, detail, look)


_LISTS: Final[tuple[tuple[Callable[[Any], bool], str, Callable[[Any, Preview, Look], Sketch | None]], ...]] = (
    (are_keypoints, "keypoint", _keypoints),
    (_are_matches, "match", _matches),
    (_are_contours, "contour", _contours),
)
