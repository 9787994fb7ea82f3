"""What is drawn over a picture, as vectors?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from epypes.display import Marks, Most, Scene, scene_of
from epypes.run import Run

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

# More points hide the image, and make messages of hundreds of kilobytes. A place has two coordinates.
MOST_DRAWN: Final = Most(marks=2_000, line=10_000, places=10_000, pairs=150)
_NO_SIZE: Final = 0.0
_NO_ANGLE: Final = -1.0
_DECIMALS: Final = 2
# Places are those of pixels' centres. The corners of boxes are between pixels.
_CENTRE: Final = 0.5


def scene(run: Run, token: str, *, had_marks: bool = False) -> Scene | None:
    """Return the image as which a token is shown, with all marks that the screen gets; None if it is shown as text.

    ``had_marks`` says that the token had a picture in an earlier run: if nothing is found any more, the image is left.
    """
    return scene_of(run, token, MOST_DRAWN, had_marks=had_marks)


def overlay(scene: Scene) -> dict[str, Any] | None:
    """Return what is drawn over the image of a scene, ready for JSON; None if the token is the image itself.

    Returns
    -------
    dict or None
        ``points``: lists of x, y, diameter (0: none), angle in degrees (-1: none); ``lines``: lists of x and y in turn;
        ``closed``: whether lines return to where they began; ``total``: how many points or lines there are; ``what``
        they are. Coordinates are in pixels of the image, whose first pixel reaches from 0 to 1.
    """
    marks = scene.marks
    if marks is None:
        return None
    shift = 0.0 if scene.what == "boxes" else _CENTRE
    return {
        "points": _plain(_points(marks, shift)),
        "lines": list(_lines(marks, shift)),
        "closed": marks.are_closed,
        "total": marks.total,
        "what": scene.what,
    }


def _points(marks: Marks, shift: float) -> Floats:
    import numpy as np

    count = len(marks.points)
    extents = np.tile((_NO_SIZE, _NO_ANGLE), (count, 1)) if marks.extents is None else marks.extents
    # A keypoint may be of no size, or of one that is not a number.
    known = np.where(np.isfinite(extents), extents, (_NO_SIZE, _NO_ANGLE))
    return np.concatenate([marks.points + shift, known], axis=1)


def _lines(marks: Marks, shift: float) -> Iterator[list[float]]:
    import numpy as np

    coordinates = _plain((np.concatenate([np.empty((0, 2)), *marks.lines]) + shift).reshape(-1))
    end = 0
    for line in marks.lines:
        start, end = end, end + 2 * len(line)
        yield coordinates[start:end]


def _plain(numbers: Floats) -> list[Any]:
    rounded: list[Any] = numbers.round(_DECIMALS).tolist()
    return rounded
