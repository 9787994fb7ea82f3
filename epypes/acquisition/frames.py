"""Frames of a camera: one image with its time, the recent frames, and the copy of an image if its memory is shared."""

from __future__ import annotations

import itertools
import math
import operator
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from sys import getrefcount
from time import monotonic
from typing import Any, Final

from epypes.errors import FrameUnavailable, InvalidType, InvalidValue
from epypes.graph import CompGraph, colour_order
from epypes.images import in_order

Array = Any


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Frame:
    """One image of a camera.

    Attributes
    ----------
    image
        (y, x) or (y, x, channels), read-only; colours as from OpenCV, BGR.
    captured_ns
        When the camera gave it, Unix time in ns.
    number
        Its place in the camera's stream: from 1 in an ImageAcquisition and of ``read_frame``, from 0 in a video and in
        a ``for`` over a camera.
    time_s
        Of a video, its time since the first frame, in s; None of what has no times.
    frame_id
        The number that a camera with a node map gave it; frames that are missing or were left out make a gap. Else
        None.
    ticks
        The time of such a camera's own clock, of which ``camera.tick_hz`` are a second: the difference between two
        frames is exact, and nothing relates it to ``captured_ns``. None if the camera does not say.
    """

    image: Array
    captured_ns: int
    number: int
    time_s: float | None = None
    frame_id: int | None = None
    ticks: int | None = None

    def __repr__(self) -> str:
        shape = getattr(self.image, "shape", "?")
        return f"<Frame {self.number}: {shape} {getattr(self.image, 'dtype', '')}>"


def with_images(payload: Mapping[str, Any], cg: CompGraph) -> dict[str, Any]:
    """Return a payload with images in place of frames, their colours in the orders of the graph's tokens."""
    return {
        token: in_order(value.image, colour_order(cg, token)) if isinstance(value, Frame) else value
        for token, value in payload.items()
    }


class Ring:
    """The recent frames of one camera; one thread appends, any thread may ask.

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
            raise InvalidValue(f"A ring can't keep {size} frames. Give a size of 1 or more.")
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
        raise InvalidType(text) from error


def frame_image(given: list[Any]) -> Array:
    """Return what a camera gave, which comes in a list of one, as a read-only array that no other code writes to.

    A camera that fills one buffer again and again keeps a reference to its array, which is copied. A new array without
    another reference, the usual case, is locked as it is: a copy of a frame of 4K takes 10 ms and more.

    Raises
    ------
    TypeError, ValueError
        It is no image.
    """
    import numpy as np

    if not isinstance(given[0], np.ndarray):
        kind = type(given[0]).__name__
        raise InvalidType(f"A camera must give NumPy arrays, (y, x) or (y, x, channels), not {kind!r}.")
    # Before there is a name for it here, which would be one more reference.
    is_new = type(given[0]) is np.ndarray and given[0].flags.owndata and _references(given) <= _ALONE
    image = given.pop()
    if image.ndim not in (2, 3) or not image.size or image.dtype.kind not in "buif":
        raise InvalidValue(f"A frame must be (y, x) or (y, x, channels) of numbers, not {image.dtype} {image.shape}.")
    image = image if is_new else np.array(image, order="K")
    image.setflags(write=False)
    return image


def frame_of(given: list[Any], number: int) -> Frame:
    """Return what a camera gave just now, which comes in a list of one, as a frame."""
    captured_ns = time.time_ns()
    return Frame(frame_image(given), captured_ns, number)


class FrameCamera(ABC):
    """A camera that knows more of a frame than its image."""

    @abstractmethod
    def read_frame(self) -> Frame | None:
        """Return the next frame; None if there are no more."""


def next_frame(camera: Any, number: int) -> Frame | None:
    """Return the next frame of a camera, with this number in its stream; None if there are no more."""
    if isinstance(camera, FrameCamera):
        found = camera.read_frame()
        return None if found is None else replace(found, number=number)
    given = [camera.read()]
    return None if given[0] is None else frame_of(given, number)


def frames_read(camera: Any) -> Iterator[Frame]:
    """Yield the frames of a camera until there are no more."""
    for number in itertools.count():
        frame = next_frame(camera, number)
        if frame is None:
            return
        yield frame


def next_due_s(due_s: float, period_s: float) -> float:
    """Return when the frame after one that was due at ``due_s`` is due; a period from now, if that has passed."""
    now_s = monotonic()
    return due_s + period_s if now_s - due_s < period_s else now_s + period_s


def _references(given: list[Any]) -> int:
    return getrefcount(given[0])


# Measured, since interpreters differ in which references they count.
_ALONE: Final = _references([object()])
