from __future__ import annotations

import gc
import itertools
import logging
import math
import queue
import re
import subprocess
import sys
import threading
import time
import warnings
import weakref

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import Counts
from epypes.errors import CameraUnavailable, FrameUnavailable, StillRunning
from tests.transport.peers import wait_until


def gray(value: int) -> np.ndarray:
    return np.full((6, 8), value, np.uint8)


class Fed:
    """A camera that gives what a test puts into it: an image, None, or an exception to raise."""

    def __init__(self, *items):
        self.items = queue.SimpleQueue()
        self.closed = threading.Event()
        for item in items:
            self.items.put(item)

    def read(self):
        self.closed.clear()
        while not self.closed.is_set():
            try:
                item = self.items.get(timeout=0.005)
            except queue.Empty:
                continue
            if isinstance(item, BaseException):
                raise item
            return item
        return None

    def close(self):
        self.closed.set()


class Stuck:
    """A camera whose read hangs until the test lets go; so does its close, if asked for."""

    def __init__(self, close_hangs=False):
        self.close_hangs, self.go = close_hangs, threading.Event()

    def read(self):
        self.go.wait()
        return gray(1)

    def close(self):
        if self.close_hangs:
            self.go.wait()


def frames(acquisition) -> list[int]:
    return [counts.frames for counts in acquisition.counts]


def newest(acquisition) -> tuple:
    """The last frames, also of cameras that fill their rings between asking for the time and asking for a frame."""
    return acquisition.nearest(time.time_ns() + 100_000_000)


# Pairs


def test_the_pair_closest_to_its_time_stamp_is_found():
    left, right = Fed(), Fed()
    times_ns = ([], [])
    with ep.ImageAcquisition(left, right, max_age_s=math.inf) as acquisition:
        # In turns of different length, so that the two cameras are at different places.
        for number, place in enumerate((0, 1, 0, 0, 1, 0, 1, 1, 1), start=1):
            before = frames(acquisition)[place]
            (left, right)[place].items.put(gray(number))
            wait_until(lambda before=before, place=place: len(acquisition.rings[place]) > before)
            times_ns[place].append(acquisition.rings[place].nearest(time.time_ns()).captured_ns)
        for wanted_ns in range(max(times_ns[0][0], times_ns[1][0]), time.time_ns(), 50_000):
            pair = acquisition.nearest(wanted_ns)
            for place, frame in enumerate(pair):
                best_ns = min(times_ns[place], key=lambda time_ns: abs(time_ns - wanted_ns))
                assert frame.captured_ns == best_ns
                assert frame.number == times_ns[place].index(best_ns) + 1


def test_a_request_older_than_the_ring_is_refused_with_the_times():
    began_ns = time.time_ns()
    with ep.ImageAcquisition(gray(1), gray(2)) as acquisition:
        assert acquisition.wait_for_frames(5)
        with pytest.raises(FrameUnavailable, match="Camera 0 keeps nothing of that time") as info:
            acquisition.nearest(began_ns - 10**9)
        assert info.value.requested_ns == began_ns - 10**9
        assert began_ns <= info.value.oldest_ns <= info.value.newest_ns <= time.time_ns()


@pytest.mark.slow
def test_a_camera_that_has_died_never_answers_with_an_old_picture():
    camera = Fed(gray(1))
    with ep.ImageAcquisition(gray(1), camera, max_age_s=0.5) as acquisition:
        assert acquisition.wait_for_frames(5)
        last_ns = acquisition.nearest(time.time_ns())[1].captured_ns
        wait_until(lambda: time.time_ns() > last_ns + 500_000_000)
        with pytest.raises(FrameUnavailable, match=r"Camera 1 has no frame within 0\.5 s.*Does the camera still run\?"):
            acquisition.nearest(time.time_ns())


