"""Cameras of GenICam, by GigE Vision and USB3 Vision: the package viva-genicam.

It is one wheel, with no other software. harvesters needs a GenTL producer, and no package registry has one; Aravis'
binding needs PyGObject, which is compiled against the system's GLib. Aravis' fake camera is what this is tested with.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from epypes.acquisition.camera_settings import CameraSetting
from epypes.acquisition.device import FoundCamera, Grabbed
from epypes.acquisition.pixel_formats import to_image, unreadable
from epypes.errors import CameraUnavailable, InvalidValue, UnknownName
from epypes.optional import optional_import

with optional_import("genicam"):
    import viva_genicam as viva

_KINDS: Final = {
    "Integer": "int",
    "IntConverter": "int",
    "SwissKnife": "float",
    "Float": "float",
    "Converter": "float",
    "Boolean": "bool",
    "Enumeration": "choice",
    "StringReg": "text",
    "String": "text",
}
# Cameras answer within a millisecond or two.
_FIND_MS: Final = 200
# A camera that gives no frame is asked for a register, since GigE Vision says nothing of a cable that was pulled.
_ASK_AFTER_S: Final = 0.25
# Registers that every camera of GigE Vision has.
_SERIAL, _SERIAL_BYTES, _TICK_HZ, _CONTROL = 0x00D8, 16, 0x093C, 0x0A00
# Settings that Aravis and some cameras leave out of the categories, which list all others.
_STANDARD: Final = ("AcquisitionFrameRateEnable", "AcquisitionFrameRate", "ExposureTime", "Gain", "TriggerMode")


class Backend:
    """The cameras of GigE Vision on all networks of this machine, and of USB3 Vision."""

    def __init__(self) -> None:
        self._infos: dict[str, Any] = {}

    def find(self) -> list[FoundCamera]:
        """Return the cameras that are there now."""
        found = [(_found_gige(info), info) for info in viva.discover(timeout_ms=_FIND_MS, all=True)]
        with suppress(viva.TransportError):  # a machine without USB
            found += [(_found_usb(info), info) for info in viva.discover_u3v()]
        self._infos = {each.at: info for each, info in found}
        return [each for each, _ in found]

    def open(self, found: FoundCamera) -> GenicamDevice:
        """Open one that was found last; CameraUnavailable with the reason if that can't be."""
        try:
            return GenicamDevice(viva.Camera.open(self._infos[found.at]), found.address)
        except viva.GenicamError as error:
            text = f"Camera {found.address!r} can't be opened: {error}."
            raise CameraUnavailable(found.address, text) from error


def _found_gige(info: Any) -> FoundCamera:
    """Return a camera of GigE Vision as it answers without being opened."""
    try:
        with viva.connect_gige(info, monitor=True) as camera:
            serial = camera.read_register(_SERIAL, _SERIAL_BYTES).rstrip(b"\0").decode("latin-1")
            is_free = not any(camera.read_register(_CONTROL))
    except viva.GenicamError:  # a program that has it for itself alone
        serial, is_free = "", False
    return FoundCamera("genicam", serial, info.model or "", info.ip, is_free)


def _image(frame: Any) -> Any:
    """Return the image of a frame, whose pixels the library has unpacked; colours come as RGB."""
    array, name = frame.to_numpy(), frame.pixel_format
    if array.ndim == 1:
        raise unreadable(name)
    return to_image("RGB8" if array.ndim > 2 else name.removesuffix("p").removesuffix("Packed"))(array)


def _found_usb(info: Any) -> FoundCamera:
    return FoundCamera("genicam", info.serial or "", info.model or "", f"{info.bus}-{info.address}", True)


