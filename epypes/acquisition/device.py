"""Cameras with a node map, by their serial number: frames, settings and counts over a backend for each library.

One thread reads. It waits for a frame in short steps, so that any other thread can close the camera, or have it stand
still while a setting is changed. A camera that is gone is closed, and opened again by the next read.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Protocol, Self

from epypes.acquisition.camera_settings import CameraSettings, NodeMap, SettingsMemory
from epypes.acquisition.device_owner import DeviceOwner
from epypes.acquisition.frames import Frame, FrameCamera, next_due_s
from epypes.errors import CameraUnavailable, MissingPackage
from epypes.wording import counted

# The kinds of cameras, each of which is a module beside this one with a ``Backend``.
BACKENDS: Final = ("basler", "genicam")
_STEP_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that a library has found.

    Attributes
    ----------
    kind
        ``"basler"`` or ``"genicam"``.
    serial, model
        As the camera says; the serial number is empty where it does not answer.
    at
        Where it is: its IP address, its place on a bus, or what the library calls it.
    is_free
        Whether it can be opened: no program holds it.
    """

    kind: str
    serial: str
    model: str
    at: str
    is_free: bool

    @property
    def address(self) -> str:
        """What ``ep.camera`` takes."""
        return f"{self.kind}:{self.serial or self.at}"


@dataclass(frozen=True, slots=True)
class DeviceCounts:
    """Frames of a camera since it was made by ``ep.camera``.

    Attributes
    ----------
    frames
        That were read.
    lost
        That the camera has sent, and that never arrived.
    incomplete
        That arrived in part; they are thrown away.
    skipped
        That arrived and were left out, since the reader was slower, or `fps` lower: the newest frame wins.
    outages
        How often the camera was gone.
    """

    frames: int = 0
    lost: int = 0
    incomplete: int = 0
    skipped: int = 0
    outages: int = 0


@dataclass(frozen=True, slots=True)
class Grabbed:
    """A frame as a backend gives it.

    Attributes
    ----------
    image
        (y, x) or (y, x, channels), gray or BGR; in memory of its own, to which no other code writes.
    frame_id, ticks
        The camera's own number and time of it; None if it has none.
    """

    image: Any
    frame_id: int | None
    ticks: int | None


class Device(NodeMap, Protocol):
    """A camera that is open; what a backend implements beside the node map.

    Attributes
    ----------
    lost, incomplete, skipped
        Counted since it was opened.
    tick_hz
        Ticks per second of the camera's clock; None if it does not say.
    """

    lost: int
    incomplete: int
    skipped: int
    tick_hz: int | None

    def start(self) -> None:
        """Begin to stream."""

    def stop(self) -> None:
        """End the stream; nothing happens without one."""

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the newest frame, after waiting for it; None if none came; CameraUnavailable if the camera is gone."""

    def close(self) -> None:
        """Let go of the camera, whatever state it is in."""


class Backend(Protocol):
    """A library of cameras."""

    def find(self) -> list[FoundCamera]:
        """Return the cameras that are there now."""

    def open(self, found: FoundCamera) -> Device:
        """Open one; CameraUnavailable if that can't be."""


def backend(kind: str) -> Backend:
    """Return the library of a kind of cameras; MissingPackage if it is not installed."""
    made: Backend = import_module(f"epypes.acquisition.{kind}").Backend()
    return made


def find_cameras() -> tuple[list[FoundCamera], list[MissingPackage]]:
    """Return the cameras with a node map that are there now, and which package is missing to find more."""
    found: list[FoundCamera] = []
    missing: list[MissingPackage] = []
    for kind in BACKENDS:
        try:
            found += backend(kind).find()
        except MissingPackage as error:
            missing.append(error)
    return found, missing


