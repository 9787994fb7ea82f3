"""Which of a camera's recent frames is the nearest to a time?"""

from __future__ import annotations

import math
import operator
import threading
from collections import deque

from epypes.acquisition.frames import Frame
from epypes.errors import FrameUnavailable


class Ring:
    """The recent frames of one camera; one thread appends, any may ask.

    Parameters
    ----------
    size
        How many frames it keeps; a newer one takes the place of the oldest.
    name
        What errors call it.

    Examples
    --------
    >>> ring = Ring(2)
    >>> for number, time_ns in enumerate([100, 200, 300], start=1):
    ...     ring.append(Frame("an image", time_ns, number))
    >>> ring.nearest(260).number
    3
    >>> ring.nearest(120)
    Traceback (most recent call last):
    epypes.errors.FrameUnavailable: The camera keeps nothing of that time, which is 0.000 s before its oldest frame. ...
    """

    def __init__(self, size: int = 8, *, name: str = "The camera") -> None:
        if operator.index(size) < 1:
            raise ValueError(f"A ring can't keep {size} frames. Give a size of 1 or more.")
        self.size, self.name = operator.index(size), name
        self._frames: deque[Frame] = deque(maxlen=self.size)
        self._lock = threading.Lock()

    def append(self, frame: Frame) -> None:
        """Keep a frame, and let go of the oldest if there are too many."""
        with self._lock:
            self._frames.append(frame)

    def nearest(self, time_ns: int, max_age_s: float = math.inf) -> Frame:
        """Return the frame captured nearest to a time; of two as near, the one that came first.

        Parameters
        ----------
        time_ns
            Unix time in ns.
        max_age_s
            How far from that time, in seconds, a frame may be.

        Raises
        ------
        FrameUnavailable
            There is no frame yet, the time is before the oldest one, or none is near enough.
        TypeError
            The time is not an integer.
        """
        wanted_ns = _require_time(time_ns)
        with self._lock:
            frames = tuple(self._frames)
        if not frames:
            raise FrameUnavailable(wanted_ns, None, None, f"{self.name} has no frame yet.")
        found = min(frames, key=lambda frame: abs(frame.captured_ns - wanted_ns))
        away_s = abs(found.captured_ns - wanted_ns) / 1e9
        # Where the nearest is later, an earlier one may have been let go. By time and not by place, since a system's
        # clock may be set back.
        is_kept = found.captured_ns <= wanted_ns or any(frame.captured_ns <= wanted_ns for frame in frames)
        if is_kept and away_s <= max_age_s:
            return found
        times_ns = [frame.captured_ns for frame in frames]
        why = (
            f"has no frame within {max_age_s:g} s of that time: the nearest is {away_s:,.3f} s away. "
            "Does the camera still run?"
            if is_kept
            else f"keeps nothing of that time, which is {away_s:,.3f} s before its oldest frame. "
            "Ask sooner, or keep more frames."
        )
        raise FrameUnavailable(wanted_ns, min(times_ns), max(times_ns), f"{self.name} {why}")

    def __len__(self) -> int:
        return len(self._frames)

    def __repr__(self) -> str:
        return f"<Ring: {len(self)} of {self.size} frames>"


def _require_time(time_ns: int) -> int:
    try:
        return operator.index(time_ns)
    except TypeError as error:
        text = f"time_ns is Unix time in ns, an integer as from time.time_ns(), not {time_ns!r:.40}."
        raise TypeError(text) from error