def test_before_the_first_frame_there_is_none():
    with ep.ImageAcquisition(gray(1), Fed()) as acquisition:
        wait_until(lambda: frames(acquisition)[0])
        now_ns = time.time_ns()
        with pytest.raises(FrameUnavailable, match="Camera 1 has no frame yet"):
            acquisition.nearest(now_ns)


def test_a_camera_never_waits_for_a_request_and_lets_go_of_old_frames():
    alive = weakref.WeakValueDictionary()
    numbers = itertools.count()

    def make():
        image = gray(1)
        alive[next(numbers)] = image
        return image

    with ep.ImageAcquisition(Fresh(make), size=4) as acquisition:
        wait_until(lambda: frames(acquisition)[0] > 2_000)
        first = newest(acquisition)[0]
        number, image = first.number, weakref.ref(first.image)
        del first
        wait_until(lambda: frames(acquisition)[0] > number + 100)
        assert newest(acquisition)[0].number > number
        assert len(acquisition.rings[0]) == 4
        assert len(alive) < 20
        wait_until(lambda: image() is None)


# What is copied


class Fresh:
    """Gives a new array each time, and remembers where it was."""

    def __init__(self, make):
        self.make, self.places = make, set()

    def read(self):
        image = self.make()
        self.places.add(image.__array_interface__["data"][0])
        return image

    def close(self):
        pass


def test_a_buffer_that_is_filled_again_and_again_is_copied():
    buffer = np.zeros((60, 80), np.uint8)

    def refilling():
        for value in itertools.cycle(range(256)):
            buffer[:] = value
            yield buffer

    with ep.ImageAcquisition(ep.camera(refilling(), fps=1_000)) as acquisition:
        assert acquisition.wait_for_frames(5)
        for _ in range(300):
            (frame,) = newest(acquisition)
            assert not np.shares_memory(frame.image, buffer)
            assert len(np.unique(frame.image)) == 1, "no frame is torn"
            assert int(frame.image[0, 0]) == (frame.number - 1) % 256


def test_a_buffer_that_its_camera_locks_and_unlocks_is_copied_too():
    buffer = gray(1)
    buffer.setflags(write=False)
    with ep.ImageAcquisition(Fed(buffer)) as acquisition:
        assert acquisition.wait_for_frames(5)
        (frame,) = acquisition.nearest(time.time_ns())
        buffer.setflags(write=True)
        buffer[:] = 9
        assert np.unique(frame.image).tolist() == [1]


@pytest.mark.parametrize(
    "part", [lambda buffer: buffer[:, ::2], lambda buffer: buffer.T, lambda buffer: np.frombuffer(buffer.data, np.uint8).reshape(6, 8)]
)  # fmt: skip
def test_a_part_of_a_buffer_of_others_is_copied(part):
    buffer = gray(1)
    with ep.ImageAcquisition(Fed(part(buffer))) as acquisition:
        assert acquisition.wait_for_frames(5)
        (frame,) = acquisition.nearest(time.time_ns())
        buffer[:] = 9
        assert np.unique(frame.image).tolist() == [1]
        assert type(frame.image) is np.ndarray


def test_a_new_array_that_nobody_else_knows_is_not_copied():
    camera = Fresh(lambda: np.zeros((6, 8)))
    with ep.ImageAcquisition(ep.camera(camera, fps=100)) as acquisition:
        assert acquisition.wait_for_frames(5)
        (frame,) = newest(acquisition)
        assert frame.image.__array_interface__["data"][0] in camera.places


def test_an_array_of_another_class_becomes_a_plain_one():
    class Tagged(np.ndarray):
        pass

    with ep.ImageAcquisition(ep.camera(Fresh(lambda: gray(1).view(Tagged)), fps=100)) as acquisition:
        assert acquisition.wait_for_frames(5)
        assert type(newest(acquisition)[0].image) is np.ndarray


def test_frames_can_not_be_written_to():
    with ep.ImageAcquisition(gray(1), Fed(gray(2))) as acquisition:
        assert acquisition.wait_for_frames(5)
        for frame in acquisition.nearest(time.time_ns()):
            with pytest.raises(ValueError, match="read-only"):
                frame.image[0, 0] = 1


