from __future__ import annotations

import itertools
import math
import threading
import time

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import Camera, read_image, write_image
from epypes.errors import CameraUnavailable, ImageFileError

GRAY = np.arange(48, dtype=np.uint8).reshape(6, 8)


def gray(value: int) -> np.ndarray:
    return np.full((6, 8), value, np.uint8)


def values(camera: Camera, count: int) -> list[int | None]:
    """What the first pixels of the next frames are."""
    frames = [camera.read() for _ in range(count)]
    return [None if frame is None else int(frame.flat[0]) for frame in frames]


@pytest.fixture
def video(tmp_path):
    """Five frames that can be told apart by their brightness: 0, 50, 100, 150, 200."""
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50, (64, 48))
    for place in range(5):
        writer.write(np.full((48, 64, 3), 50 * place, np.uint8))
    writer.release()
    return path


def places(camera: Camera, count: int) -> list[int | None]:
    """Which frames of the video come next."""
    return [None if value is None else round(value / 50) for value in values(camera, count)]


# Files and arrays


def test_an_image_file_comes_again_and_again(tmp_path):
    write_image(tmp_path / "a.png", GRAY)
    camera = ep.camera(tmp_path / "a.png", fps=math.inf)
    assert all(np.array_equal(camera.read(), GRAY) for _ in range(3))


def test_files_keep_their_channels_and_the_order_of_their_colours(tmp_path):
    red = np.zeros((4, 5, 3), np.uint16)
    red[..., 2] = 700
    write_image(tmp_path / "red.png", red)
    frame = ep.camera(str(tmp_path / "red.png")).read()
    assert np.array_equal(frame, read_image(tmp_path / "red.png"))
    assert frame[0, 0].tolist() == [0, 0, 700]
    write_image(tmp_path / "gray.png", GRAY)
    assert ep.camera(tmp_path / "gray.png").read().shape == (6, 8)


def test_an_array_is_taken_as_it_is_now():
    image = gray(1)
    camera = ep.camera(image, fps=math.inf)
    image[:] = 9
    assert values(camera, 2) == [1, 1]


def test_without_loop_an_image_comes_once_and_again_after_closing():
    camera = ep.camera(gray(4), fps=math.inf, loop=False)
    assert values(camera, 3) == [4, None, None]
    camera.close()
    assert values(camera, 1) == [4]


def test_a_folder_gives_its_images_in_natural_order(tmp_path):
    for number in (10, 2, 1, 100):
        write_image(tmp_path / f"img{number}.png", gray(number))
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / ".img0.png").write_bytes(b"of the system")
    (tmp_path / "old.png").mkdir()
    assert values(ep.camera(tmp_path, fps=math.inf), 6) == [1, 2, 10, 100, 1, 2]
    assert values(ep.camera(tmp_path, fps=math.inf, loop=False), 5) == [1, 2, 10, 100, None]


def test_a_folder_begins_anew_after_closing(tmp_path):
    for number in (1, 2, 3):
        write_image(tmp_path / f"{number}.png", gray(number))
    camera = ep.camera(tmp_path, fps=math.inf)
    assert values(camera, 2) == [1, 2]
    camera.close()
    assert values(camera, 2) == [1, 2]


def test_a_folder_without_images_is_named(tmp_path):
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(ImageFileError, match="There are no images in folder") as info:
        ep.camera(tmp_path)
    assert info.value.path == str(tmp_path)


def test_a_broken_image_in_a_folder_is_named_when_its_turn_comes(tmp_path, capfd):
    write_image(tmp_path / "1.png", GRAY)
    (tmp_path / "2.png").write_bytes(b"not an image")
    camera = ep.camera(tmp_path, fps=math.inf)
    assert np.array_equal(camera.read(), GRAY)
    with pytest.raises(ImageFileError, match=r"2\.png' is not an image") as info:
        camera.read()
    assert info.value.path == str(tmp_path / "2.png")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("address", ["basler", "Basler:1", "gige:123"])
def test_what_is_neither_a_file_nor_an_address_lists_the_addresses(address):
    with pytest.raises(ImageFileError, match="no such camera. Write basler:SERIAL, genicam:SERIAL, .*`epypes cameras`"):
        ep.camera(address)


def test_a_video_device_that_is_not_there_is_no_missing_image():
    with pytest.raises(CameraUnavailable, match="/dev/video4711 can't be opened"):
        ep.camera("/dev/video4711")


def test_an_image_that_vanishes_is_named_when_its_turn_comes(tmp_path):
    for number in (1, 2):
        write_image(tmp_path / f"{number}.png", gray(number))
    camera = ep.camera(tmp_path, fps=math.inf)
    (tmp_path / "2.png").unlink()
    assert values(camera, 1) == [1]
    with pytest.raises(ImageFileError, match=r"2\.png' can't be read"):
        camera.read()


@pytest.mark.parametrize("content", [None, b"", b"neither"])
def test_a_file_that_is_neither_image_nor_video_is_named(tmp_path, content, capfd):
    path = tmp_path / "x.dat"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageFileError, match=r"x\.dat"):
        ep.camera(path)
    assert capfd.readouterr() == ("", "")


