"""The images of a run that a token is seen with: its display range, what it is drawn over, scenes at full size.

The graph shows which these are: a token is made from the tokens that its function takes, those from others, and so on.
An image whose dtype does not define black and white has the range of the token's first one: if every frame had a range
of its own, a change of brightness would not be seen.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from operator import itemgetter
from types import CodeType
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

from epypes.display.previews import Backdrop, Look, Most, Scene, Surroundings
from epypes.display.previews.arrays import plain_array
from epypes.display.previews.features import are_keypoints, no_marks
from epypes.display.previews.images import Range, display_range, image_kind, is_image, own_range, sampled
from epypes.display.previews.introspection import is_of, kind_name
from epypes.display.previews.preview import scene_in, sketch
from epypes.errors import InvalidType
from epypes.graph import colour_order
from epypes.graph.identity import innermost
from epypes.run import CompGraphRunner, Run
from epypes.run.guard import is_array
from epypes.run.program import Program

if TYPE_CHECKING:
    from epypes.display.previews import Array

_MOST_TOKENS: Final = 500

# -- display ranges ------------------------------------------------------------------------------------------------

# By program, token and dtype.
_ranges: WeakKeyDictionary[Program, dict[tuple[str, str], Range]] = WeakKeyDictionary()
_lock = threading.Lock()


def _kept_range(program: Program, token: str, image: Array) -> Range:
    """Return the values that are shown black and white in a token's images: what its first one had.

    Of an image of one value nothing is kept, since it does not show what is to come.
    """
    if image.dtype.kind == "b" or image.dtype.str[1:] == "u1":
        return display_range(image)
    with _lock:
        ranges = _ranges.setdefault(program, {})
    key = token, image.dtype.str
    if key in ranges:
        return ranges[key]
    found = own_range(image)
    if found is None or found[0] >= found[1]:
        return display_range(image)
    return ranges.setdefault(key, found)


def reset_display_ranges(shown: Any, token: str | None = None) -> None:
    """Forget which values are shown black and white; those of the next images are kept instead.

    Parameters
    ----------
    shown
        A runner, a run or a pipeline.
    token
        Of which token; without, of all.
    """
    runner = getattr(shown, "runner", shown)
    run = runner.last if isinstance(runner, CompGraphRunner) else runner
    if isinstance(run, Run):
        with _lock:
            kept = _ranges.pop(run.tokens.program, {})
            if token is not None:
                _ranges[run.tokens.program] = {key: ends for key, ends in kept.items() if key[0] != token}
    elif not isinstance(runner, CompGraphRunner):
        raise InvalidType(f"A runner, a run or a pipeline has display ranges, not {kind_name(type(shown))!r}.")


# -- what a token was made from ------------------------------------------------------------------------------------


class RunSurroundings(Surroundings):
    """The images and keypoints that a token of a run was made from.

    Parameters
    ----------
    run
        Its values that are out of date are not looked at.
    token
        Which one is to be drawn over them.
    keeps_ranges
        Whether each token's images are shown in the display range of its first one, else each in its own.
    """

    def __init__(self, run: Run, token: str, *, keeps_ranges: bool = True) -> None:
        self._run, self._token, self._keeps_ranges = run, token, keeps_ranges
        self.name = token

    def maker_names(self) -> frozenset[str]:
        """Return the name of the function that made the token, and those in its code."""
        maker = self._run.cg.digraph.producer.get(self._token)
        if maker is None:
            return frozenset()
        return _names_in(getattr(innermost(self._run.cg.functions[maker]), "__code__", None)) | {maker}

    def range_of(self, image: Any, token: str = "") -> Range:
        """Return which values of a token's image are black and white; without one, of this token's."""
        if not self._keeps_ranges:
            return display_range(image)
        return _kept_range(self._run.tokens.program, token or self._token, image)

    def nearest_image(self) -> Backdrop | None:
        """Return the nearest image among the token's ancestors; of its size rather a photograph than a mask."""
        return self._image_of(self._token)

    def image_pair(self) -> tuple[Backdrop, Backdrop] | None:
        """Return the images of the two nearest keypoint tokens; without such, the first image of two inputs."""
        keypoints = self._pair(self._token, self._is_keypoints, set())
        if keypoints is not None:
            first, second = map(self._image_of, keypoints)
            return (first, second) if first is not None and second is not None else None
        images = self._pair(self._token, self._is_photograph, set())
        return None if images is None else (self._backdrop(images[0]), self._backdrop(images[1]))

    def keypoint_pair(self) -> tuple[Any, Any] | None:
        """Return the values of the two nearest keypoint tokens, one by each input in order."""
        found = self._pair(self._token, self._is_keypoints, set())
        return (self._value(found[0]), self._value(found[1])) if found is not None else None

    def _image_of(self, token: str) -> Backdrop | None:
        if not self._is_fresh(token):
            return None
        images = [name for name in self._ancestors(token) if is_image(self._value(name))]
        if not images:
            return None
        size = self._value(images[0]).shape[:2]
        alike = (name for name in images if self._value(name).shape[:2] == size and self._is_photograph(name))
        return self._backdrop(next(alike, images[0]))

    def _pair(self, token: str, is_wanted: Callable[[str], bool], seen: set[str]) -> tuple[str, str] | None:
        """Return two tokens, one by each input of the function that made this one; if there are none, of an input."""
        if token in seen or not self._is_fresh(token):
            return None
        seen.add(token)
        found: list[str] = []
        inputs = self._inputs(token)
        for name in inputs:
            new = (near for near in self._around(name) if near not in found and is_wanted(near))
            found += list(next(zip(new, strict=False), ()))
            if len(found) == 2:
                return found[0], found[1]
        return next(filter(None, (self._pair(name, is_wanted, seen) for name in inputs)), None)

    def _around(self, token: str) -> Iterator[str]:
        """Yield a token and its ancestors, each with what its function made beside it."""
        for name in chain((token,), self._ancestors(token)):
            yield name
            maker = self._run.cg.digraph.producer.get(name)
            if maker is not None:
                yield from filter(self._is_fresh, self._run.cg.digraph.outputs[maker])

    def _ancestors(self, token: str) -> Iterator[str]:
        """Yield the tokens that a token was made from that have a value, the nearest first."""
        waiting, seen = deque([token]), {token}
        while waiting and len(seen) < _MOST_TOKENS:
            for name in self._inputs(waiting.popleft()):
                if name not in seen and self._is_fresh(name):
                    seen.add(name)
                    waiting.append(name)
                    yield name

    def _inputs(self, token: str) -> tuple[str, ...]:
        maker = self._run.cg.digraph.producer.get(token)
        return tuple(self._run.cg.digraph.inputs[maker]) if maker is not None else ()

    def _is_fresh(self, token: str) -> bool:
        return self._run.tokens.is_computed(token) and not self._run.tokens.is_stale(token)

    def _value(self, token: str) -> Any:
        value = self._run.tokens.values[self._run.tokens.program.slots[token]]
        return plain_array(value) if is_image(value) else value

    def _is_keypoints(self, token: str) -> bool:
        return are_keypoints(self._value(token))

    def _is_photograph(self, token: str) -> bool:
        value = self._value(token)
        return is_image(value) and image_kind(value, sampled(value)) == "photograph"

    def _backdrop(self, token: str) -> Backdrop:
        value = self._value(token)
        return Backdrop(value, colour_order(self._run.cg, token), self.range_of(value, token), token)


