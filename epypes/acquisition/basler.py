"""Basler's cameras, by pylon: the package pypylon, which has pylon itself in its wheel."""

from __future__ import annotations

import select
import threading
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any, Final

from epypes.acquisition.camera_settings import CameraSetting
from epypes.acquisition.device import FoundCamera, Grabbed
from epypes.acquisition.pixel_formats import to_image
from epypes.errors import CameraUnavailable, InvalidValue, UnknownName
from epypes.optional import optional_import

# Its types, made by SWIG, warn on Python 3.12 and end the interpreter where warnings are errors.
with optional_import("basler"), warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pypylon import genicam, pylon

_KINDS: Final = {
    genicam.intfIInteger: "int",
    genicam.intfIFloat: "float",
    genicam.intfIBoolean: "bool",
    genicam.intfIEnumeration: "choice",
    genicam.intfIString: "text",
}
_COMMAND: Final = (genicam.intfICommand,)
# pylon closes a camera of GigE Vision that has not answered for this long; USB reports a removal at once.
_HEARTBEAT_MS: Final = 1_000
_LAST_GIGE_ID: Final = 65_535
# pylon keeps 38 kB of each device that it has made, but none of one that is opened again. By pylon's full name.
_made: Final[dict[str, Any]] = {}
_lock: Final = threading.Lock()


class Backend:
    """The cameras that pylon finds, by GigE, USB and its emulation (the environment variable ``PYLON_CAMEMU``)."""

    def __init__(self) -> None:
        self._factory = pylon.TlFactory.GetInstance()
        self._infos: dict[str, Any] = {}

    def find(self) -> list[FoundCamera]:
        """Return the cameras that are there now."""
        found = [(self._described(info), info) for info in self._factory.EnumerateDevices()]
        self._infos = {each.at: info for each, info in found}
        return [each for each, _ in found]

    def open(self, found: FoundCamera) -> BaslerDevice:
        """Open one that was found last; CameraUnavailable with pylon's reason if that can't be."""
        info = self._infos[found.at]
        name = info.GetFullName()
        with _lock:
            try:
                camera = _made[name] if name in _made else pylon.InstantCamera(self._factory.CreateDevice(info))
                camera.Open()
                _made[name] = camera
                return BaslerDevice(camera, found.address)
            except genicam.GenericException as error:
                made = _made.pop(name, None)
                if made is not None:
                    made.Close()
                text = f"Camera {found.address!r} can't be opened: {_reason(error)}"
                raise CameraUnavailable(found.address, text) from error

    def _described(self, info: Any) -> FoundCamera:
        at, name = info.GetIpAddress() if info.IsIpAddressAvailable() else info.GetFullName(), info.GetFullName()
        # Once: another thread may take it out.
        made = _made.get(name)
        is_free = self._factory.IsDeviceAccessible(info) and not (made is not None and made.IsOpen())
        return FoundCamera("basler", info.GetSerialNumber(), info.GetModelName(), at, is_free)


