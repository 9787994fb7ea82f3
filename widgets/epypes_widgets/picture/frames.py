"""Frames: tokens of a run as a binary message for the screen.

Pictures travel as one binary message per frame, never in a trait: traits are kept, compared and saved.
"""

from __future__ import annotations

import reprlib
from collections.abc import Container, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from epypes.display import Marks, Most, Picture, Scene, encode_image, is_image, scene_of, scene_picture
from epypes.images import has_colours
from epypes.run import Run
from epypes_widgets.picture.histogram import histogram_of
from epypes_widgets.picture.picture_settings import NO_LIMITS, Limits, within_limits
from epypes_widgets.values import json_values, short_text

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.display import Backdrop
    from epypes_widgets.picture.screen import Shown

    Floats = npt.NDArray[np.float64]

# Wider than the box on a usual screen; a JPEG of this size is about 150 kB and takes 5 ms to encode.
MAX_SIDE_PX: Final = 1400
PINNED_SIDE_PX: Final = 320
_MAX_TEXT: Final = 400
_THUMBNAIL_PX: Final = 96
_THUMBNAIL_BYTES: Final = 4_000
# More points hide the image, and make messages of hundreds of kilobytes. A place has two coordinates.
MAX_DRAWN: Final = Most(marks=2_000, line=10_000, places=10_000, pairs=150)
_NO_SIZE, _NO_ANGLE = 0.0, -1.0
_DECIMALS: Final = 2
# Places are those of pixels' centres. The corners of boxes are between pixels.
_CENTRE: Final = 0.5


@dataclass(frozen=True, slots=True)
class Frame:
    """What goes to the screen at once.

    Attributes
    ----------
    seq
        Rises with every frame of a panel.
    content
        What the front end gets beside the bytes; can be written as JSON.
    buffers
        The bytes of the pictures, in the order in which the content lists them.
    changed_ns
        When the newest value in it was set, by this process's ``perf_counter_ns``; 0 if no value was set.
    """

    seq: int
    content: dict[str, Any]
    buffers: tuple[bytes, ...] = field(default=(), repr=False)
    changed_ns: int = 0


def make_frame(
    run: Run,
    token: str,
    seq: int,
    shown: Shown,
    changed_ns: int = 0,
    had_pictures: Container[str] = (),
    **content: Any,
) -> Frame:
    """Return what is shown of a run that has the tokens for it.

    Parameters
    ----------
    run
        Has not failed in what is shown.
    token
        Of the big picture.
    seq
        Of the frame.
    shown
        What else is shown.
    changed_ns
        When the newest of its values was set.
    had_pictures
        The tokens that have had a picture: where there are no marks any more, the image without them is left.
    content
        Is sent as it is.
    """
    drawn, limits = partial(picture, run, had_pictures=had_pictures, limits=shown.limits), shown.limits
    pictures = [drawn(token, "main")]
    main, over = pictures[0][0], shown.settings(token).over
    if main.get("image") == token and main["kind"] in ("mask", "labels"):
        main["beneath"] = _alike(run, token, (main["full_height"], main["full_width"]), had_pictures)
        if over in main["beneath"]:
            pictures.append(drawn(over, "under"))
    if shown.other:
        pictures.append(drawn(shown.other, "other"))
    pictures += [drawn(pinned, "pinned", max_side_px=PINNED_SIDE_PX) for pinned in shown.pinned]
    report = run.report
    durations_ns = report.durations_ns
    content = {
        "kind": "frame",
        "seq": seq,
        "token": token,
        "values": json_values(run.hyperparameters),
        "compute_ms": report.total_ns / 1e6,
        "times_ms": {name: ns / 1e6 for name, ns in durations_ns.items()},
        "ran": len(durations_ns),
        "reused": len(report.reused),
        "skipped": len(report.skipped),
        "pictures": [described for described, _ in pictures],
        "histogram": histogram_of(run, token, limits) if shown.has_histogram else None,
        "histograms": {cut: histogram_of(run, cut, limits) for cut in shown.cut} if shown.has_histogram else {},
        "scalars": [{"token": name, "text": short_text(run[name])} for name in shown.scalars if _is_fresh(run, name)],
        **content,
    }
    return Frame(seq, content, tuple(data for _, data in pictures if data), changed_ns)


