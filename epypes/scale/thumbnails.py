"""Which tokens of a run have a picture, and how small can it be kept?"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Final

from epypes.display.paint.thumbnails import THUMB_HEIGHT, THUMB_WIDTH, paint_thumbnail
from epypes.display.previews.preview import Preview, finished, sketch
from epypes.display.previews.ranges import kept_range
from epypes.display.previews.shown import Look
from epypes.display.views.backdrops import RunSurroundings
from epypes.graph import colour_order
from epypes.run import Run
from epypes.scale.outcome import Thumbnail

# A chart stands alone in its file, so it brings its colours: a grey that is seen on white and on black.
_CHART_STYLE: Final = (
    "<style>.paper{fill:none}.chart polyline,.bars,.dots{fill:none;stroke:#7a8490;stroke-width:2}"
    ".dots{stroke-width:4;stroke-linecap:round}</style>"
)


def thumbnails_of(run: Run, tokens: Iterable[str] | None) -> dict[str, Thumbnail]:
    """Return pictures of tokens, of all that have one if None; what was not computed has none. Never raises."""
    wanted = run.cg.tokens if tokens is None else tokens
    found = {token: thumbnail_of(run, token) for token in wanted if run.tokens.is_readable(token)}
    return {token: shown for token, shown in found.items() if shown is not None}


def thumbnail_of(run: Run, token: str) -> Thumbnail | None:
    """Return a picture of a token of at most 5 KB, with what was found in an image drawn over it; None without one."""
    program = run.tokens.program
    look = Look(colour_order(run.cg, token), partial(kept_range, program, token), RunSurroundings(run, token))
    sketched = sketch(run.tokens.values[program.slots[token]], look)
    return _as_file(finished(sketched)) if sketched.may_be_drawn else None


def _as_file(shown: Preview) -> Thumbnail | None:
    if shown.picture is not None:
        return Thumbnail(shown.picture.media_type, shown.picture.data, shown.text)
    if shown.chart is None:
        return None
    size, painted = f'width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}"', paint_thumbnail(shown, (THUMB_WIDTH / 2, 0))
    chart = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{_CHART_STYLE}{painted}</svg>'
    return Thumbnail("image/svg+xml", chart.encode(), shown.text)