# Cameras that misbehave


def test_a_camera_that_gives_nothing_once_is_tried_again(caplog):
    camera = Fed(gray(1), CameraUnavailable("mine", "not now"), gray(2))
    errors = queue.SimpleQueue()
    with ep.ImageAcquisition(camera, on_error=lambda *error: errors.put(error)) as acquisition:
        wait_until(lambda: frames(acquisition) == [2])
        assert acquisition.counts == (Counts(frames=2, missed=1, failed=0),)
        assert acquisition.states == ("running",)
    assert errors.empty()
    assert not caplog.records


@pytest.mark.slow
def test_an_outage_is_reported_once_and_survived():
    outage = [CameraUnavailable("mine", f"gone {number}") for number in range(6)]
    errors = queue.SimpleQueue()
    with ep.ImageAcquisition(gray(0), Fed(*outage, gray(1)), on_error=lambda *error: errors.put(error)) as acquisition:
        assert acquisition.wait_for_frames(10)
        assert acquisition.counts[1] == Counts(frames=1, missed=6, failed=0)
    assert errors.get_nowait() == (1, outage[4])
    assert errors.empty()


@pytest.mark.slow
def test_single_misses_add_up_to_no_outage():
    miss = [CameraUnavailable("mine", "not now")] * 4
    errors = queue.SimpleQueue()
    camera = Fed(*miss, gray(1), *miss, gray(2))
    with ep.ImageAcquisition(camera, on_error=lambda *error: errors.put(error)) as acquisition:
        wait_until(lambda: frames(acquisition) == [2])
        assert acquisition.counts[0].missed == 8
    assert errors.empty()


