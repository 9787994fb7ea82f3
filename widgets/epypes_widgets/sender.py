"""When does a frame go to the screen, so that the last one always arrives?

One frame is in flight at a time. Newer ones replace the one that waits, and the acknowledgement of a painted frame
lets the newest go; so the screen is never behind by more than one frame. A frame or an acknowledgement that is lost is
made good after a time-out. No widgets here: whoever uses a FrameSender says how a frame is sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

# Longer than any screen takes to paint; a screen that is gone costs a frame every half minute.
FIRST_TIMEOUT_S: Final = 2.0
LAST_TIMEOUT_S: Final = 32.0


@dataclass(frozen=True, slots=True)
class Frame:
    """What goes to the screen at once.

    Attributes
    ----------
    seq
        Rises with every frame of a panel.
    content
        What the front end is told beside the bytes; can be written as JSON.
    buffers
        The bytes of the pictures, in the order in which the content lists them.
    changed_ns
        When the newest value in it was set, by this process's ``perf_counter_ns``; 0 if nobody moved anything.
    """

    seq: int
    content: Mapping[str, Any]
    buffers: tuple[bytes, ...] = field(default=(), repr=False)
    changed_ns: int = 0


class FrameSender:
    """Sends frames one at a time, the newest next.

    Parameters
    ----------
    send
        Is called with a frame, on any thread, one call at a time; must not wait for the front end.
    later
        Is called with a delay in seconds and a function, which is to be called once after it, on any thread; a later
        call replaces an earlier one.

    Notes
    -----
    Nothing is sent before ``ready``: there is no view yet that could acknowledge it. All methods may be called from
    any thread.
    """

    def __init__(self, send: Callable[[Frame], None], later: Callable[[float, Callable[[], None]], None]) -> None:
        self._send, self._later = send, later
        # Held while sending, so that frames leave in order. An answer within send() on this thread is allowed.
        self._lock = threading.RLock()
        self._newest: Frame | None = None
        self._in_flight: Frame | None = None
        self._waiting = False
        self._views = 0
        self._was_mounted = False
        self._timeout_s = FIRST_TIMEOUT_S

    @property
    def in_flight(self) -> Frame | None:
        """The frame that was sent and is not painted yet."""
        return self._in_flight

    @property
    def newest(self) -> Frame | None:
        """The frame that was offered last."""
        return self._newest

    @property
    def mounted(self) -> bool:
        """Whether there is a view."""
        return self._views > 0

    @property
    def left(self) -> bool:
        """Whether there was a view, and there is none any more."""
        return self._was_mounted and not self._views

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
            self._timeout_s = FIRST_TIMEOUT_S
            self._go_on()
            return frame

    def mount(self) -> None:
        """Know that there is one more view, which is not to get frames yet."""
        with self._lock:
            self._views += 1
            self._was_mounted = True
            self._waiting, self._in_flight = False, None

    def ready(self) -> None:
        """Start over with the newest frame: what was in flight may be lost to a view that has just been mounted."""
        with self._lock:
            self._timeout_s = FIRST_TIMEOUT_S
            self._start_over()

    def closed(self) -> None:
        """Know that there is one view less; without one nothing is sent.

        A page that is loaded anew does not say that its views are gone; more of them are then counted than there are.
        """
        with self._lock:
            self._views = max(0, self._views - 1)
            if not self._views:
                self._in_flight = None

    def _start_over(self) -> None:
        self._in_flight = None
        self._waiting = self._newest is not None
        self._go_on()

    def _go_on(self) -> None:
        if self._views and self._waiting and self._in_flight is None and self._newest is not None:
            frame = self._in_flight = self._newest
            self._waiting = False
            # Asked for first: an answer within send() sends the next frame, whose time-out must replace this one.
            self._later(self._timeout_s, lambda: self._overdue(frame))
            self._send(frame)

    def _overdue(self, frame: Frame) -> None:
        """Take a frame, or its acknowledgement, for lost."""
        with self._lock:
            if self._in_flight is frame and self._views:
                self._timeout_s = min(2 * self._timeout_s, LAST_TIMEOUT_S)
                self._start_over()
