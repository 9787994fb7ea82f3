"""Which picture does a token of a run have?"""

from __future__ import annotations

from typing import Any, Final

from epypes.display import Picture, encode_image, is_image
from epypes.display.previews.ranges import kept_range
from epypes.display.previews.raster import THUMBNAIL_BYTES
from epypes.errors import NotComputed
from epypes.graph import colour_order
from epypes.run import Run

THUMBNAIL_PX: Final = 96


def picture_of(run: Run, token: str, value: Any, max_side_px: int, most_bytes: int | None = None) -> Picture:
    """Return an image of a run as a picture, with the colours and the range of values that its token has."""
    ends = kept_range(run.tokens.program, token, value)
    return encode_image(value, max_side_px, colour_order(run.cg, token), ends, most_bytes)


def thumbnail(run: Run, token: str | None) -> Picture | None:
    """Return the thumbnail of a token, of at most 96 x 96 pixels; None if it is no image, or not up to date."""
    try:
        value = None if token is None else run[token]
    except NotComputed:
        return None
    if token is None or not is_image(value):
        return None
    return picture_of(run, token, value, THUMBNAIL_PX, THUMBNAIL_BYTES)