_SCALAR_CHARACTERS: Final = 40


def scalar_owners(run: Run) -> dict[str, str]:
    """Return the image that each number or short text of a run belongs to, by token, in graph order.

    It belongs to the nearest of the images that it was made from; one that was made from none is left out. Values that
    are out of date count, too.
    """
    graph, values = run.cg.digraph, dict(zip(run.tokens.program.tokens, run.tokens.values, strict=True))
    scalars = [name for name in run.cg.tokens if name in graph.producer and _is_scalar(values[name])]
    if not scalars:
        return {}
    images = {name for name, value in values.items() if is_image(value)}
    # By token the image, and how many functions lie between.
    nearest = {name: (0, name) for name in images}
    for function in run.cg.functions:
        found = [nearest[name] for name in graph.inputs[function] if name in nearest]
        if found:
            distance, image = min(found, key=itemgetter(0))
            for name in graph.outputs[function]:
                nearest.setdefault(name, (distance + 1, image))
    return {name: nearest[name][1] for name in scalars if name in nearest}


def _is_scalar(value: Any) -> bool:
    kind = type(value)
    is_text = kind is str and len(value) <= _SCALAR_CHARACTERS
    # Most values are arrays, which are known at a glance.
    return kind in (bool, int, float) or is_text or (not is_array(value) and is_of(value, "numpy", "generic"))


def _names_in(code: object) -> frozenset[str]:
    """Return the names that code uses, that of its comprehensions and inner functions included."""
    if type(code) is not CodeType:
        return frozenset()
    return frozenset(code.co_names).union(*map(_names_in, code.co_consts))


def scene_of(run: Run, token: str, most: Most | None = None, *, had_marks: bool = False) -> Scene | None:
    """Return a token as an image, and its marks if it is what was found in one; never raises for a value.

    Parameters
    ----------
    run
        Its tokens' values.
    token
        An image, what a preview function shows as an image, or keypoints, contours, boxes, circles, segments, points,
        matches, optical flow.
    most
        How many marks there are at most; without, as many as on a thumbnail.
    had_marks
        Whether an earlier value of the token had marks: where there are none any more, the image alone is left. Nothing
        has no picture.

    Returns
    -------
    Scene or None
        None if the token has no such picture, or no value that is up to date.

    Examples
    --------
    >>> import numpy as np
    >>> from epypes import CompGraph, CompGraphRunner
    >>> cg = CompGraph({"find": lambda image: np.array([[[20, 10]], [[30, 10]]])}, {"find": ("image", "points")})
    >>> scene = scene_of(CompGraphRunner(cg).run(image=np.eye(64)), "points")
    >>> scene.backdrop.name, scene.what, scene.marks.points.tolist()
    ('image', 'points', [[20.0, 10.0], [30.0, 10.0]])
    """
    tokens, around = run.tokens, RunSurroundings(run, token)
    if not tokens.is_computed(token) or tokens.is_stale(token) or tokens.is_nothing(token):
        return None
    value, order = tokens.values[tokens.program.slots[token]], colour_order(run.cg, token)
    if is_image(value):
        array = plain_array(value)
        return Scene(Backdrop(array, order, around.range_of(array), token))
    scene = scene_in(sketch(value, Look(order, around, most or Most())))
    if scene is None:
        backdrop = around.nearest_image() if had_marks else None
        return None if backdrop is None else Scene(backdrop, no_marks())
    return scene if scene.backdrop.name else replace(scene, backdrop=replace(scene.backdrop, name=token))