class BaslerDevice:
    """A camera that pylon has opened.

    Parameters
    ----------
    camera
        A ``pylon.InstantCamera``, open.
    address
        For errors.
    """

    def __init__(self, camera: Any, address: str) -> None:
        self.lost = self.incomplete = self.skipped = 0
        self._camera, self._address, self._nodes = camera, address, camera.GetNodeMap()
        self._last_id: int | None = None
        self._to_image, self._frames = to_image("Mono8"), select.poll()
        heartbeat = camera.GetTLNodeMap().GetNode("HeartbeatTimeout")
        if genicam.IsWritable(heartbeat):
            heartbeat.SetValue(_HEARTBEAT_MS)
        hertz = self._nodes.GetNode("GevTimestampTickFrequency")
        self.tick_hz = int(hertz.GetValue()) if genicam.IsReadable(hertz) else None

    # -- the node map -------------------------------------------------------------------------------------------

    def names(self) -> tuple[str, ...]:
        """Return the names of the features that have a value, as the node map orders them."""
        return self._features(_KINDS)

    def _features(self, kinds: Collection[int]) -> tuple[str, ...]:
        return tuple(node.GetNode().GetName() for node in self._nodes.GetNodes() if _is_feature(node, kinds))

    def setting(self, name: str) -> CameraSetting | None:
        """Return a feature with its value and range; None if there is none of this name."""
        self._require_there()
        node = self._nodes.GetNode(name)
        if not _is_feature(node, _KINDS):
            return None
        kind: Any = _KINDS[node.GetNode().GetPrincipalInterfaceType()]
        has_range = kind in ("int", "float")
        with self._asked(f"{name} can't be read now"):
            return CameraSetting(
                name,
                kind,
                node.GetValue() if genicam.IsReadable(node) else None,
                node.GetMin() if has_range else None,
                node.GetMax() if has_range else None,
                node.GetInc() if kind == "int" else None,
                tuple(node.GetSymbolics()) if kind == "choice" else (),
                node.GetUnit() if has_range else "",
                genicam.IsWritable(node),
                node.GetNode().GetToolTip(),
            )

    def write(self, name: str, value: Any) -> None:
        """Set a feature; ValueError with pylon's reason if it can't be."""
        with self._asked(f"{name} can't be set to {value!r:.60}"):
            self._nodes.GetNode(name).SetValue(value)

    def execute(self, name: str) -> None:
        """Run a command; UnknownName if there is none of this name."""
        node = self._nodes.GetNode(name)
        if not _is_feature(node, _COMMAND):
            raise UnknownName("command", name, self._features(_COMMAND), "of this camera")
        with self._asked(f"{name} can't be run now"):
            node.Execute()

    @contextmanager
    def _asked(self, refusal: str) -> Iterator[None]:
        """Tell a camera that refuses from one that is gone."""
        try:
            yield
        except genicam.GenericException as error:
            self._require_there()
            raise InvalidValue(f"{refusal}: {_reason(error)}") from error

    # -- the stream ---------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to stream; of several frames that wait, the newest is given."""
        try:
            self._to_image, self._last_id = to_image(self._nodes.GetNode("PixelFormat").GetValue()), None
            self._camera.StartGrabbing(pylon.GrabStrategy_LatestImageOnly)
            # pylon's own waiting sends SIGALRM, which other code of the process may handle: it then waits for ever.
            self._frames = select.poll()
            self._frames.register(self._camera.GetGrabResultWaitObject().GetFd(), select.POLLIN)
        except genicam.GenericException as error:
            raise self._gone(error) from error

    def stop(self) -> None:
        """End the stream."""
        self._camera.StopGrabbing()

    def grab(self, timeout_s: float) -> Grabbed | None:
        """Return the newest frame that is whole; None if none came in time; CameraUnavailable if the camera is gone."""
        self._frames.poll(timeout_s * 1_000)
        self._require_there()
        try:
            found = self._camera.RetrieveResult(0, pylon.TimeoutHandling_Return)
        except genicam.GenericException as error:
            raise self._gone(error) from error
        with found:
            if not found.IsValid():
                return None
            self._count(found)
            if not found.GrabSucceeded():
                self.incomplete += 1
                return None
            return Grabbed(self._to_image(found.GetArray()), self._last_id, found.GetTimeStamp() or None)

    def close(self) -> None:
        """Let go of the camera."""
        if self._camera.IsCameraDeviceRemoved():
            with _lock:
                _made.pop(self._camera.GetDeviceInfo().GetFullName(), None)
        self._camera.Close()

    def _count(self, found: Any) -> None:
        """Count what is missing between this frame and the one before, by the camera's numbers."""
        skipped, last = found.GetNumberOfSkippedImages(), self._last_id
        self.skipped += skipped
        frame_id: int = found.GetBlockID()
        has_ids = frame_id < 2**64 - 1
        if has_ids and last is not None:
            # On GigE Vision 1 the number has 16 bits, and 0 is none.
            distance = frame_id - last if frame_id > last else frame_id + _LAST_GIGE_ID - last
            self.lost += max(0, distance - 1 - skipped)
        self._last_id = frame_id if has_ids else None

    def _require_there(self) -> None:
        if self._camera.IsCameraDeviceRemoved():
            raise CameraUnavailable(
                self._address, f"Camera {self._address!r} is gone: it was unplugged or switched off."
            )

    def _gone(self, error: BaseException) -> CameraUnavailable:
        return CameraUnavailable(self._address, f"Camera {self._address!r} gives no frames: {_reason(error)}")


def _is_feature(node: Any, kinds: Collection[int]) -> bool:
    if not genicam.IsAvailable(node):
        return False
    inner = node.GetNode()
    return bool(
        inner.IsFeature() and inner.GetPrincipalInterfaceType() in kinds and inner.GetVisibility() < genicam.Invisible
    )


def _reason(error: BaseException) -> str:
    """Return what pylon says, without the place in its source."""
    text = str(error).partition(" : ")[0].strip()
    return f"{text.rstrip('.')}."
