"""The preview of one value: a line of text, and a thumbnail if it can be drawn.

Which function looks at a value is decided by its type: that of the first class in its method resolution order that has
one; of two for one class, the user's. Classes of packages are named, so that they are known without being imported.
"""

from __future__ import annotations

import enum
import io
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, TypeVar, overload
from weakref import WeakKeyDictionary

from epypes.display.previews import (
    THUMBNAIL_BYTES,
    THUMBNAIL_PX,
    Chart,
    Look,
    Picture,
    Preview,
    Scene,
    Sketch,
    arrays,
    objects,
)
from epypes.display.previews.drawing import MOST_LINES, MOST_POINTS
from epypes.display.previews.encoding import encode_small
from epypes.display.previews.images import is_image
from epypes.display.previews.introspection import (
    dotted_name,
    is_in_users_code,
    kind_name,
    parents,
    plain_text,
    silent_numpy,
    users_code,
)
from epypes.display.previews.short import reason
from epypes.display.text import cut
from epypes.errors import InvalidType, InvalidValue
from epypes.images import Order
from epypes.nothing import NothingType
from epypes.optional import LazyModule
from epypes.run.guard import lend_to_reader

if TYPE_CHECKING:
    from PIL import Image
else:
    Image = LazyModule("PIL.Image")

_TEXT_CHARACTERS: Final = 30
DETAIL_CHARACTERS: Final = 290
_ROW_CHARACTERS: Final = 60
_MOST_ROWS: Final = 4
_CHARTS: Final = ("line", "bars", "points")
# To decode more takes longer than a thumbnail may.
_MOST_PIXELS: Final = 25_000_000

# -- which function looks at a type --------------------------------------------------------------------------------

_Function = TypeVar("_Function", bound=Callable[[Any], Any])
# What a preview function may return is checked where it is called.
PreviewFunction = Callable[[Any, Look], Any]

_BUILT_IN: Final[dict[type | str, PreviewFunction]] = {
    **dict.fromkeys((int, str, bytes, bytearray, complex, type(None)), objects.plain_preview),
    float: objects.float_preview,
    NothingType: objects.nothing_preview,
    enum.Enum: objects.enum_preview,
    BaseException: objects.exception_preview,
    PurePath: objects.path_preview,
    list: objects.list_preview,
    tuple: objects.tuple_preview,
    **dict.fromkeys((set, frozenset), objects.items_preview),
    **dict.fromkeys((dict, MappingProxyType), objects.dict_preview),
    object: objects.object_preview,
    "numpy.generic": arrays.number_preview,
    "numpy.ndarray": arrays.array_sketch,
    # pandas 3 says where a class is imported from, earlier ones where it is defined.
    **dict.fromkeys(("pandas.DataFrame", "pandas.core.frame.DataFrame"), objects.frame_preview),
    **dict.fromkeys(("pandas.Series", "pandas.core.series.Series"), objects.series_preview),
}


class _UsersFunctions:
    """The functions that users have registered, by class and by a class's dotted name."""

    def __init__(self) -> None:
        # Weak, so that a class of a notebook that was defined again can go.
        self.by_class: WeakKeyDictionary[type, PreviewFunction] = WeakKeyDictionary()
        self.by_name: dict[str, PreviewFunction] = {}
        # How often one was registered.
        self.revision = 0

    def get(self, kind: type) -> PreviewFunction | None:
        """Return the function of this very class."""
        return self.by_class.get(kind) or (self.by_name.get(dotted_name(kind)) if self.by_name else None)


users_functions: Final = _UsersFunctions()


def _function_of(kind: type) -> PreviewFunction:
    for parent in parents(kind):
        found = users_functions.get(parent) or _BUILT_IN.get(parent) or _BUILT_IN.get(dotted_name(parent))
        if found is not None:
            return found
    raise InvalidType(f"nothing is registered for {kind_name(kind)}")


def is_shown_by_user(kind: type) -> bool:
    """Whether a user's function looks at values of a class, or of one of its parents."""
    return any(map(users_functions.get, parents(kind)))