def _is_fresh(run: Run, token: str) -> bool:
    return run.tokens.is_computed(token) and not run.tokens.is_stale(token)


def _alike(run: Run, token: str, size: tuple[int, int], pictures: Container[str]) -> list[str]:
    """Return the other tokens that are images of the same height and width, up to date or not."""
    values = dict(zip(run.tokens.program.tokens, run.tokens.values, strict=True))
    others = (name for name in run.cg.tokens if name != token and name in pictures)
    return [name for name in others if is_image(values[name]) and values[name].shape[:2] == size]


def picture(
    run: Run,
    token: str,
    role: str,
    max_side_px: int = MAX_SIDE_PX,
    had_pictures: Container[str] = (),
    limits: Limits = NO_LIMITS,
) -> tuple[dict[str, Any], bytes]:
    """Return what the front end gets of a token, and its bytes: an image, marks over their image, or a text."""
    found = scene(run, token, had_marks=token in had_pictures)
    described: dict[str, Any] = {"token": token, "role": role, "overlay": None}
    if found is None:
        return {**described, "media_type": "text/plain", "text": _text_in_place(run, token)}, b""
    seen = within_limits(found.backdrop, limits)
    image = seen.image
    encoded = encode_image(image, max_side_px, seen.order, seen.ends)
    described |= {
        "image": seen.name,
        "kind": encoded.kind,
        "range": [float(end) for end in found.backdrop.ends],
        "limits": [float(end) for end in seen.ends],
        "overlay": overlay(found),
        "media_type": encoded.media_type,
        "width": encoded.width,
        "height": encoded.height,
        "full_width": image.shape[1],
        "full_height": image.shape[0],
        "shape": " x ".join(map(str, image.shape)),
        "dtype": str(image.dtype),
        "order": _order_text(run, found.backdrop),
    }
    return described, encoded.data


def _text_in_place(run: Run, token: str) -> str:
    """Return what stands in the place of a picture."""
    if token not in run:
        return f"{token} has not been computed with these values."
    if run.tokens.is_nothing(token):
        return f"{token}: nothing found."
    short = reprlib.Repr()
    short.maxother = short.maxstring = _MAX_TEXT
    return short.repr(run[token])


def _order_text(run: Run, backdrop: Backdrop) -> str:
    """Return the order of an image's colours, and whether it is assumed; empty for one without colours."""
    if not has_colours(backdrop.image):
        return ""
    is_assumed = run.cg.has_token(backdrop.name) and backdrop.name not in run.cg.colours
    return backdrop.order + ", assumed" * is_assumed


def still_picture(
    run: Run, token: str, max_side_px: int, most_bytes: int, limits: Limits = NO_LIMITS
) -> Picture | None:
    """Return a token as one picture, its marks drawn over their image; None if it is none, or not up to date."""
    found = scene_of(run, token, had_marks=True)
    if found is None:
        return None
    return scene_picture(replace(found, backdrop=within_limits(found.backdrop, limits)), max_side_px, most_bytes)


def thumbnail(run: Run, token: str | None, limits: Limits = NO_LIMITS) -> Picture | None:
    """Return the thumbnail of a token, of at most 96 x 96 pixels; None if it is no picture, or not up to date."""
    return None if token is None else still_picture(run, token, _THUMBNAIL_PX, _THUMBNAIL_BYTES, limits)


def scene(run: Run, token: str, *, had_marks: bool = False) -> Scene | None:
    """Return the image as which a token is shown, with all marks that the screen gets; None if it is shown as text.

    ``had_marks``: whether the token had a picture in an earlier run: if nothing is found any more, the image is left.
    """
    return scene_of(run, token, MAX_DRAWN, had_marks=had_marks)


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
