"""A panel on a camera: the newest frame, settings with controls, one panel per camera."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

import epypes as ep
from epypes.errors import CameraUnavailable, PayloadError, UnknownName
from epypes_widgets import feed, tune

pytestmark = pytest.mark.slow


class Counting:
    """A camera whose frames are numbered by their pixels."""

    def __init__(self):
        self.number, self.closed = 0, 0

    def read(self):
        self.number += 1
        return np.full((4, 6), self.number, np.int64)

    def close(self):
        self.closed += 1


def until(condition, timeout_s: float = 60.0) -> None:
    pause, deadline_s = threading.Event(), time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "it never came to that"
        pause.wait(0.002)


def level(image, offset=10):
    return int(image.max()) + offset


def runner_of(*functions):
    return ep.CompGraphRunner(ep.CompGraph.from_functions(*functions))


@pytest.fixture
def camera(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    with ep.camera("basler:0815-0000") as camera:
        camera.settings.set(PixelFormat="Mono8", OffsetX=0, OffsetY=0, Width=64, Height=48, AcquisitionFrameRate=50.0)
        camera.settings.set(TriggerMode="Off", GainAuto="Off", ExposureTime=10_000)
        yield camera


@pytest.fixture
def tuned():
    """Make panels, which are closed when the test has ended."""
    panels = []

    def make(*arguments, **options):
        panels.append(tune(*arguments, **options))
        return panels[-1]

    yield make
    for panel in panels:
        panel.close()


def test_a_slow_graph_shows_the_newest_frame_and_never_one_that_has_waited():
    source, seen, go = Counting(), [], threading.Event()
    go.set()
    before = threading.enumerate()

    def slow(image, offset=10):
        seen.append(int(image.max()))
        assert go.wait(60)
        return seen[-1] + offset

    panel = tune(runner_of(slow), camera=ep.camera(source, fps=200))
    try:
        until(lambda: len(seen) > 3)
        go.clear()
        held = len(seen)
        until(lambda: len(seen) > held)
        number = source.number
        until(lambda: source.number > number + 20)
        go.set()
        until(lambda: len(seen) > held + 1)
        assert seen[held + 1] > number + 20
        assert seen == sorted(seen)
    finally:
        go.set()
        panel.close()
    assert source.closed
    assert set(threading.enumerate()) <= set(before)


def test_hyperparameters_and_settings_are_one_set_of_values(tuned, camera, tmp_path):
    panel = tuned(runner_of(level), camera=camera, ExposureTime=(100, 50_000))
    assert panel.values.keys() >= {"ExposureTime", "Gain", "PixelFormat", "TriggerMode", "Width", "offset"}
    panel.set(ExposureTime=20_000, PixelFormat="Mono16", offset=3)
    panel.wait(60)
    assert camera.settings["ExposureTime"].value == 20_000
    until(lambda: panel.result["image"].dtype == np.uint16)
    assert panel.runner["offset"] == 3
    assert panel.code() == 'camera.settings.set(ExposureTime=20000, PixelFormat="Mono16")\nrunner.rerun(offset=3)'
    panel.save(tmp_path / "good.toml")
    assert panel.undo()
    panel.wait(60)
    assert camera.settings["PixelFormat"].value == "Mono8"
    assert panel.runner["offset"] == 10
    panel.load(tmp_path / "good.toml")
    panel.wait(60)
    assert camera.settings["PixelFormat"].value == "Mono16"
    with pytest.raises(ValueError, match="ExposureTime"):
        panel["ExposureTime"] = 60_000
    panel.close()
    assert "closed" in repr(camera)


def test_what_the_camera_refuses_is_said_and_its_control_goes_back(tuned, camera):
    panel = tuned([level], camera=camera)
    panel["Width"] = 4096
    panel.wait(60)
    panel["OffsetX"] = 100
    panel.wait(60)
    until(lambda: panel.values["OffsetX"] == 0)
    assert "OffsetX can't be 100. Give a whole number from 0 to 0" in "".join(panel.log)
    camera.settings["GainAuto"] = "Continuous"
    until(lambda: panel.values["GainAuto"] == "Continuous")
    panel.close()


def test_a_camera_is_shown_by_one_panel_at_a_time(tuned, camera):
    first = tuned(runner_of(level), camera=camera)
    second = tuned(runner_of(level), camera=camera)
    until(lambda: "Another panel shows this camera now" in first.error)
    before = second.result
    until(lambda: second.result is not before)
    first["Width"] = 32
    until(lambda: first.values["Width"] == 64)
    assert camera.settings["Width"].value == 64
    first.close()
    before = second.result
    until(lambda: second.result is not before)
    second.close()


def test_a_camera_that_gives_no_frame_is_no_panel_and_is_closed(camera, monkeypatch):
    monkeypatch.setattr(feed, "_FIRST_FRAME_S", 0.2)
    camera.settings.set(TriggerMode="On", TriggerSource="Software")
    with pytest.raises(CameraUnavailable, match="no frame of its camera.*set its TriggerMode to Off"):
        tune(runner_of(level), camera=camera)
    assert "closed" in repr(camera)
    camera.settings["TriggerMode"] = "Off"


def test_what_can_not_be_shown_is_refused_with_a_way_out(camera):
    def both(left, right, offset=1):
        return left + right + offset

    with pytest.raises(PayloadError, match="A camera feeds the one free source token.*left, right"):
        tune(runner_of(both), camera=camera)
    with pytest.raises(UnknownName, match="No setting 'GainRaw' of this camera"):
        tune(runner_of(level), camera=Counting(), GainRaw=(0, 3))
    with pytest.raises(UnknownName, match="No setting or hyperparameter 'ExposureTme'.*Did you mean 'ExposureTime'"):
        tune(runner_of(level), camera=camera, ExposureTme=(100, 200))
    with pytest.raises(ValueError, match="hint .* of the setting 'Width' does not fit its value, 64") as info:
        tune(runner_of(level), camera=camera, Width=(100, 200))
    assert "closed" in repr(camera)
    # A notebook keeps the traceback too.
    assert info.tb is not None
    tune(runner_of(level), camera=camera, Width=(32, 200)).close()
    with pytest.raises(ValueError, match="A camera takes the place of images and cases"):
        tune(runner_of(level), camera=camera, images=[np.zeros((2, 2))])