@overload
def register_preview(kind: type | str, function: None = None) -> Callable[[_Function], _Function]: ...
@overload
def register_preview(kind: type | str, function: _Function) -> _Function: ...
def register_preview(kind: type | str, function: Callable[[Any], Any] | None = None) -> Any:
    """Register how values of a type are shown in pictures of graphs and runs.

    Parameters
    ----------
    kind
        The class, whose subclasses are then shown so too, or its dotted name, ``"package.module.Pose"``, which
        imports nothing.
    function
        Takes a value, arrays read-only, and returns a short text, an image (an array as OpenCV has it), or a
        ``Preview``. It runs whenever a picture of a graph or run with such a value is made, so it should be quick and
        change nothing. If it raises, the reason is shown in place; what it shows itself meanwhile has no previews.

    Returns
    -------
    callable
        The function; without one, a decorator.

    Raises
    ------
    TypeError
        The kind is neither class nor name, or the function can't be called.

    Examples
    --------
    >>> class Pose:
    ...     x = 3
    >>> @register_preview(Pose)
    ... def show_pose(pose):
    ...     return f"x = {pose.x}"
    """
    if not isinstance(kind, type) and not (isinstance(kind, str) and "." in kind):
        raise InvalidType(f"A preview is registered for a class or its dotted name, 'module.Class', not {kind!r}.")
    if function is None:
        return lambda given: register_preview(kind, given)
    if not callable(function):
        raise InvalidType(f"The preview of {kind!r} must be a function that takes the value, not {function!r:.60}.")

    def by_user(value: Any, look: Look) -> Any:
        with users_code():
            # As for the functions of a graph: what is shown can't be spoilt.
            return function(lend_to_reader(value))

    users_functions.revision += 1
    if isinstance(kind, type):
        users_functions.by_class[kind] = by_user
    else:
        users_functions.by_name[kind] = by_user
    return function


# -- a value -------------------------------------------------------------------------------------------------------


def preview(value: Any, order: Order = "bgr") -> Preview:
    """Look at a value; never raises. ``order`` is that of its colours, if it is an image."""
    return finished(sketch(value, Look(order)))


def sketch(value: Any, look: Look) -> Sketch:
    """Look at a value without making its thumbnail; never raises."""
    if is_in_users_code():
        return Sketch(Preview(_kind(value), _kind(value)))
    try:
        with silent_numpy():
            return _checked(_function_of(type(value))(value, look), value, look)
    except Exception as error:
        return Sketch(_failed(Preview("", _kind(value)), "no preview", error))


def looked_closer(sketched: Sketch) -> Sketch:
    """Return what is shown once there is room for a thumbnail, which is not made yet. Never raises."""
    if sketched.closer is None:
        return sketched
    try:
        with silent_numpy():
            return _limited(sketched.closer())
    except Exception as error:
        return Sketch(_failed(sketched.shown, "no picture", error))


def finished(sketched: Sketch, most_bytes: int = THUMBNAIL_BYTES) -> Preview:
    """Return a preview with its thumbnail; one that can't be made gives the reason instead. Never raises."""
    sketched = looked_closer(sketched)
    if sketched.draw is None:
        return sketched.shown
    try:
        with silent_numpy():
            drawn = sketched.draw(most_bytes)
    except Exception as error:
        return _failed(sketched.shown, "no picture", error)
    if isinstance(drawn, Chart):
        return replace(sketched.shown, chart=drawn)
    return replace(sketched.shown, picture=drawn)


def scene_in(sketched: Sketch) -> Scene | None:
    """Return the image of a sketch and what is drawn over it; None if it has none. Never raises."""
    scene = looked_closer(sketched).scene
    try:
        with silent_numpy():
            return None if scene is None else scene()
    except Exception:  # the reason stands where the value is shown as text
        return None


def _limited(found: Sketch | Preview) -> Sketch:
    sketched = found if isinstance(found, Sketch) else Sketch(found)
    return replace(sketched, shown=_trimmed(sketched.shown))


def _failed(shown: Preview, what: str, error: Exception) -> Preview:
    message = f"{what}: {reason(error)}"
    text = shown.text or cut(message, _TEXT_CHARACTERS)
    return replace(shown, text=text, detail=cut(f"{shown.detail}, {message}", DETAIL_CHARACTERS))


