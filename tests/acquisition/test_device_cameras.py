"""Cameras with a node map: pylon's emulation in this process, and Aravis' fake camera of GigE Vision in another."""

from __future__ import annotations

import itertools
import os
import queue
import signal
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import psutil
import pytest

import epypes as ep
from epypes.acquisition import find_cameras
from epypes.acquisition.pixel_formats import to_image
from epypes.errors import CameraUnavailable, MissingPackage
from tests.fake_camera import FakeCamera
from tests.ipython_cells import run_cells
from tests.transport.peers import wait_until

pytestmark = pytest.mark.slow

BASLER, GENICAM = "basler:0815-0001", "genicam:EP01"
EXPOSURE = {BASLER: "ExposureTime", GENICAM: "ExposureTimeAbs"}
SMALL = {"PixelFormat": "Mono8", "Width": 96, "Height": 64}


@pytest.fixture(scope="module", autouse=True)
def emulated():
    """Two cameras of pylon's emulation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYLON_CAMEMU", "2")
        yield patch


@pytest.fixture(scope="module")
def fake():
    with FakeCamera("EP01") as fake:
        yield fake


@pytest.fixture(params=[BASLER, GENICAM])
def camera(request, fake):
    with ep.camera(request.param) as camera:
        camera.settings.set(**SMALL, AcquisitionFrameRate=100.0, TriggerMode="Off")
        yield camera


# Settings


def test_a_setting_has_its_value_range_unit_and_choices(camera):
    exposure = camera.settings[EXPOSURE[camera.address]]
    assert (exposure.kind, exposure.is_writable) == ("float", True)
    assert 0 < exposure.low < exposure.value < exposure.high
    width = camera.settings["Width"]
    assert (width.kind, width.value, width.low) == ("int", 96, 1)
    assert camera.settings["TriggerMode"].choices == ("Off", "On")
    assert not camera.settings["PayloadSize" if camera.address == GENICAM else "PixelSize"].is_writable
    assert {"Width", "PixelFormat", "TriggerSource", "AcquisitionFrameRate"} <= set(camera.settings)
    assert "WidthRegister" not in camera.settings, "what stands behind a setting is none"


def test_settings_change_while_the_camera_streams_and_the_pixel_format_too(camera):
    assert camera.read().dtype == np.uint8
    name = EXPOSURE[camera.address]
    camera.settings[name] = 20_000
    assert camera.settings[name].value == 20_000
    camera.settings["PixelFormat"] = "Mono16"
    assert camera.read().dtype == np.uint16
    camera.settings.set(Width=48, PixelFormat="RGB8" if camera.address == GENICAM else "RGB8Packed")
    assert camera.read().shape == (64, 48, 3)


def test_what_a_setting_can_not_be_is_refused_with_its_range(camera):
    name = EXPOSURE[camera.address]
    for value in (-1.0, 1e12, "long", True, None):
        with pytest.raises(ValueError, match=rf"{name} can't be {value!r}.*Give a number from 10? to 10,000,000"):
            camera.settings[name] = value
    with pytest.raises(ValueError, match=r"Width can't be 2\.5\. Give a whole number from 1 to"):
        camera.settings["Width"] = 2.5
    with pytest.raises(ValueError, match=r"PixelFormat can't be 'Mono9'\. Give one of .*Mono8"):
        camera.settings["PixelFormat"] = "Mono9"
    with pytest.raises(KeyError, match=r"No setting 'Widht' of this camera\. Did you mean 'Width'\?"):
        camera.settings["Widht"] = 3
    with pytest.raises(KeyError, match=r"No command 'Width' of this camera\. There are: .*TriggerSoftware"):
        camera.settings.execute("Width")
    with pytest.raises(KeyError, match=r"No command 'TriggerSoft' of this camera\. Did you mean 'TriggerSoftware'"):
        camera.settings.execute("TriggerSoft")
    assert camera.read().shape == (64, 96)


def test_a_longer_exposure_makes_brighter_frames(fake):
    with ep.camera(GENICAM) as camera:
        camera.settings.set(**SMALL, ExposureTimeAbs=3_000.0)
        dark = camera.read().mean()
        camera.settings["ExposureTimeAbs"] = 30_000.0
        wait_until(lambda: camera.read().mean() > dark + 50)


def test_a_mode_that_another_setting_locks_is_named():
    with (
        ep.camera(BASLER) as camera,
        pytest.raises(ValueError, match="PixelSize is 'Bpp8' and can't be set to 'Bpp16' now: the camera has locked"),
    ):
        camera.settings["PixelSize"] = "Bpp16"


# Frames


def test_frames_have_the_numbers_and_ticks_of_the_camera_apart_from_the_time_of_the_host(fake):
    with ep.camera(GENICAM) as camera:
        camera.settings.set(**SMALL, AcquisitionFrameRate=50.0)
        before_ns = time.time_ns()
        first, second, third = itertools.islice(camera, 3)
        assert [first.number, second.number, third.number] == [0, 1, 2]
        assert first.frame_id < second.frame_id < third.frame_id
        assert camera.tick_hz == 10**9
        assert 0 < third.ticks - first.ticks < 60 * camera.tick_hz
        assert before_ns <= first.captured_ns <= third.captured_ns <= time.time_ns()
        with ep.ImageAcquisition(camera) as acquisition:
            assert acquisition.wait_for_frames(60)
            (frame,) = acquisition.nearest(time.time_ns())
        assert frame.ticks > third.ticks
        assert frame.number >= 1


def test_a_camera_that_stamps_nothing_has_no_ticks():
    with ep.camera(BASLER) as camera:
        frame = camera.read_frame()
        assert (frame.ticks, camera.tick_hz) == (None, None)
        assert frame.frame_id is not None


def test_incomplete_frames_are_counted_and_never_given():
    with ep.camera(BASLER) as camera:
        camera.settings.set(**SMALL, ForceFailedBufferCount=3, AcquisitionFrameRate=10.0)
        camera.settings.execute("ForceFailedBuffer")
        frames = list(itertools.islice(camera, 5))
        assert [frame.image.shape for frame in frames] == [(64, 96)] * 5
        # Of frames that come while the reader is slow, the newest is given.
        assert camera.counts.incomplete + camera.counts.skipped >= 3
        assert 0 < camera.counts.incomplete <= 3
        assert camera.counts.lost == 0


def test_frames_whose_packets_are_lost_are_counted_and_never_given(fake):
    fake.kill()
    fake.start("--gvsp-lost-ratio=300")
    try:
        with ep.camera(GENICAM) as camera:
            camera.settings["AcquisitionFrameRate"] = 100.0
            wait_until(lambda: camera.read().shape == (512, 512) and camera.counts.incomplete + camera.counts.lost > 0)
    finally:
        fake.kill()
        fake.start()


def test_a_reader_that_is_slow_gets_the_newest_frame(camera):
    first = camera.read_frame()
    counts = camera.counts
    late = threading.Event()
    while not late.wait(0.5) and camera.counts == counts:
        second = camera.read_frame()
        assert second.frame_id - first.frame_id > 10
        third = camera.read_frame()
        assert third.frame_id - second.frame_id < second.frame_id - first.frame_id
    assert camera.counts.skipped >= 10


def test_frames_beyond_the_pace_that_was_asked_for_are_left_out(fake):
    with ep.camera(GENICAM, fps=5) as camera:
        camera.settings.set(**SMALL, AcquisitionFrameRate=100.0)
        frames = list(itertools.islice(camera, 3))
        assert frames[2].captured_ns - frames[0].captured_ns >= 380_000_000
        assert camera.counts.skipped >= 20


@pytest.mark.parametrize(("cell", "rows"), [("RG", "RGGB"), ("GR", "GRBG"), ("GB", "GBRG"), ("BG", "BGGR")])
def test_the_mosaic_of_a_bayer_format_becomes_bgr(cell, rows):
    colours = {"B": 10, "G": 100, "R": 200}
    mosaic = np.tile(np.array([colours[colour] for colour in rows], np.uint16).reshape(2, 2), (8, 8))
    for bits, dtype in (("8", np.uint8), ("12", np.uint16)):
        image = to_image(f"Bayer{cell}{bits}")(mosaic.astype(dtype))
        assert image.dtype == dtype
        assert image[8, 8].tolist() == [10, 100, 200]


def test_colours_become_bgr_and_other_formats_name_those_that_work():
    rgb = np.full((2, 2, 3), (200, 100, 10), np.uint8)
    assert to_image("RGB8Packed")(rgb)[0, 0].tolist() == [10, 100, 200]
    assert to_image("BGR8")(rgb) is rgb
    uyvy = np.zeros((2, 4, 2), np.uint8)
    uyvy[..., 0], uyvy[..., 1] = 128, 150
    gray = cv2.cvtColor(uyvy, cv2.COLOR_YUV2BGR_UYVY)[0, 0].tolist()
    assert to_image("YUV422Packed")(uyvy)[0, 0].tolist() == gray
    assert to_image("YUV422_8")(uyvy[..., ::-1].copy())[0, 0].tolist() == gray
    with ep.camera(BASLER) as camera:
        camera.settings["PixelFormat"] = "RGB16Packed"
        with pytest.raises(ValueError, match=r"format 'RGB16Packed' can't be read\. Set one that works: Mono8"):
            camera.read()
        camera.settings["PixelFormat"] = "Mono8"
        assert camera.read().ndim == 2


# Trigger, and the end


def test_a_read_waits_for_its_trigger_and_closing_ends_it(camera):
    camera.settings.set(TriggerSource="Software", TriggerMode="On")
    frames = queue.SimpleQueue()
    reading = threading.Thread(target=lambda: [frames.put(camera.read()) for _ in range(2)])
    reading.start()
    with pytest.raises(queue.Empty):
        frames.get(timeout=0.5)
    camera.trigger()
    assert frames.get(timeout=60).shape == (64, 96)
    closing = [threading.Thread(target=camera.close) for _ in range(2)]
    for thread in closing:
        thread.start()
    for thread in (*closing, reading):
        thread.join(60)
        assert not thread.is_alive()
    assert frames.get(timeout=60) is None
    camera.settings["TriggerMode"] = "Off"
    assert camera.read().shape == (64, 96), "a closed camera is opened again, with its settings"


def test_ctrl_c_ends_a_read_that_waits_for_a_trigger():
    code = (
        "import epypes as ep\n"
        f"camera = ep.camera({BASLER!r})\n"
        "camera.settings.set(TriggerSource='Software', TriggerMode='On')\n"
        "print('waiting', flush=True)\n"
        "camera.read()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "waiting\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in errors
    assert process.returncode == -signal.SIGINT


def test_the_handler_of_a_signal_closes_the_camera_that_its_thread_reads(camera):
    camera.settings.set(TriggerSource="Software", TriggerMode="On")
    before = signal.signal(signal.SIGUSR1, lambda *_: camera.close())
    try:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGUSR1)).start()
        assert camera.read() is None
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert "closed" in repr(camera)
    camera.settings["TriggerMode"] = "Off"


def cycle(address: str, count: int) -> psutil.Process:
    for _ in range(count):
        with ep.camera(address) as camera:
            camera.settings.set(**SMALL)
            assert camera.read() is not None
    return psutil.Process()


@pytest.mark.parametrize("address", [BASLER, GENICAM])
def test_opening_and_closing_leaves_no_thread_and_no_file_open(address, fake):
    before = (process := cycle(address, 2)).num_threads(), process.num_fds()
    after = (process := cycle(address, 3)).num_threads(), process.num_fds()
    assert after <= before


@pytest.mark.soak
@pytest.mark.parametrize("address", [BASLER, GENICAM])
def test_opening_and_closing_two_hundred_times_takes_no_memory(address, fake):
    before = cycle(address, 50).memory_info().rss
    # Measured: 0.2 MB, and 0.7 MB after a thousand times; 38 kB each time would be a device of pylon that is made anew.
    assert cycle(address, 200).memory_info().rss - before < 2_000_000


# Cameras that are not there


def test_a_wrong_serial_number_is_told_with_those_that_are_there(fake):
    with pytest.raises(
        CameraUnavailable, match=r"no camera 'basler:7'\. There are: basler:0815-0000, basler:0815-0001"
    ):
        ep.camera("basler:7")
    with pytest.raises(CameraUnavailable, match=r"no camera 'genicam:7'\. There are: genicam:EP01\."):
        ep.camera("genicam:7")
    with pytest.raises(CameraUnavailable, match="'basler:' is more than one. There are: basler:0815-0000"):
        ep.camera("basler:")
    with ep.camera("genicam:") as only:
        assert only.read() is not None


def test_a_device_belongs_to_the_camera_that_opened_it_until_that_is_closed(camera):
    opened_at = f"'{camera.address}' is open already, by line [0-9]+ of test_device_cameras.py"
    for frame in camera:
        with pytest.raises(CameraUnavailable, match=rf"{opened_at}\. End the loop"):
            ep.camera(camera.address)
        if frame.number:
            break
    with pytest.raises(CameraUnavailable, match=rf"{opened_at}\. Close that camera first"):
        ep.camera(camera.address)
    camera.close()
    with ep.camera(camera.address) as other:
        with ep.ImageAcquisition(other) as acquisition:
            assert acquisition.wait_for_frames(60)
            with pytest.raises(CameraUnavailable, match=rf"{opened_at}\. End .* the acquisition"):
                camera.read()
        assert other.read() is not None
    assert camera.read() is not None


def test_a_cell_that_is_run_again_has_its_camera_again(emulated):
    opening = f"camera = ep.camera({BASLER!r}, fps=20)\nprint(camera.read().shape)"
    looping = f"for frame in camera:\n    ep.camera({BASLER!r})"
    first, again, stopped, twice, last = run_cells(
        f"import epypes as ep\n{opening}", opening, looping, f"{opening}\n{opening}", opening
    )
    assert all(cell.succeeded and "(1040, 1024)" in cell.text for cell in (first, again, last))
    assert f"'{BASLER}' is open already, by line 1 of Cell In[2]. End the loop" in stopped.text
    assert f"'{BASLER}' is open already, by line 1 of Cell In[4]. Close that camera" in twice.text


def test_a_camera_that_is_dropped_is_closed(fake):
    for address in (BASLER, GENICAM):
        ep.camera(address).read()
        assert [found.is_free for found in find_cameras()[0] if found.address == address] == [True]


def test_a_camera_that_another_process_holds_is_told_so(fake):
    code = f"import epypes as ep; camera = ep.camera({GENICAM!r}); print('holds', flush=True); input()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "holds\n"
        with pytest.raises(CameraUnavailable, match=r"'genicam:EP01' is held: another program has it\. Close it"):
            ep.camera(GENICAM)
        assert [found.is_free for found in find_cameras()[0] if found.serial == "EP01"] == [False]
        other.communicate("\n", timeout=60)
    with ep.camera(GENICAM) as camera:
        assert camera.read() is not None


def test_a_camera_that_is_unplugged_is_told_and_goes_on_when_it_is_back(fake):
    camera = ep.camera(GENICAM)
    camera.settings.set(**SMALL, AcquisitionFrameRate=100.0, TriggerSelector="FrameStart", TriggerMode="Off")
    errors = queue.SimpleQueue()
    with ep.ImageAcquisition(camera, on_error=lambda *error: errors.put(error)) as acquisition:
        assert acquisition.wait_for_frames(60)
        fake.kill()
        index, error = errors.get(timeout=60)
        assert index == 0
        assert error.is_gone
        assert "'genicam:EP01' does not answer: it was unplugged" in str(error)
        assert acquisition.states == ("unavailable",)
        with pytest.raises(CameraUnavailable):
            camera.settings["ExposureTimeAbs"] = 1_000.0
        seen = acquisition.counts[0].frames
        fake.start()
        wait_until(lambda: acquisition.counts[0].frames > seen)
        assert acquisition.states == ("running",)
        assert acquisition.nearest(time.time_ns())[0].image.shape == (64, 96)
        assert camera.settings["AcquisitionFrameRate"].value == pytest.approx(100.0)
        assert camera.counts.outages == 1
        # Off and on again before it is missed: it answers, but is not controlled by this process any more.
        fake.kill()
        fake.start()
        _, error = errors.get(timeout=60)
        assert error.is_gone
        wait_until(lambda: acquisition.states == ("running",))
    assert errors.empty()
    camera.close()


def test_an_emulated_camera_that_is_removed_and_comes_back_has_its_settings(emulated):
    camera = ep.camera(BASLER)
    camera.settings.set(**SMALL, TriggerSelector="FrameBurstStart")
    camera.settings.set(TriggerActivation="FallingEdge", TriggerSelector="FrameStart")
    camera.settings["ExposureTime"] = 1_234.0
    camera.close()
    emulated.setenv("PYLON_CAMEMU", "1")
    try:
        with pytest.raises(CameraUnavailable, match=r"There are: basler:0815-0000\.") as info:
            camera.read()
        assert info.value.is_gone
    finally:
        emulated.setenv("PYLON_CAMEMU", "2")
    assert camera.read().shape == (64, 96)
    assert camera.settings["ExposureTime"].value == 1_234.0
    assert camera.settings["TriggerSelector"].value == "FrameStart"
    camera.close()


# Where cameras are taken


def test_a_graph_runs_on_many_frames_of_a_camera(camera):
    def columns(image):
        return image.shape[1]

    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(columns))
    table = ep.map(runner, itertools.islice(camera, 4)).to_frame()
    assert table["frame"].tolist() == [0, 1, 2, 3]
    assert table["columns"].tolist() == [96] * 4


@pytest.mark.parametrize("layout", ["one", "three"])
def test_the_experiment_runs_on_two_cameras(layout):
    from epypes.experiment import run_experiment

    cameras = ["basler:0815-0000", "basler:0815-0001"]
    results = run_experiment(layout, requests=3, experiments=1, cameras=cameras)
    assert len(results.table) == 3


# The command


def test_the_command_lists_cameras_and_whether_they_are_free(fake, capsys):
    import json

    from epypes.cli import main

    with ep.camera(GENICAM), pytest.raises(SystemExit) as end:
        main(["cameras", "--json"])
    assert not end.value.code
    told = json.loads(capsys.readouterr().out)
    assert told["missing"] == []
    states = {each["address"]: each["is_free"] for each in told["cameras"] if each["kind"] != "device"}
    assert states == {"basler:0815-0000": True, "basler:0815-0001": True, "genicam:EP01": False}
    with pytest.raises(SystemExit):
        main(["cameras"])
    assert "genicam:EP01" in capsys.readouterr().out


def test_without_the_libraries_it_says_what_would_be_looked_for(monkeypatch, capsys):
    from epypes.cli import main

    for name in ("pypylon", "viva_genicam"):
        monkeypatch.setitem(sys.modules, name, None)
    for name in ("epypes.acquisition.basler", "epypes.acquisition.genicam"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(MissingPackage, match=r"pypylon.*epypes\[basler\]"):
        ep.camera(BASLER)
    with pytest.raises(SystemExit) as end:
        main(["cameras"])
    assert not end.value.code
    printed = " ".join(capsys.readouterr().out.split())
    assert "epypes[basler]" in printed
    assert "epypes[genicam]" in printed
