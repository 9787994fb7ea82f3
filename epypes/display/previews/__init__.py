"""What a preview consists of, and what it may look at beside the value."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from epypes.display.previews.images import Range, display_range
from epypes.images import Order
from epypes.optional import LazyModule

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[Any]
    Floats = npt.NDArray[np.float64]
else:
    np = LazyModule("numpy")

THUMBNAIL_PX: Final = 128
THUMBNAIL_BYTES: Final = 5_000
# On a thumbnail.
MOST_MARKS: Final = 200
# More lines than that, from one image to another, cover both.
MOST_PAIRS: Final = 40


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded picture.

    Attributes
    ----------
    data
        The bytes of the file.
    media_type
        ``"image/jpeg"`` or ``"image/png"``.
    width, height
        Its size, in pixels.
    """

    data: bytes = field(repr=False)
    media_type: str
    width: int
    height: int

    @property
    def uri(self) -> str:
        """The address that contains the file."""
        return f"data:{self.media_type};base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True, slots=True)
class Chart:
    """A drawing of lines, bars or points: a thumbnail that is painted, not encoded.

    Attributes
    ----------
    kind
        ``"line"``: each series is a polyline; ``"bars"``: from the bottom up to each point; ``"points"``: dots.
    series
        Points by series; x from 0 to 1 to the right, y from 0 to 1 upwards. At most 128 points in all.
    """

    kind: Literal["line", "bars", "points"]
    series: tuple[tuple[tuple[float, float], ...], ...]


@dataclass(frozen=True, slots=True)
class Preview:
    """What is shown of a value.

    Attributes
    ----------
    text
        A short line; for arrays dtype and shape.
    detail
        A longer line: dtype, shape, range and other statistics, parted by commas.
    picture
        A thumbnail of at most 128 x 128 pixels, or None. A preview function may give an image instead.
    chart
        A thumbnail that is drawn, or None; there is one of the two at most.
    rows
        At most 4 short lines of what is inside, such as the first rows of a table.
    """

    text: str
    detail: str = ""
    picture: Picture | None = None
    chart: Chart | None = None
    rows: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Sketch:
    """A preview whose thumbnail is not made yet, since only some of a graph's are shown.

    Attributes
    ----------
    closer
        Looks at the value closely, which takes longer and is done only if there is room for a thumbnail: returns what
        is then shown instead.
    draw
        Makes the thumbnail, in so many bytes at most if it is encoded; None if there is none.
    is_image
        Whether the value itself is an image.
    scene
        Returns the image that the thumbnail is made of, and what is drawn over it; None for charts and texts.
    note
        Which values are black and white, where the dtype of an image does not show.
    """

    shown: Preview
    draw: Callable[[int], Picture | Chart] | None = None
    is_image: bool = False
    closer: Callable[[], Sketch | Preview] | None = None
    scene: Callable[[], Scene] | None = None
    note: str = ""

    @property
    def may_be_drawn(self) -> bool:
        """Whether it may get a thumbnail."""
        return self.draw is not None or self.closer is not None


@dataclass(frozen=True, slots=True)
class Backdrop:
    """An image over which something is drawn: the array, the order of its colours, its display range, its token."""

    image: Any
    order: Order
    ends: Range
    name: str


@dataclass(frozen=True, slots=True)
class Marks:
    """What is drawn over an image.

    Attributes
    ----------
    points
        (n, 2) of x and y, in pixels of the image.
    lines
        Each (k, 2).
    are_closed
        Whether lines return to where they began.
    total
        How many points or lines there are; fewer may be drawn.
    extents
        (n, 2) of the points' diameter in pixels and angle in degrees, as keypoints have them; None if they have none.
    """

    points: Floats
    lines: tuple[Floats, ...] = ()
    are_closed: bool = False
    total: int = 0
    extents: Floats | None = None

    @property
    def drawn(self) -> int:
        """How many are drawn."""
        return len(self.lines) or len(self.points)

    @property
    def places(self) -> Floats:
        """All places that are drawn, (n, 2)."""
        return np.concatenate(self.lines) if self.lines else self.points


@dataclass(frozen=True, slots=True)
class Scene:
    """A value as it is seen at its full size: an image, and what is drawn over it.

    Attributes
    ----------
    backdrop
        The image: the value itself, or what its marks were found in; two side by side for what was found in both.
    marks
        What is drawn; None of an image.
    what
        What the marks are, as ``"keypoints"``.
    """

    backdrop: Backdrop
    marks: Marks | None = None
    what: str = ""


class Most(NamedTuple):
    """How many marks are drawn at most: points or lines, places of one line and of all lines, lines between images."""

    marks: int = MOST_MARKS
    line: int = MOST_MARKS
    places: int = MOST_MARKS * MOST_MARKS
    pairs: int = MOST_PAIRS


class Surroundings:
    """The images of a value's graph that it is seen with; a value that stands alone has none."""

    def range_of(self, image: Any) -> Range:
        """Return which values are shown black and white, if the value is an image."""
        return display_range(image)

    def nearest_image(self) -> Backdrop | None:
        """Return the nearest image that the value was made from."""
        return None

    def image_pair(self) -> tuple[Backdrop, Backdrop] | None:
        """Return the two images that the value was made from, in the order of its function's inputs."""
        return None

    def keypoint_pair(self) -> tuple[Any, Any] | None:
        """Return the keypoints of these two images."""
        return None


class Look(NamedTuple):
    """How a value is looked at.

    Attributes
    ----------
    order
        Of its colours, if it is an image.
    around
        What it is seen with, and may be drawn over.
    most
        How many marks are drawn over an image.
    """

    order: Order = "bgr"
    around: Surroundings = Surroundings()
    most: Most = Most()
