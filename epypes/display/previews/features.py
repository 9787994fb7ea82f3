"""What is shown of keypoints, matches, contours and segments?"""

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
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

_Closer = Callable[[Sequence[Any], Preview, Look], Sketch | None]
# So many items of a list are looked at to know what it is a list of, and to choose the strongest keypoints.
_LOOKED_AT: Final = 100
_WEIGHED: Final = 10_000
_NAME_CHARACTERS: Final = 40


def keypoint_name(kind: type) -> bool:
    """Whether a class is that of OpenCV's keypoints."""
    return dotted_name(kind) == "cv2.KeyPoint"


def are_keypoints(value: Any) -> bool:
    """Whether a value is a list or tuple of OpenCV's keypoints."""
    return type(value) in (list, tuple) and _are_all(value, lambda item: keypoint_name(type(item)))


def list_sketch(value: Sequence[Any], name: str, look: Look, plain: Callable[[], Preview]) -> Sketch | None:
    """Look at a list or tuple of what can be drawn; None if it is any other.

    Parameters
    ----------
    name
        What such a list is called.
    plain
        Looks at it if on a closer look it is any other.
    """
    for is_kind, noun, closer in _LISTS:
        if is_kind(value):
            text = f"{len(value)} {noun}{('es' if noun.endswith('ch') else 's') * (len(value) != 1)}"
            said = f"{name} of {text}"
            return Sketch(
                Preview(text, said), closer=partial(_closer_look, closer, value, Preview(text, said), look, plain)
            )
    return None


def _closer_look(
    closer: _Closer, value: Sequence[Any], shown: Preview, look: Look, plain: Callable[[], Preview]
) -> Sketch | Preview:
    return closer(value, shown, look) or plain()


def point_sketch(array: Any, look: Look, *, needs_image: bool = False) -> Sketch | None:
    """Look at an array (n, 2) or (n, 1, 2) of places; None if it needs an image that they lie on, and has none.

    OpenCV gives x and y, as int32 or float32 or with an axis of their own; scikit-image and NumPy give row and column,
    as int64 or float64. If more of them lie on the image the other way round, they are taken so.
    """
    places = array.reshape(-1, 2)
    are_rows = array.ndim == 2 and array.dtype.itemsize == 8
    marks, turned = (some_points(_x_and_y(places, order), look.most) for order in (are_rows, not are_rows))
    image = look.around.nearest_image() if array.ndim == 2 else None
    if image is not None and share_on(turned.points, image) > share_on(marks.points, image):
        marks, are_rows = turned, not are_rows
    if needs_image and _backdrop(marks, look) is None:
        return None
    order = "(row, column)" if are_rows else "(x, y)"
    said = f"{array_text(array)}, points {order}{_extent(_x_and_y(places, are_rows))}"
    return _over(marks, "points", array_text(array), said, look)


def _x_and_y(places: Any, are_rows: bool) -> Any:
    return places[:, ::-1] if are_rows else places


def segment_sketch(array: Any, look: Look) -> Sketch:
    """Look at an array (n, 1, 4) of the two ends of line segments."""
    said = f"{array_text(array)}, segments{_extent(array)}"
    return _over(_segments(array, look.most), "segments", array_text(array), said, look)


def _segments(array: Any, most: Most) -> Marks:
    # The first ones: detectors list the strongest first.
    lines = list(array.reshape(-1, 2, 2)[: most.marks])
    return replace(some_lines(lines, False, most), total=len(array))