def _kind(value: Any) -> str:
    return cut(kind_name(type(value)), _TEXT_CHARACTERS)


# -- what a user's preview function returned -----------------------------------------------------------------------


def _checked(found: Any, value: Any, look: Look) -> Sketch:
    """Return what a preview function returned, within the limits."""
    kind = type(found)
    if issubclass(kind, Sketch):
        return _limited(found)
    if issubclass(kind, Preview):
        detail = found.detail if found.detail != "" else _kind(value)
        shown = _trimmed(Preview(found.text, detail, rows=found.rows))
        if is_image(found.picture):
            return replace(arrays.image_sketch(arrays.plain_array(found.picture), look), shown=shown, is_image=False)
        return Sketch(shown, _drawing(found.picture, found.chart))
    if issubclass(kind, str):
        return Sketch(_trimmed(Preview(found, f"{_kind(value)}, {plain_text(found)[:DETAIL_CHARACTERS]}")))
    if is_image(found):
        image = arrays.image_sketch(arrays.plain_array(found), look)
        detail = f"{_kind(value)}, shown as {image.shown.detail}"
        shown = _trimmed(replace(image.shown, text=_kind(value), detail=detail))
        return replace(image, shown=shown, is_image=False)
    raise InvalidType(f"a preview must be a text, an image or an ep.Preview, not {_kind(found)}")


def _trimmed(shown: Preview) -> Preview:
    """Return a preview whose texts are plain texts, on one line, and within the limits."""
    rows = tuple(itertools.islice(shown.rows, _MOST_ROWS))
    for line in (shown.text, shown.detail, *rows):
        if not issubclass(type(line), str):
            raise InvalidType("text, detail and rows of a preview must be texts")
    text = cut(plain_text(shown.text)[:500], _TEXT_CHARACTERS)
    short = [plain_text(row)[:_ROW_CHARACTERS] for row in rows]
    lines = ["".join(mark if mark.isprintable() else " " for mark in row) for row in short]
    detail = cut(plain_text(shown.detail)[:1000], DETAIL_CHARACTERS)
    return Preview(text or "(empty text)", detail, shown.picture, shown.chart, tuple(lines))


def _drawing(picture: Any, chart: Any) -> Callable[[int], Picture | Chart] | None:
    """Return what draws the picture or chart that a user's preview has."""
    if picture is not None:
        if not issubclass(type(picture), Picture):
            raise InvalidType("picture must be an image: an array of at least 8 x 8 pixels")
        return lambda most_bytes: _checked_picture(picture, most_bytes)
    if chart is None:
        return None
    checked = _checked_chart(chart)
    return (lambda most_bytes: checked) if checked.series else None


def _checked_chart(chart: Any) -> Chart:
    """Return a chart within the limits: of finite points, each between 0 and 1."""
    if type(chart) is not Chart or chart.kind not in _CHARTS:
        raise InvalidType(f"chart of a preview must be a Chart of kind {', '.join(_CHARTS)}")
    room, series = MOST_POINTS, []
    for points in itertools.islice(chart.series, MOST_POINTS):
        pairs = [(float(x), float(y)) for x, y in itertools.islice(points, room)]
        room -= len(pairs)
        kept = tuple((min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)) for x, y in pairs if math.isfinite(x + y))
        series += [kept] * bool(kept)
    return Chart(chart.kind, tuple(series[:MOST_LINES]))


def _checked_picture(picture: Picture, most_bytes: int) -> Picture:
    """Return a picture within the limits of a thumbnail; what it is, its bytes decide."""
    with Image.open(io.BytesIO(picture.data), formats=["PNG", "JPEG"]) as opened:
        if opened.width * opened.height > _MOST_PIXELS:
            raise InvalidValue(f"a picture of {opened.width} x {opened.height} is too large for a thumbnail")
        # What is broken is found by decoding it.
        opened.load()
        if max(opened.size) <= THUMBNAIL_PX and len(picture.data) <= most_bytes:
            return Picture(picture.data, f"image/{opened.format}".lower(), *opened.size)
        opened.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
        return encode_small(opened, most_bytes)
