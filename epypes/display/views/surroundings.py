"""The images of a run that what was found in them is drawn over, and scenes at full size.

The graph shows them: a token is made from the tokens that its function takes, those from others, and so on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Final

from epypes.display.previews.arrays import plain_array
from epypes.display.previews.features import are_keypoints
from epypes.display.previews.images import Range, image_kind, is_image, sampled
from epypes.display.previews.kept import kept_range
from epypes.display.previews.model import Backdrop, Look, Marks, Most, Scene, Surroundings
from epypes.display.previews.preview import scene_in, sketch
from epypes.graph import colour_order
from epypes.run import Run

_MOST_TOKENS: Final = 500


class RunSurroundings(Surroundings):
    """The images and keypoints that a token of a run was made from.

    Parameters
    ----------
    run
        Its values that are out of date are not looked at.
    token
        Which one is to be drawn over them.
    range_of
        Returns which values of a token's image are black and white; None: those that are kept of its first one.
    """

    def __init__(self, run: Run, token: str, range_of: Callable[[str, Any], Range] | None = None) -> None:
        self._run, self._token, self._range_of = run, token, range_of

    def nearest_image(self) -> Backdrop | None:
        """Return the nearest image among the token's ancestors; of its size rather a photograph than a mask."""
        return self._image_of(self._token)

    def image_pair(self) -> tuple[Backdrop, Backdrop] | None:
        """Return the images of the two nearest keypoint tokens; without such, the first image of two inputs."""
        keypoints = self._pair(self._token, self._is_keypoints, set())
        if keypoints is not None:
            first, second = (self._image_of(token) for token in keypoints)
        else:
            images = self._pair(self._token, self._is_photograph, set())
            if images is None:
                return None
            first, second = (self._backdrop(token) for token in images)
        return (first, second) if first is not None and second is not None else None

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
        """Yield a token, what its function made beside it, and their ancestors."""
        yield token
        maker = self._run.cg.digraph.producer.get(token)
        if maker is not None:
            yield from (name for name in self._run.cg.digraph.outputs[maker] if name != token and self._is_fresh(name))
        for name in self._ancestors(token):
            yield name
            maker = self._run.cg.digraph.producer.get(name)
            yield from (
                () if maker is None else (near for near in self._run.cg.digraph.outputs[maker] if self._is_fresh(near))
            )

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
        range_of = self._range_of or partial(kept_range, self._run.tokens.program)
        return Backdrop(value, colour_order(self._run.cg, token), range_of(token, value), token)


def scene_of(run: Run, token: str, most: Most | None = None, *, had_marks: bool = False) -> Scene | None:
    """Return a token as an image, and its marks if it is what was found in one; never raises for a value.

    Parameters
    ----------
    run
        Its tokens' values.
    token
        An image, what a preview function shows as an image, or keypoints, contours, boxes, segments, points, matches.
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
    program, tokens = run.tokens.program, run.tokens
    if not tokens.is_computed(token) or tokens.is_stale(token) or tokens.is_nothing(token):
        return None
    value, order = tokens.values[program.slots[token]], colour_order(run.cg, token)
    if is_image(value):
        array = plain_array(value)
        return Scene(Backdrop(array, order, kept_range(program, token, array), token))
    around = RunSurroundings(run, token)
    look = Look(order, partial(kept_range, program, token), around, most or Most())
    scene = scene_in(sketch(value, look))
    if scene is None:
        return _without_marks(around) if had_marks else None
    return scene if scene.backdrop.name else replace(scene, backdrop=replace(scene.backdrop, name=token))


def _without_marks(around: RunSurroundings) -> Scene | None:
    import numpy as np

    backdrop = around.nearest_image()
    return None if backdrop is None else Scene(backdrop, Marks(np.empty((0, 2))))