def quad_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at an array (n, 4): places in two images, boxes, or segments as newer OpenCV has them.

    None if they lie on no image. The numbers do not tell which they are: boxes are what lies, with width and height,
    within the image.
    """
    paired = pair_sketch(array, look)
    backdrop = look.around.nearest_image()
    if paired is not None or backdrop is None or array.dtype.kind not in "iu" or not len(array):
        return paired
    height, width = backdrop.image.shape[:2]
    ends = array[:, :2].astype("f8") + array[:, 2:]
    are_boxes = bool((array[:, 2:] > 0).all() and (ends <= (width, height)).all())
    marks = rectangles(array, look.most) if are_boxes else _segments(array, look.most)
    if not marks_lie_on(marks, backdrop):
        return None
    what = "boxes" if are_boxes else "segments"
    said = f"{array_text(array)}, {what}{' (x, y, width, height)' * are_boxes}"
    return _over(marks, what, array_text(array), said, look)


def pair_sketch(array: Any, look: Look) -> Sketch | None:
    """Look at an array (n, 4) of places in two images; None if there are no such images."""
    backdrops = look.around.image_pair()
    if backdrops is None or not len(array):
        return None
    pairs = some_pairs(array, look.most)
    first, second = backdrops
    if not len(pairs) or not lie_on(pairs[:, :2], first) or not lie_on(pairs[:, 2:], second):
        return None
    said = f"{array_text(array)}, places in two images"
    return _between(backdrops, pairs, len(array), Preview(array_text(array), said), "pairs")


def _over(marks: Marks, what: str, text: str, said: str, look: Look) -> Sketch:
    backdrop = _backdrop(marks, look)
    scene = None if backdrop is None else partial(Scene, backdrop, marks, what)
    drawn = marks.drawn if backdrop else drawn_in_chart(len(marks.points), len(marks.lines))
    if backdrop is not None:
        said += f", drawn over {cut(backdrop.name, _NAME_CHARACTERS)}"
    if drawn < marks.total:
        said += f", {drawn} of {marks.total} drawn"
    return Sketch(Preview(text, said), drawer(marks, backdrop), scene=scene)


def _backdrop(marks: Marks, look: Look) -> Backdrop | None:
    backdrop = look.around.nearest_image()
    return backdrop if backdrop is not None and marks_lie_on(marks, backdrop) else None


def _between(backdrops: tuple[Backdrop, Backdrop], pairs: Floats, total: int, shown: Preview, what: str) -> Sketch:
    said = f"{shown.detail}, drawn between the images"
    if len(pairs) < total:
        said += f", {len(pairs)} of {total} drawn"
    scene = partial(pair_scene, backdrops, pairs, total, what)
    return Sketch(Preview(shown.text, said), pair_drawer(backdrops, pairs), scene=scene)


def _keypoints(value: Sequence[Any], shown: Preview, look: Look) -> Sketch:
    import numpy as np

    weighed = sorted(value[:_WEIGHED], key=lambda keypoint: -keypoint.response)[: look.most.marks]
    extents = np.array([(keypoint.size, keypoint.angle) for keypoint in weighed], dtype=np.float64)
    points = np.array([keypoint.pt for keypoint in weighed], dtype=np.float64)
    marks = some_points(points, look.most, len(value), extents)
    sizes = extents[:, 0]
    said = f"{shown.detail}{_extent(marks.points)}, size {min(sizes):.4g} to {max(sizes):.4g}"
    return _over(marks, "keypoints", shown.text, said, look)


def _matches(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    import numpy as np

    known = value[:_WEIGHED]
    flat = known if _is_match(value[0]) else [item[0] for item in known if len(item)]
    if not _is_match(flat[0]) or not _are_of_one_class(flat):
        return None
    distances = [match.distance for match in flat]
    said = f"{shown.detail}, distance {min(distances):.4g} to {max(distances):.4g}"
    backdrops, keypoints = look.around.image_pair(), look.around.keypoint_pair()
    kept = flat[: look.most.pairs]
    if backdrops is not None and keypoints is not None and _indices_fit(kept, *keypoints):
        first, second = keypoints
        places = np.array([(*first[m.queryIdx].pt, *second[m.trainIdx].pt) for m in kept])
        pairs = some_pairs(places, look.most)
        if len(pairs):
            return _between(backdrops, pairs, len(value), Preview(shown.text, said), "matches")
    return Sketch(Preview(shown.text, said, rows=_match_rows(flat, len(value))))


def _match_rows(matches: Sequence[Any], total: int) -> tuple[str, ...]:
    rows = [f"{m.queryIdx} - {m.trainIdx}: {m.distance:.4g}" for m in matches[:3]]
    return (*rows, f"... {total - 3} more") if total > 3 else tuple(rows)


def _indices_fit(matches: Sequence[Any], first: Sequence[Any], second: Sequence[Any]) -> bool:
    return all(_is_keypoint_of(first, m.queryIdx) and _is_keypoint_of(second, m.trainIdx) for m in matches)


def _is_keypoint_of(keypoints: Sequence[Any], index: int) -> bool:
    return 0 <= index < len(keypoints) and keypoint_name(type(keypoints[index]))


def _contours(value: Sequence[Any], shown: Preview, look: Look) -> Sketch | None:
    known, axes = value[:_WEIGHED], value[0].ndim
    if not all(line.ndim == axes and _has_contour_shape(line) for line in known):
        return None
    are_rows = axes == 2
    turned = [line[:, ::-1] for line in known] if are_rows else known
    marks = some_lines(turned, not are_rows, look.most, len(value))
    order = ", (row, column) as scikit-image has them" if are_rows else ""
    first = f" in the first {_WEIGHED}" * (len(known) < len(value))
    said = f"{shown.detail}, {sum(map(len, known))} points{first}, {value[0].dtype}{order}"
    return _over(marks, "contours", shown.text, said, look)


def _extent(points: Any) -> str:
    """Return where points lie; of very many, where some of them do."""
    import numpy as np

    some = points[:: -(-len(points) // _WEIGHED) or 1].reshape(-1, 2).astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    if not len(some):
        return ""
    (left, top), (right, bottom) = some.min(axis=0), some.max(axis=0)
    return f", x {left:.4g} to {right:.4g}, y {top:.4g} to {bottom:.4g}"


def _are_all(value: Sequence[Any], is_kind: Callable[[Any], bool]) -> bool:
    """Whether all items are of a kind, as far as some of them, and the classes of many, tell; no item, no kind."""
    step = -(-len(value) // _LOOKED_AT) or 1
    if not value or not all(is_kind(item) for item in itertools.islice(value, 0, None, step)):
        return False
    return _are_of_one_class(value)


def _are_of_one_class(value: Sequence[Any]) -> bool:
    """Whether the first of many items are of one class."""
    first = type(value[0])
    return all(type(item) is first for item in itertools.islice(value, _WEIGHED))


def _is_match(item: Any) -> bool:
    return dotted_name(type(item)) == "cv2.DMatch"


def _is_match_list(item: Any) -> bool:
    return type(item) in (list, tuple) and len(item) <= 16 and all(map(_is_match, item))


def _is_contour(item: Any) -> bool:
    return is_of(item, "numpy", "ndarray") and _has_contour_shape(item)


def _has_contour_shape(array: Any) -> bool:
    axes = array.shape[1:]
    return bool(array.dtype.kind in "iuf" and (axes == (1, 2) or (axes == (2,) and array.dtype.str[1:] == "f8")))


def _are_matches(value: Sequence[Any]) -> bool:
    return _are_all(value, _is_match) or (_are_all(value, _is_match_list) and any(value[:_WEIGHED]))


def _are_contours(value: Sequence[Any]) -> bool:
    return _are_all(value, _is_contour)


_LISTS: Final = (
    (are_keypoints, "keypoint", _keypoints),
    (_are_matches, "match", _matches),
    (_are_contours, "contour", _contours),
)
