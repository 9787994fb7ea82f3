"""A camera that feeds a panel: its newest frame, and its settings as hyperparameters of their own.

The camera is read on a thread of ``ImageAcquisition``. The panel's thread takes the newest frame when it has time, so
none waits; it also writes the settings, so a slider that is dragged never waits for the camera.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import Any, Final
from weakref import WeakValueDictionary

from epypes.acquisition import ImageAcquisition, camera
from epypes.acquisition.camera_settings import CameraSetting
from epypes.acquisition.frames import Frame, with_images
from epypes.errors import CameraUnavailable, InvalidValue, PayloadError, UnknownName
from epypes.hints import Param, as_param
from epypes.run import CompGraphRunner

# The settings that get a control, as far as the camera has them; older cameras call some of them otherwise.
SETTINGS: Final = (
    *("ExposureAuto", "ExposureTime", "ExposureTimeAbs", "GainAuto", "Gain", "GainRaw", "BlackLevel", "Gamma"),
    *("TriggerMode", "TriggerSource", "AcquisitionFrameRateEnable", "AcquisitionFrameRate"),
    *("PixelFormat", "Width", "Height", "OffsetX", "OffsetY"),
)
_FIRST_FRAME_S: Final = 10.0
# The camera may change settings by itself, as the exposure time, and so may a cell.
_READ_AGAIN_S: Final = 1.0
# A range over more than this has a logarithmic slider.
_LOG_FROM: Final = 1_000
# By the camera: a cell that is run again makes another panel, which takes the camera over.
_feeds: WeakValueDictionary[object, CameraFeed] = WeakValueDictionary()


class CameraFeed:
    """The newest frame of a camera for the one free source token of a runner.

    Parameters
    ----------
    runner
        Its graph says which token, and the order of its colours.
    source
        A camera, or what ``ep.camera`` makes one of.
    hints
        Ranges of settings, narrower than the camera's.

    Attributes
    ----------
    camera
        The camera.
    values, first
        The settings that have a control: their values now, and as they were.

    Raises
    ------
    PayloadError
        The graph has not one free source token.
    UnknownName, ValueError
        A hint is for no setting of the camera, or does not fit its value.
    """

    def __init__(self, runner: object, source: Any, hints: Mapping[str, Any]) -> None:
        if not isinstance(runner, CompGraphRunner) or len(runner.free_source_tokens) != 1:
            free = getattr(runner, "free_source_tokens", ())
            text = "A camera feeds the one free source token of a runner's graph."
            raise PayloadError(free, f"{text} Here these are free: {', '.join(free) or 'none'}.")
        key = source if isinstance(source, str) else id(source)
        before = _feeds.get(key)
        if before is not None:
            before.close()
        self.camera: Any = camera(source)
        self._cg, self._token = runner.cg, runner.free_source_tokens[0]
        self._settings = getattr(self.camera, "settings", {})
        self._is_closed, self._error, self._read_s = False, "", time.monotonic()
        self._changed: Callable[[], object] = lambda: None
        self._newest: Frame | None = None
        with ExitStack() as undone:
            undone.callback(self.camera.close)
            names = [name for name in SETTINGS if name in self._settings and name not in runner.hyperparameters]
            read = [setting for setting in map(self._settings.__getitem__, names) if setting.value is not None]
            self.values = {setting.name: setting.value for setting in read}
            self.first: Mapping[str, Any] = dict(self.values)
            for name in hints:
                if name not in self.values:
                    raise UnknownName("setting", name, self.values, "of this camera")
            self._params = {setting.name: _param(setting, hints.get(setting.name)) for setting in read}
            self._acquisition = ImageAcquisition(
                self.camera, size=1, on_error=self._failed, on_frame=self._arrived
            ).start()
            undone.pop_all()
        # Last: one that has failed, which a traceback keeps, has no camera that could be taken over.
        _feeds[key] = self

    @property
    def controlled(self) -> dict[str, tuple[Any, Param]]:
        """The values of the settings, and what they may be."""
        return {name: (value, self._params[name]) for name, value in self.values.items()}

    @property
    def notice(self) -> str:
        """Why there are no new frames; empty if there are."""
        return "" if self._acquisition.states == ("running",) else self._error

    def follow(self, changed: Callable[[], object]) -> None:
        """Call something with each new frame and each failure, on the camera's thread."""
        self._changed = changed

    def payload(self) -> Mapping[str, Any]:
        """Return the newest frame by its token.

        Raises
        ------
        CameraUnavailable
            There was none within ten seconds.
        """
        if self._newest is None and not self._acquisition.wait_for_frames(_FIRST_FRAME_S):
            text = self._error or "It gave no frame within 10 s. If it waits for a trigger, set its TriggerMode to Off."
            raise CameraUnavailable("The camera", f"The panel has no frame of its camera. {text}")
        return with_images({self._token: self._newest}, self._cg)

    def write(self, values: Mapping[str, Any]) -> list[str]:
        """Set settings on the camera; return a sentence for each that it refuses."""
        if self._is_closed:
            # No frame comes that the controls would go back with.
            self._changed()
            return [self._error]
        refused = []
        for name, value in values.items():
            try:
                self._settings[name] = value
                self.values[name] = value
            except (CameraUnavailable, InvalidValue, UnknownName) as error:
                refused.append(str(error))
        self._read_s = -math.inf  # one setting may change others
        return refused

    def read_again(self) -> None:
        """Read the settings from time to time."""
        if self._is_closed or time.monotonic() - self._read_s < _READ_AGAIN_S:
            return
        self._read_s = time.monotonic()
        with suppress(CameraUnavailable):
            for name, value in list(self.values.items()):
                now = None
                # A camera may lock or hide settings in another mode.
                with suppress(InvalidValue, UnknownName):
                    now = self._settings[name].value
                if now is not None and now != value:
                    self.values[name] = now

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop to read, and close the camera; its settings stay as they are, since another panel may have it now."""
        self._is_closed, self._error = True, "Another panel shows this camera now."
        self._changed()
        self._acquisition.stop(timeout_s)

    def _arrived(self, _index: int, frame: Frame) -> None:
        self._newest = frame
        self._changed()

    def _failed(self, _index: int, error: BaseException) -> None:
        self._error = str(error)
        self._changed()


def _param(setting: CameraSetting, hint: Any) -> Param:
    """Return the values that a setting may take: its hint, else what the camera says."""
    about, unit = setting.about, setting.unit
    if hint is not None:
        param = as_param(hint)
        if not isinstance(param, Param) or not param.allows(setting.value):
            text = f"The hint {hint!r:.60} of the setting {setting.name!r} does not fit"
            raise InvalidValue(f"{text} its value, {setting.value!r:.40}. Give a range that has it: (low, high).")
        return param
    if setting.kind in ("bool", "choice"):
        return Param(choices=setting.choices or (False, True), about=about)
    low, high = setting.low, setting.high
    is_log = setting.kind == "float" and low is not None and high is not None and 0 < low * _LOG_FROM < high
    return Param(low, high, setting.step if setting.kind == "int" else None, log=is_log, unit=unit, about=about)