def test_a_stream_that_breaks_off_is_opened_again(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    with ep.ImageAcquisition(f"file://{path}") as acquisition:
        wait_until(lambda: frames(acquisition)[0] > 6)
        assert acquisition.counts[0].missed >= 6
        assert acquisition.states == ("running",)


def test_a_video_without_loop_ends(tmp_path):
    images = [gray(1), gray(2), gray(3)]
    with ep.ImageAcquisition(ep.camera(images, fps=math.inf, loop=False), gray(9)) as acquisition:
        wait_until(lambda: acquisition.states == ("ended", "running") and acquisition.counts[1].frames)
        assert acquisition.counts[0] == Counts(frames=3, missed=0, failed=0)
        assert newest(acquisition)[0].number == 3
    assert acquisition.states == ("ended", "stopped")


@pytest.mark.parametrize("last", [None, ZeroDivisionError()])
def test_a_camera_that_ends_is_closed(last):
    camera = Fed(gray(1), last)
    with ep.ImageAcquisition(camera, on_error=lambda *error: None):
        assert camera.closed.wait(60)


def generator_that_raises(error):
    yield gray(1)
    raise error


@pytest.mark.parametrize("error", [ZeroDivisionError("lens cap"), SystemExit(3), KeyboardInterrupt(), GeneratorExit()])
def test_a_generator_that_raises_is_reported_with_its_index_and_the_others_go_on(error):
    errors = queue.SimpleQueue()
    cameras = (ep.camera(gray(0), fps=200), generator_that_raises(error))
    with ep.ImageAcquisition(*cameras, on_error=lambda *error: errors.put(error)) as acquisition:
        assert errors.get(timeout=60) == (1, error)
        assert acquisition.states == ("running", "failed")
        assert acquisition.counts[1] == Counts(frames=1, missed=0, failed=1)
        seen = frames(acquisition)[0]
        wait_until(lambda: frames(acquisition)[0] > seen + 3)
    assert acquisition.states == ("stopped", "failed")


def test_a_failure_that_nobody_asks_for_is_logged(caplog):
    with ep.ImageAcquisition(generator_that_raises(ZeroDivisionError("lens cap"))) as acquisition:
        wait_until(lambda: acquisition.states == ("failed",))
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("epypes.acquisition", logging.ERROR)
    assert "camera 0: lens cap" in record.getMessage()


def test_an_on_error_that_fails_itself_harms_nobody(caplog):
    def on_error(index, error):
        raise RuntimeError("on top of that")

    with ep.ImageAcquisition(generator_that_raises(ValueError()), gray(1), on_error=on_error) as acquisition:
        wait_until(lambda: acquisition.states[0] == "failed")
        assert acquisition.wait_for_frames(5)
    assert "on_error itself failed" in caplog.text


@pytest.mark.parametrize(
    ("frame", "text"),
    [("left.png", "must give NumPy arrays.*not 'str'"), ((True, gray(1)), "not 'tuple'"), (b"JFIF", "not 'bytes'"),
     (np.zeros(9), r"not float64 \(9,\)"), (np.zeros((0, 4)), "must be"), (np.array([[None]]), "not object")],
)  # fmt: skip
def test_a_frame_that_is_no_image_is_named(frame, text):
    errors = queue.SimpleQueue()
    with ep.ImageAcquisition(Fed(frame), on_error=lambda *error: errors.put(error)) as acquisition:
        index, error = errors.get(timeout=60)
        assert index == 0
        assert re.search(text, str(error))
        wait_until(lambda: acquisition.states == ("failed",))
        assert not acquisition.wait_for_frames(3600), "known at once: none will come"


def test_an_error_of_a_read_that_close_has_ended_is_nobodys_fault():
    class Strict(Fed):
        def read(self):
            super().read()
            raise OSError("the stream was closed under me")

    errors = queue.SimpleQueue()
    acquisition = ep.ImageAcquisition(Strict(), on_error=lambda *error: errors.put(error))
    acquisition.start()
    acquisition.stop()
    assert errors.empty()
    assert acquisition.states == ("stopped",)


def test_a_close_that_raises_is_reported():
    class Broken(Fed):
        def close(self):
            super().close()
            raise OSError("it is jammed")

    errors = queue.SimpleQueue()
    with ep.ImageAcquisition(Broken(gray(1)), on_error=lambda *error: errors.put(error)) as acquisition:
        assert acquisition.wait_for_frames(5)
    assert str(errors.get(timeout=60)[1]) == "it is jammed"


# Start and stop


def test_start_and_stop_come_in_any_order():
    acquisition = ep.ImageAcquisition(gray(1), gray(2))
    acquisition.stop()
    assert acquisition.start() is acquisition
    acquisition.start()
    assert acquisition.is_running
    assert acquisition.wait_for_frames(5)
    acquisition.stop()
    acquisition.stop()
    assert not acquisition.is_running
    assert acquisition.states == ("stopped", "stopped")
    seen = frames(acquisition)
    with acquisition:
        assert acquisition.wait_for_frames(5)
        assert all(now > before for now, before in zip(frames(acquisition), seen, strict=True)), "numbers go on"


def test_stopping_does_not_wait_for_the_next_frame_of_a_slow_camera():
    with ep.ImageAcquisition(ep.camera(gray(1), fps=1 / 3600), ep.camera(gray(1), fps=1 / 3600)) as acquisition:
        assert acquisition.wait_for_frames(5)
    assert acquisition.states == ("stopped", "stopped")


def test_stopping_from_on_error_does_not_wait_for_itself():
    done = threading.Event()

    def on_error(index, error):
        acquisition.stop()
        with pytest.raises(StillRunning):
            acquisition.start()
        done.set()

    acquisition = ep.ImageAcquisition(generator_that_raises(ValueError()), gray(1), on_error=on_error)
    acquisition.start()
    assert done.wait(60)
    acquisition.stop()
    assert not acquisition.is_running


def test_many_threads_start_and_stop_at_once():
    acquisition = ep.ImageAcquisition(ep.camera(gray(1), fps=1_000), ep.camera(gray(1), fps=1_000))
    errors = []

    def storm():
        for _ in range(30):
            try:
                acquisition.start()
                acquisition.stop()
            except StillRunning:  # another thread's stop is under way
                pass
            except BaseException as error:
                errors.append(error)

    threads = [threading.Thread(target=storm) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert errors == []
    acquisition.stop()
    assert acquisition.states == ("stopped", "stopped")
    wait_until(lambda: not [thread for thread in threading.enumerate() if "camera" in thread.name])


@pytest.mark.parametrize("close_hangs", [False, True])
def test_a_camera_whose_read_never_returns_is_named_and_the_others_stop(close_hangs):
    stuck = Stuck(close_hangs)
    acquisition = ep.ImageAcquisition(gray(1), stuck).start()
    with pytest.raises(StillRunning, match=r"did not stop within 0\.05 s: still in 'camera 1'") as info:
        acquisition.stop(0.05)
    assert info.value.functions == ("camera 1",)
    wait_until(lambda: acquisition.states == ("stopped", "running"))
    with pytest.raises(StillRunning, match="camera 1"):
        acquisition.start()
    stuck.go.set()
    acquisition.stop()
    with acquisition:
        assert acquisition.wait_for_frames(5)


def test_waiting_for_frames_ends_in_time():
    with ep.ImageAcquisition(gray(1), Fed()) as acquisition:
        assert acquisition.wait_for_frames(0.01) is False


@pytest.mark.parametrize("given", [{"size": 0}, {"max_age_s": 0}, {"max_age_s": math.nan}])
def test_numbers_that_make_no_sense_are_refused(given):
    with pytest.raises(ValueError, match="0|nan"):
        ep.ImageAcquisition(gray(1), **given)


def test_a_camera_can_not_be_given_twice_but_an_image_can():
    ep.ImageAcquisition(*[gray(1)] * 2)
    for camera in (Fed(), iter([gray(1)])):
        with pytest.raises(ValueError, match="given twice"):
            ep.ImageAcquisition(camera, camera)
    with pytest.raises(ValueError, match="Give one camera or more"):
        ep.ImageAcquisition()


def test_its_repr_is_short():
    assert repr(ep.ImageAcquisition(gray(1), gray(2))) == "<ImageAcquisition stopped: 2 cameras, 0 frames>"


# Left running


@pytest.mark.slow
def test_what_is_left_running_warns_and_its_threads_end():
    acquisition = ep.ImageAcquisition(gray(1), gray(2)).start()
    assert acquisition.wait_for_frames(5)
    threads = [thread for thread in threading.enumerate() if thread.name.startswith("epypes camera")]
    assert len(threads) == 2
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del acquisition
        gc.collect()
    assert [(one.category, str(one.message)[:47]) for one in caught] == [
        (ResourceWarning, "An ImageAcquisition of 2 was left running. Call")
    ]
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()


LEFT_RUNNING = """
import sys, itertools, numpy as np, epypes as ep, threading
path, kind = sys.argv[1:]
def hanging():
    yield np.zeros((4, 4))
    threading.Event().wait()
source = {"busy": lambda: ep.camera(path, fps=float("inf")), "stuck": hanging}[kind]
acquisition = ep.ImageAcquisition(source() if kind == "busy" else source, ep.camera(path, fps=0.001))
acquisition.start()
assert acquisition.wait_for_frames(30)
print("captured")
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["busy", "stuck"])
def test_the_interpreter_exits_although_cameras_run(tmp_path, kind):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50, (640, 480))
    for _ in range(3):
        writer.write(np.zeros((480, 640, 3), np.uint8))
    writer.release()
    command = [sys.executable, "-W", "default", "-c", LEFT_RUNNING, str(path), kind]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "captured\n"), done.stderr
    assert "ResourceWarning: An ImageAcquisition of 2 was left running" in done.stderr