# Videos and captures


def test_a_video_gives_its_frames_and_begins_anew(video):
    camera = ep.camera(video, fps=math.inf)
    assert places(camera, 12) == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]
    camera.close()
    assert places(camera, 2) == [0, 1]
    camera.close()


def test_a_video_ends_without_loop(video):
    camera = ep.camera(video, fps=math.inf, loop=False)
    assert places(camera, 7) == [0, 1, 2, 3, 4, None, None]


def test_a_video_that_vanishes_is_named(video):
    camera = ep.camera(video, fps=math.inf)
    assert places(camera, 5) == [0, 1, 2, 3, 4]
    video.unlink()
    with pytest.raises(ImageFileError, match=r"film\.avi"):
        camera.read()


def test_a_video_has_the_pace_it_was_recorded_with(video):
    camera = ep.camera(video)
    began_s = time.monotonic()
    assert places(camera, 5) == [0, 1, 2, 3, 4]
    assert time.monotonic() - began_s >= 0.079, "four periods of 20 ms"


@pytest.mark.parametrize("loop", [True, False])
def test_a_capture_that_was_given_is_read_on_and_never_released(video, loop):
    capture = cv2.VideoCapture(str(video))
    capture.grab()
    camera = ep.camera(capture, fps=math.inf, loop=loop)
    assert places(camera, 2) == [1, 2]
    camera.close()
    assert capture.isOpened()
    assert places(camera, 4) == ([3, 4, 0, 1] if loop else [3, 4, None, None])
    capture.release()


def test_a_capture_that_is_not_open_is_refused():
    with pytest.raises(CameraUnavailable, match="is not open"):
        ep.camera(cv2.VideoCapture())


def test_a_function_may_open_the_capture_and_opens_it_again_after_closing(video):
    opened = []

    def open_camera():
        opened.append(cv2.VideoCapture(str(video)))
        return opened[-1]

    camera = ep.camera(open_camera, fps=math.inf)
    assert places(camera, 6) == [0, 1, 2, 3, 4, 0]
    assert [capture.isOpened() for capture in opened] == [False, True]
    camera.close()
    assert not opened[-1].isOpened()


def test_a_stream_that_breaks_off_is_tried_again_and_then_opened_anew(video):
    camera = ep.camera(f"file://{video}")
    assert places(camera, 5) == [0, 1, 2, 3, 4]
    for _ in range(3):
        with pytest.raises(CameraUnavailable, match="gave no frame"):
            camera.read()
    assert places(camera, 2) == [0, 1]
    camera.close()
    assert places(camera, 1) == [0], "closed devices are opened again"
    camera.close()


def test_a_device_that_is_unplugged_and_plugged_in_again_goes_on(video):
    camera = ep.camera(f"file://{video}")
    assert places(camera, 5) == [0, 1, 2, 3, 4]
    unplugged = video.rename(video.with_suffix(".gone"))
    texts = []
    for _ in range(6):
        with pytest.raises(CameraUnavailable) as info:
            camera.read()
        texts.append(str(info.value))
    assert [f"Camera file://{video} {end}" in text for text, end in zip(texts, ["gave no frame"] * 3 + ["can't be opened"] * 3, strict=True)] == [True] * 6  # fmt: skip
    unplugged.rename(video)
    assert places(camera, 2) == [0, 1]
    camera.close()


def test_frames_of_a_device_that_are_not_due_are_thrown_away(video):
    camera = ep.camera(f"file://{video}", fps=1 / 3600)
    assert places(camera, 1) == [0]
    with pytest.raises(CameraUnavailable):
        camera.read()


def test_a_device_that_is_not_there_is_named():
    with pytest.raises(CameraUnavailable, match=r"Camera 97 can't be opened\. Check that it is connected") as info:
        ep.camera(97)
    assert info.value.camera == "Camera 97"
    with pytest.raises(ValueError, match="No camera has the number -1"):
        ep.camera(-1)


class SlowCapture:
    """What a cv2.VideoCapture is, with a frame that is long in coming."""

    def __init__(self):
        self.grabbing, self.go, self.is_open, self.released_while_reading = (
            threading.Event(),
            threading.Event(),
            True,
            False,
        )

    def grab(self):
        self.grabbing.set()
        self.go.wait()
        self.grabbing.clear()
        return True

    def retrieve(self):
        return True, gray(1)

    def release(self):
        self.released_while_reading |= self.grabbing.is_set()
        self.is_open = False

    def isOpened(self):
        return self.is_open

    def get(self, key):
        return 0.0


def test_a_capture_is_never_released_while_it_is_read():
    capture = SlowCapture()
    camera = ep.camera(lambda: capture)
    frames = []
    reading = threading.Thread(target=lambda: frames.append(camera.read()))
    reading.start()
    assert capture.grabbing.wait(60)
    camera.close()
    assert capture.is_open
    capture.go.set()
    reading.join(60)
    assert frames == [None]
    assert not capture.is_open
    assert not capture.released_while_reading


