"""As which image is a token of a run seen at full size, and what is drawn over it?"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from epypes.display.previews.arrays import plain_array
from epypes.display.previews.imagekinds import is_image
from epypes.display.previews.preview import scene_in, sketch
from epypes.display.previews.ranges import kept_range
from epypes.display.previews.shown import Backdrop, Look, Marks, Most, Scene
from epypes.display.views.backdrops import RunSurroundings
from epypes.graph import colour_order
from epypes.run import Run


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
        Whether an earlier value of the token had marks: where nothing is found any more, the image alone is left.

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
    if not tokens.is_computed(token) or tokens.is_stale(token):
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
