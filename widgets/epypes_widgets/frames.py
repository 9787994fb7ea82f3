"""How do tokens of a run become a frame for the screen?"""

from __future__ import annotations

import reprlib
from collections.abc import Container
from functools import partial
from typing import Any, Final

from epypes.display import encode_image
from epypes.run import Run
from epypes_widgets.looking.histogram import histogram_of
from epypes_widgets.looking.overlay import overlay, scene
from epypes_widgets.plain import plain_values
from epypes_widgets.sender import Frame
from epypes_widgets.shown import Shown

# Wider than the box on a usual screen; a JPEG of this size is about 150 kB and takes 5 ms to encode.
MAX_SIDE_PX: Final = 1400
PINNED_SIDE_PX: Final = 320
_TEXT_LENGTH: Final = 400

# What the front end is told of a picture, and its bytes.
Picture = tuple[dict[str, Any], bytes]


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
        The tokens that have had a picture: where nothing is found any more, the image without marks is left.
    content
        Is told to the front end as it is.
    """
    drawn = partial(picture, run, had_pictures=had_pictures)
    pictures = [drawn(token, "main")]
    if shown.other:
        pictures.append(drawn(shown.other, "other"))
    pictures += [drawn(token, "pinned", max_side_px=PINNED_SIDE_PX) for token in shown.pinned]
    content = {
        "kind": "frame",
        "seq": seq,
        "token": token,
        "values": plain_values(run.hyperparameters),
        **_times(run),
        "pictures": [described for described, _ in pictures],
        "histogram": histogram_of(run, token) if shown.has_histogram else None,
        "histograms": {token: histogram_of(run, token) for token in shown.cut} if shown.has_histogram else {},
        **content,
    }
    return Frame(seq, content, tuple(data for _, data in pictures if data), changed_ns)


def picture(
    run: Run, token: str, role: str, max_side_px: int = MAX_SIDE_PX, had_pictures: Container[str] = ()
) -> Picture:
    """Return a token as a picture: an image, marks over their image, or anything else as text."""
    found = scene(run, token, had_marks=token in had_pictures)
    described: dict[str, Any] = {"token": token, "role": role, "overlay": None}
    if found is None:
        text = text_of(run[token]) if token in run else f"{token} has not been computed with these values."
        return {**described, "media_type": "text/plain", "text": text}, b""
    image = found.backdrop.image
    encoded = encode_image(image, max_side_px, found.backdrop.order, found.backdrop.ends)
    described |= {
        "overlay": overlay(found),
        "media_type": encoded.media_type,
        "width": encoded.width,
        "height": encoded.height,
        "full_width": image.shape[1],
        "full_height": image.shape[0],
        "shape": " x ".join(map(str, image.shape)),
        "dtype": str(image.dtype),
    }
    return described, encoded.data


def text_of(value: Any) -> str:
    """Return a value as a short text."""
    short = reprlib.Repr()
    short.maxother = short.maxstring = _TEXT_LENGTH
    return short.repr(value)


def _times(run: Run) -> dict[str, Any]:
    report = run.report
    return {
        "compute_ms": report.total_ns / 1e6,
        "times_ms": {name: ns / 1e6 for name, ns in report.durations_ns.items()},
        "ran": len(report.ran),
        "reused": len(report.reused),
    }
