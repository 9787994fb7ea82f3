"""Which picture does a token of a run have where there is one for good: in the history, in a saved notebook?"""

from __future__ import annotations

from typing import Final

from epypes.display import Picture, scene_of, scene_picture
from epypes.run import Run

_THUMBNAIL_PX: Final = 96
_THUMBNAIL_BYTES: Final = 4_000


def picture_of(run: Run, token: str, max_side_px: int, most_bytes: int) -> Picture | None:
    """Return a token as one picture, its marks drawn over their image; None if it is none, or not up to date."""
    seen = scene_of(run, token, had_marks=True)
    return None if seen is None else scene_picture(seen, max_side_px, most_bytes)


def thumbnail(run: Run, token: str | None) -> Picture | None:
    """Return the thumbnail of a token, of at most 96 x 96 pixels; None if it is no picture, or not up to date."""
    return None if token is None else picture_of(run, token, _THUMBNAIL_PX, _THUMBNAIL_BYTES)