def test_a_device_is_open_once_and_a_stream_as_often_as_one_likes(monkeypatch):
    def opened(source):
        capture = SlowCapture()
        capture.go.set()
        return capture

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    with pytest.raises(CameraUnavailable, match=r"'/dev/video0' is open already, by line \d+ of test_cameras\.py"):
        [ep.camera(source) for source in (0, "/dev/video0")]
    first = ep.camera("/dev/video0")
    first.close()
    second = ep.camera(0)
    with pytest.raises(CameraUnavailable, match="is open already"):
        first.read()
    assert len({ep.camera("rtsp://127.0.0.1/film") for _ in range(2)}) == 2
    del second
    assert first.read() is not None


def test_the_password_of_a_stream_is_not_told():
    with pytest.raises(CameraUnavailable) as info:
        ep.camera("nothing://me:secret@127.0.0.1/film")
    assert "secret" not in str(info.value)
    assert "nothing://127.0.0.1/film" in str(info.value)


# Iterables and functions


def test_a_list_begins_anew_and_an_iterator_ends():
    images = [gray(1), gray(2)]
    assert values(ep.camera(images, fps=math.inf), 5) == [1, 2, 1, 2, 1]
    assert values(ep.camera(images, fps=math.inf, loop=False), 3) == [1, 2, None]
    assert values(ep.camera(iter(images)), 4) == [1, 2, None, None]


def test_a_generator_goes_on_after_closing_and_a_function_begins_anew():
    def frames():
        yield from map(gray, itertools.count(1))

    generator, function = ep.camera(frames()), ep.camera(frames)
    assert values(generator, 2) == values(function, 2) == [1, 2]
    generator.close()
    function.close()
    assert values(generator, 2) == [3, 4]
    assert values(function, 2) == [1, 2]


def test_a_function_is_called_again_when_its_frames_are_over():
    rounds = itertools.count(1)
    camera = ep.camera(lambda: iter([gray(next(rounds))]))
    assert values(camera, 3) == [1, 2, 3]


@pytest.mark.parametrize("source", [[], (), lambda: iter(())])
def test_what_has_no_frames_at_all_ends_at_once(source):
    assert ep.camera(source, fps=math.inf).read() is None


def test_an_iterator_that_gives_none_is_told_what_that_means():
    with pytest.raises(TypeError, match="The iterator gave None, which is no image"):
        ep.camera(iter([None])).read()


class Counting:
    """A camera of a user's own."""

    def __init__(self):
        self.closed = 0
        self.numbers = itertools.count(1)

    def read(self):
        return gray(next(self.numbers))

    def close(self):
        self.closed += 1


def test_an_object_with_read_and_close_is_a_camera_already():
    mine = Counting()
    assert ep.camera(mine) is mine
    assert isinstance(mine, Camera)
    slower = ep.camera(mine, fps=1_000)
    assert values(slower, 3) == [1, 2, 3]
    slower.close()
    assert mine.closed == 1


@pytest.mark.parametrize(
    "source", [None, True, 1.5, b"frame", {"a": 1}, object(), np.float64(3), lambda: None, lambda: 3, lambda: GRAY, Counting]
)  # fmt: skip
def test_what_is_no_source_is_refused_with_a_way_out(source):
    with pytest.raises(TypeError, match=r"can't be made of.*(Give|Return)"):
        ep.camera(source)


@pytest.mark.parametrize("array", [np.zeros(5), np.zeros((0, 4)), np.zeros((2, 2, 2, 2)), np.full((2, 2), "a")])
def test_an_array_that_is_no_image_is_refused(array):
    with pytest.raises(ValueError, match=r"A frame must be \(y, x\) or \(y, x, channels\) of numbers"):
        ep.camera(array)


# Pace


@pytest.mark.parametrize("fps", [0, -1, math.nan, "10", True])
def test_a_pace_that_is_none_is_refused(fps):
    with pytest.raises(ValueError, match="fps must be a number above 0"):
        ep.camera(GRAY, fps)


def test_the_first_frame_comes_at_once_and_the_others_when_they_are_due():
    camera = ep.camera(GRAY, fps=100)
    began_s = time.monotonic()
    times_s = [time.monotonic() - began_s for _ in range(4) if camera.read() is not None]
    assert all(at_s >= 0.01 * place - 0.002 for place, at_s in enumerate(times_s))


def test_closing_ends_the_wait_for_the_next_frame_at_once():
    camera = ep.camera(GRAY, fps=1 / 3600)
    camera.read()
    frames = []
    reading = threading.Thread(target=lambda: frames.append(camera.read()))
    reading.start()
    while reading.is_alive():
        camera.close()
        reading.join(0.001)
    assert frames == [None]


def test_a_pace_slower_than_any_clock_can_wait_is_possible():
    camera = ep.camera(GRAY, fps=5e-324)
    assert camera.read() is not None


@pytest.mark.parametrize("name", ["text.png", "text.jpg", "text.tiff"])
def test_a_file_that_is_only_called_like_an_image_is_refused(tmp_path, name):
    (tmp_path / name).write_text("no image, although it is called like one")
    with pytest.raises(ImageFileError, match=name):
        ep.camera(tmp_path / name)