class GenicamDevice:
    """A camera that is open.

    Parameters
    ----------
    camera
        A ``viva_genicam.Camera``, whose control this process has.
    address
        For errors.
    """

    def __init__(self, camera: Any, address: str) -> None:
        self.lost = self.incomplete = self.skipped = 0
        self._camera, self._address = camera, address
        self._is_gige = camera.transport == "gige"
        self._names = self._listed()
        self._stream: Any = None
        self._counted, self._dropped = (0, 0), 0
        self._heard_s = time.monotonic()
        # USB3 Vision counts in nanoseconds.
        ticks = camera.read_register(_TICK_HZ, 8) if self._is_gige else None
        self.tick_hz = 1_000_000_000 if ticks is None else int.from_bytes(ticks) or None

    # -- the node map -------------------------------------------------------------------------------------------

    def names(self) -> tuple[str, ...]:
        """Return the names of the features that have a value, as the categories list them."""
        return self._names

    def _listed(self) -> tuple[str, ...]:
        kinds = {info.name: info.kind for info in self._camera.all_node_info() if info.visibility != "Invisible"}
        listed = [name for names in self._camera.categories().values() for name in names]
        return tuple(name for name in dict.fromkeys((*listed, *_STANDARD)) if kinds.get(name) in _KINDS)

    def setting(self, name: str) -> CameraSetting | None:
        """Return a feature with its value and range; None if there is none of this name."""
        if name not in self._names:
            return None
        info = self._camera.node_info(name)
        with self._asked():
            state = self._camera.feature_state(name)
        kind: Any = "int" if isinstance(state.value, int) and info.kind == "SwissKnife" else _KINDS[info.kind]
        low, high, step = (state.range.min, state.range.max, state.range.inc) if state.range else (None, None, None)
        if kind == "int":
            low, high = (None if end is None else int(end) for end in (low, high))
        choices = tuple(state.enum_entries or ())
        is_writable = state.access in ("RW", "WO")
        about = info.tooltip or info.description or ""
        return CameraSetting(name, kind, state.value, low, high, step, choices, state.unit or "", is_writable, about)

    def write(self, name: str, value: Any) -> None:
        """Set a feature; ValueError with the reason if it can't be."""
        kind = self._camera.node_info(name).kind
        by_kind = {"int": "set_integer", "float": "set_float", "bool": "set_bool", "choice": "set_enum"}
        with self._asked(f"{name} can't be set to {value!r:.60}"):
            getattr(self._camera, by_kind.get(_KINDS[kind], "set_string"))(name, value)

    def execute(self, name: str) -> None:
        """Run a command; UnknownName if there is none of this name."""
        info = self._camera.node_info(name)
        if info is None or info.kind != "Command":
            commands = [each.name for each in self._camera.all_node_info() if each.kind == "Command"]
            raise UnknownName("command", name, commands, "of this camera")
        with self._asked(f"{name} can't be run now"):
            self._camera.execute(name, wait=False)

    @contextmanager
    def _asked(self, refusal: str = "A setting can't be read") -> Iterator[None]:
        """Tell a camera that refuses from one that is gone."""
        try:
            yield
        except viva.GenicamError as error:
            self._require_there()
            raise InvalidValue(f"{refusal}: {error}.") from error

    # -- the stream ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to stream, in packets as large as the network carries."""
        with self._asked("The camera does not start"):
            self._stream = self._camera.stream(auto_packet_size=True)
            self._stream.__enter__()
        self._counted, self._dropped = (0, 0), 0
        self._heard_s = time.monotonic()

    def stop(self) -> None:
        """End the stream; nothing happens without one."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with self._asked("The camera does not stop"):
                stream.__exit__(None, None, None)

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the newest frame that is whole; None if none came in time; CameraUnavailable if the camera is gone."""
        newest = self._next(timeout_s)
        if newest is None:
            if time.monotonic() - self._heard_s > _ASK_AFTER_S:
                self._require_there()
            return None
        self._heard_s = time.monotonic()
        while (later := self._next(0.0)) is not None:
            self.skipped += 1
            newest = later
        stats = self._stream.stats()
        self._count(stats)
        dropped, self._dropped = self._dropped, stats.frames_backpressure
        if self._dropped > dropped:  # the queue, of which the newest are dropped, was full: the next frame is a new one
            self.skipped += 1 + self._dropped - dropped
            return None
        return Grabbed(_image(newest), newest.block_id, newest.ts_dev)

    def close(self) -> None:
        """Let go of the camera, whatever state it is in."""
        with suppress(CameraUnavailable, InvalidValue):
            self.stop()
        with suppress(viva.GenicamError):
            self._camera.close()

    def _next(self, timeout_s: float) -> Any:
        try:
            return self._stream.next_frame(round(timeout_s * 1_000))
        except viva.GenicamError:  # mostly that none came in time; `_require_there` finds out what else it is
            self._count(self._stream.stats())
            return None

    def _count(self, stats: Any) -> None:
        lost, incomplete = self._counted
        self._counted = stats.frames_missed, stats.frames_incomplete
        self.lost += stats.frames_missed - lost
        self.incomplete += stats.frames_incomplete - incomplete

    def _require_there(self) -> None:
        """Raise CameraUnavailable unless the camera answers, and is still controlled by this process."""
        try:
            is_ours = not self._is_gige or any(self._camera.read_register(_CONTROL))
        except viva.GenicamError as error:
            text = f"Camera {self._address!r} does not answer: it was unplugged or switched off."
            raise CameraUnavailable(self._address, text, is_gone=True) from error
        if not is_ours or self._camera.control_state == viva.ControlState.LOST:
            text = f"Camera {self._address!r} was switched off and on again, or taken over by another program."
            raise CameraUnavailable(self._address, text, is_gone=True)
        self._heard_s = time.monotonic()