class DeviceCamera(DeviceOwner, FrameCamera):
    """A camera with a node map; made by ``ep.camera("basler:SERIAL")`` or ``ep.camera("genicam:SERIAL")``.

    Attributes
    ----------
    address
        As it was given.

    Parameters
    ----------
    address
        The kind and the serial number, or the IP address; without either, the only camera of this kind.
    fps
        Frames per second at most; those in between are left out.
    """

    def __init__(self, address: str, fps: float | None = None) -> None:
        super().__init__()
        self.address = address
        kind, _, self._wanted = address.partition(":")
        self._backend = backend(kind)
        self._period_s, self._due_s = 0.0 if fps is None else 1 / fps, -float("inf")
        self._device: Device | None = None
        self._is_closed = self._is_streaming = self._is_gone = False
        self._closed_counts, self._frames, self._skipped, self._outages = (0, 0, 0), 0, 0, 0
        # The thread that reads, or stops the camera, has the stream; it takes the turn first, so that another thread
        # that waits for the stream is next. With the lock held, the device is opened, closed, or its settings are used.
        # All are re-entrant, since a read opens the camera, too.
        self._turn, self._stream, self._lock = threading.RLock(), threading.RLock(), threading.RLock()
        self._reader: int | None = None
        self._finalizer: Any = None
        self._memory = SettingsMemory()
        with self._opened():
            pass

    @property
    def settings(self) -> CameraSettings:
        """Exposure, gain, trigger, pixel format, region and all others, by the camera's own names."""
        # Were it kept, it and the camera would refer to each other, and a dropped camera would keep its device.
        return CameraSettings(self._opened, self._stopped, self._memory)

    @property
    def counts(self) -> DeviceCounts:
        """How many frames were read, lost, incomplete and skipped, and how often the camera was gone."""
        with self._lock:
            lost, incomplete, skipped = _sums(self._closed_counts, _counts(self._device))
        return DeviceCounts(self._frames, lost, incomplete, skipped + self._skipped, self._outages)

    @property
    def tick_hz(self) -> int | None:
        """Ticks per second of the camera's clock, for ``Frame.ticks``; None if the camera does not say."""
        with self._opened() as device:
            return device.tick_hz

    def read(self) -> Any:
        """Return the image of the next frame; None if `close` was called meanwhile; errors as `read_frame`."""
        frame = self.read_frame()
        return None if frame is None else frame.image

    def read_frame(self) -> Frame | None:
        """Return the next frame, with the camera's number and time of it; None if `close` was called meanwhile.

        With a trigger it waits until there is one, or the camera is closed.

        Raises
        ------
        CameraUnavailable
            The camera is gone, or held by another program. The next read opens it again, with the same settings.
        ValueError
            Its pixel format can't be read.
        """
        self._is_closed, self._reader, self._last_reader = False, threading.get_ident(), threading.current_thread()
        try:
            grabbed = None
            while grabbed is None and not self._is_closed:
                grabbed = self._grab()
            if grabbed is None:
                return None
            captured_ns = time.time_ns()
            self._frames += 1
            grabbed.image.setflags(write=False)
            return Frame(grabbed.image, captured_ns, self._frames, frame_id=grabbed.frame_id, ticks=grabbed.ticks)
        finally:
            self._reader = None
            if self._is_closed:
                self.close()

    def trigger(self) -> None:
        """Give the camera a trigger, if its ``TriggerMode`` is ``On`` and its ``TriggerSource`` is ``Software``."""
        self.settings.execute("TriggerSoftware")

    def close(self) -> None:
        """Let go of the camera; a read under way ends within moments. The next read opens it again."""
        self._is_closed = True
        # The handler of a signal runs on the thread that reads, in the midst of it.
        if self._reader != threading.get_ident():
            with self._turn, self._stream:
                self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._device is None else "streaming" if self._is_streaming else "open"
        return f"<DeviceCamera {self.address}: {state}, {counted(self._frames, 'frame')}>"

    # -- the device ---------------------------------------------------------------------------------------------

    def _grab(self) -> Grabbed | None:
        """Return the newest frame if one that is due comes within a step of waiting."""
        with self._turn:
            self._stream.acquire()
        try:
            grabbed = None if self._is_closed else self._streaming().grab(_STEP_S)
        except CameraUnavailable:
            self._is_gone = True
            raise
        finally:
            self._stream.release()
        if grabbed is not None and time.monotonic() < self._due_s:
            self._skipped += 1
            return None
        if grabbed is not None:
            self._due_s = next_due_s(self._due_s, self._period_s)
        return grabbed

    @contextmanager
    def _opened(self) -> Iterator[Device]:
        """Hold the open device; it may stream."""
        with self._lock:
            # Another thread that reads closes it itself.
            if self._is_gone and self._stream.acquire(blocking=False):
                try:
                    self._release()
                finally:
                    self._stream.release()
            if self._device is None:
                self._device = self._open()
            try:
                yield self._device
            except CameraUnavailable:
                self._is_gone = True
                raise

    @contextmanager
    def _stopped(self) -> Iterator[Device]:
        """Hold the open device while it stands still; the next step of a read starts it again."""
        with self._turn, self._stream, self._opened() as device:
            if self._is_streaming:
                self._is_streaming = False
                device.stop()
            yield device

    def _streaming(self) -> Device:
        with self._opened() as device:
            if not self._is_streaming:
                device.start()
                self._is_streaming = True
        return device

    def _open(self) -> Device:
        found = self._found()
        self._own(found.address)
        with ExitStack() as undone:
            undone.callback(self._disown)
            # It may have been that of a camera which gave way.
            if not found.is_free and not (found := self._found()).is_free:
                text = f"Camera {self.address!r} is held: another program has it. Close it there."
                raise CameraUnavailable(self.address, text)
            device = self._backend.open(found)
            undone.callback(device.close)
            self._memory.restore(device)
            undone.pop_all()
        # A camera that is dropped without `close` lets go of its device, too.
        self._finalizer = weakref.finalize(self, device.close)
        self._finalizer.atexit = False
        return device

    def _found(self) -> FoundCamera:
        """Return the one camera that is meant; CameraUnavailable with those that are there if there is none."""
        found = self._backend.find()
        matching = [each for each in found if self._wanted in ("", each.serial, each.at)]
        if len(matching) != 1:
            there = ", ".join(each.address for each in found)
            text = f"There is no camera {self.address!r}." if not matching else f"{self.address!r} is more than one."
            way_out = f"There are: {there}." if there else "None was found. Check its power, its cable and its network."
            raise CameraUnavailable(self.address, f"{text} {way_out}", is_gone=not matching)
        return matching[0]

    def _release(self) -> None:
        """Close the device; the caller has the stream."""
        with self._lock:
            (device, is_gone), self._device = (self._device, self._is_gone), None
            # First: the next device does not stream, whether this one can be closed or not.
            self._is_streaming = self._is_gone = False
            if device is not None:
                self._finalizer.detach()
                self._outages += is_gone
                self._closed_counts = _sums(self._closed_counts, _counts(device))
                try:
                    device.close()
                finally:
                    self._disown()


def _sums(one: tuple[int, int, int], other: tuple[int, int, int]) -> tuple[int, int, int]:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _counts(device: Device | None) -> tuple[int, int, int]:
    return (0, 0, 0) if device is None else (device.lost, device.incomplete, device.skipped)
