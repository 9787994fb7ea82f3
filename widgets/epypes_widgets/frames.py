"""Which picture goes to the screen, and when?

One frame is in flight at a time. Newer ones replace the one that waits, and the acknowledgement of a painted frame
lets the newest go; so the screen is never behind by more than one frame, and the last one always arrives.
No widgets here: whoever uses a FrameSender says how a frame is sent.
"""

from __future__ import annotations

import enum
import json
import math
import numbers
import reprlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from epypes.display.previews.imagekinds import is_image
from epypes.display.previews.ranges import kept_range
from epypes.display.previews.raster import encode_image
from epypes.graph import colour_order
from epypes.run import Run

# Wider than the box on a usual screen; a JPEG of this size is about 150 kB and takes 5 ms to encode.
MAX_SIDE_PX: Final = 1400
_TEXT_LENGTH: Final = 400


@dataclass(frozen=True, slots=True)
class Frame:
    """A token's value as it goes to the screen.

    Attributes
    ----------
    seq
        Rises with every frame of a panel.
    content
        What the front end is told beside the bytes; can be written as JSON.
    data
        The bytes of the picture; empty for a token that is shown as text.
    changed_ns
        When the newest value in it was set, by this process's ``perf_counter_ns``.
    """

    seq: int
    content: Mapping[str, Any]
    data: bytes = field(default=b"", repr=False)
    changed_ns: int = 0


def make_frame(run: Run, token: str, seq: int, changed_ns: int = 0, *, stale: bool = False) -> Frame:
    """Return a token of a completed run as a frame: an image as a picture, anything else as text.

    ``stale`` says that newer values failed, so that this is not what the controls ask for.
    """
    report = run.report
    content: dict[str, Any] = {
        "kind": "frame",
        "seq": seq,
        "token": token,
        "values": {name: plain(value) for name, value in run.hyperparameters.items()},
        "compute_ms": report.total_ns / 1e6,
        "times_ms": {name: ns / 1e6 for name, ns in report.durations_ns.items()},
        "ran": len(report.ran),
        "reused": len(report.reused),
        "stale": stale,
    }
    value = run[token]
    if not is_image(value):
        content |= {"media_type": "text/plain", "text": text_of(value)}
        return Frame(seq, content, b"", changed_ns)
    ends = kept_range(run.tokens.program, token, value)
    picture = encode_image(value, MAX_SIDE_PX, colour_order(run.cg, token), ends)
    content |= {
        "media_type": picture.media_type,
        "width": picture.width,
        "height": picture.height,
        "shape": " x ".join(str(side) for side in value.shape),
        "dtype": str(value.dtype),
    }
    return Frame(seq, content, picture.data, changed_ns)


def text_of(value: Any) -> str:
    """Return a value as a short text."""
    short = reprlib.Repr()
    short.maxother = short.maxstring = _TEXT_LENGTH
    return short.repr(value)


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers, strings, None; all others by a short repr."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, numbers.Integral):
        return int(value)
    # JSON has neither infinity nor NaN.
    if isinstance(value, numbers.Real) and math.isfinite(float(value)):
        return float(value)
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return reprlib.repr(value)


class FrameSender:
    """Sends frames one at a time, the newest next.

    Parameters
    ----------
    send
        Is called with a frame, on any thread, one call at a time; must not wait for the front end.

    Notes
    -----
    Nothing is sent before ``ready``: there is no view yet that could acknowledge it. All methods may be called from
    any thread.
    """

    def __init__(self, send: Callable[[Frame], None]) -> None:
        self._send = send
        # Held while sending, so that frames leave in order. An answer within send() on this thread is allowed.
        self._lock = threading.RLock()
        self._newest: Frame | None = None
        self._in_flight: Frame | None = None
        self._waiting = False
        self._mounted = False

    @property
    def in_flight(self) -> Frame | None:
        """The frame that was sent and is not painted yet."""
        return self._in_flight

    @property
    def newest(self) -> Frame | None:
        """The frame that was offered last."""
        return self._newest

    def offer(self, frame: Frame) -> None:
        """Send a frame now, or when the one in flight has been painted, unless a newer one comes until then."""
        with self._lock:
            self._newest = frame
            self._waiting = True
            self._go_on()

    def painted(self, seq: int) -> Frame | None:
        """Take an acknowledgement; return the frame that it was for, None if it was late or came twice."""
        with self._lock:
            frame = self._in_flight
            if frame is None or frame.seq != seq:
                return None
            self._in_flight = None
            self._go_on()
            return frame

    def ready(self) -> None:
        """Start over with the newest frame: a view has been mounted, and what was in flight may be lost."""
        with self._lock:
            self._mounted = True
            self._in_flight = None
            self._waiting = self._newest is not None
            self._go_on()

    def _go_on(self) -> None:
        if self._mounted and self._waiting and self._in_flight is None and self._newest is not None:
            self._waiting = False
            self._in_flight = self._newest
            self._send(self._newest)
