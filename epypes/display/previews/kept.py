"""What is kept for the tokens of a program: display ranges, and previews of values that can't change.

An image whose dtype does not define black and white has the range of the token's first one: if every frame had a range
of its own, a change of brightness would not be seen.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary, ref

from epypes.display.previews.images import Range, display_range, own_range
from epypes.display.previews.introspection import kind_name
from epypes.display.previews.model import Look, Preview, Sketch
from epypes.display.previews.preview import finished_in_context, sketch_in_context
from epypes.display.previews.registry import is_shown_by_user, users_revision
from epypes.nothing import NothingType
from epypes.run import CompGraphRunner, Run
from epypes.run.program import Program

if TYPE_CHECKING:
    from epypes.display.previews.model import Array


_SCALARS: Final = frozenset({int, float, complex, bool, type(None), NothingType})
_SHORT_TEXT: Final = 200


class ValuePreview:
    """The preview of a token's value, and its thumbnail once that was made.

    Attributes
    ----------
    brief
        The preview without a thumbnail.
    is_drawable
        Whether it may get one.
    is_image
        Whether the value is an image.
    sketch
        Refers to the value's memory, so it is forgotten once a picture is painted.
    is_constant
        Whether the value can't be changed, and the preview is made of nothing else: such a preview may be kept. A
        payload is not constant, since its owner may fill it again.
    """

    __slots__ = ("_made", "_range", "_reference", "brief", "is_constant", "is_drawable", "is_image", "sketch")

    def __init__(self, value: Any, look: Look, is_nested: bool) -> None:
        self.sketch: Sketch | None = (sketch := sketch_in_context(value, look, is_nested))
        self.brief, self.is_drawable, self.is_image = sketch.shown, sketch.may_be_drawn, sketch.is_image
        self._made: tuple[Preview, int] | None = None
        self._range: Range | None = None
        self._reference: Callable[[], Any] = lambda: value
        is_locked = self.is_image and _is_locked(value)
        if is_locked:
            # A preview that is kept keeps no array.
            self._reference, self._range = ref(value), look.range_of(value)
        is_scalar = type(value) in _SCALARS or (type(value) is str and len(value) <= _SHORT_TEXT)
        self.is_constant = (is_locked or is_scalar) and not is_nested and not is_shown_by_user(type(value))

    def is_of(self, value: Any, look: Look) -> bool:
        """Whether it is the preview of this value, in the display range that is kept now."""
        return self._reference() is value and (self._range is None or self._range == look.range_of(value))

    def finished(self, value: Any, look: Look, most_bytes: int) -> Preview:
        """Return the preview with a thumbnail of at most so many bytes."""
        made = self._made
        if made is None or made[1] != most_bytes:
            sketch = self.sketch or sketch_in_context(value, look, False)
            self._made = made = finished_in_context(sketch, most_bytes), most_bytes
        return made[0]


def _is_locked(array: Any) -> bool:
    """Whether no part of an array can be written, through whatever array that has its memory."""
    import numpy as np

    while type(array) is np.ndarray:
        if array.flags.writeable:
            return False
        array = array.base
    return array is None


class _Kept:
    __slots__ = ("previews", "ranges", "revision")

    def __init__(self) -> None:
        self.revision = -1
        self.previews: dict[tuple[str, bool], ValuePreview] = {}
        self.ranges: dict[tuple[str, str], Range] = {}


_kept: WeakKeyDictionary[Program, _Kept] = WeakKeyDictionary()
_lock = threading.Lock()


def _kept_of(program: Program) -> _Kept:
    with _lock:
        return _kept.setdefault(program, _Kept())


def kept_previews(program: Program) -> dict[tuple[str, bool], ValuePreview]:
    """Return the previews of a program's tokens by name, and by whether they are of a hyperparameter's first value."""
    kept = _kept_of(program)
    if kept.revision != users_revision():
        # A user's function may look at these values now.
        kept.revision, kept.previews = users_revision(), {}
    return kept.previews


def kept_range(program: Program, token: str, image: Array) -> Range:
    """Return the values that are shown black and white in a token's images: what its first one had.

    Of an image of one value nothing is kept, since it does not show what is to come.
    """
    if image.dtype.kind == "b" or image.dtype.str[1:] == "u1":
        return display_range(image)
    key, ranges = (token, image.dtype.str), _kept_of(program).ranges
    if key in ranges:
        return ranges[key]
    found = own_range(image)
    if found is None or found[0] >= found[1]:
        return display_range(image)
    return ranges.setdefault(key, found)


def reset_display_ranges(shown: Any) -> None:
    """Forget which values are shown black and white; those of the next images are kept instead.

    Parameters
    ----------
    shown
        A runner, a run or a pipeline; of all its tokens.
    """
    runner = getattr(shown, "runner", shown)
    run = runner.last if isinstance(runner, CompGraphRunner) else runner
    if not isinstance(run, Run):
        if isinstance(runner, CompGraphRunner):
            return
        raise TypeError(f"A runner, a run or a pipeline has display ranges, not {kind_name(type(shown))!r}.")
    with _lock:
        _kept.pop(run.tokens.program, None)
