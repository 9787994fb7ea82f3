"""Videos as sequences of images: exact frames and times, what is damaged, and what is refused."""

from __future__ import annotations

import math
import os
import shutil
import struct
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate, pairwise

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import Frame
from epypes.errors import ImageFileError
from tests.videos import HEIGHT, WIDTH, number_in, picture, with_damage, with_durations, write_video

COUNT = 40


def captured(path) -> list:
    """The frames as a loop over cv2.VideoCapture has them."""
    capture, frames = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        frames.append(found[1])
    capture.release()
    return frames


@pytest.fixture(params=["belt.mp4 mp4v", "belt.avi MJPG", "belt.mkv mp4v"])
def path(request, tmp_path):
    name, codec = request.param.split()
    return write_video(tmp_path / name, COUNT, codec)


@pytest.fixture
def mp4(tmp_path):
    return write_video(tmp_path / "belt.mp4", COUNT)


@pytest.fixture
def avi(tmp_path):
    return write_video(tmp_path / "belt.avi", COUNT, "MJPG")


# Frames and times


def test_every_frame_has_the_pixels_that_opencv_reads_in_whatever_order_it_is_asked_for(path):
    expected, video = captured(path), ep.video(path)
    assert len(video) == len(expected) == COUNT
    for number in [*range(COUNT), *reversed(range(COUNT)), *np.random.default_rng(0).permutation(COUNT).tolist()]:
        assert np.array_equal(video[number], expected[number]), number
    assert [number_in(image) for image in video] == list(range(COUNT))


def test_times_are_those_of_the_file(path):
    video = ep.video(path)
    assert video.times_s == pytest.approx([number / 25 for number in range(COUNT)], abs=1e-3)
    assert video.fps == pytest.approx(25, abs=0.01)


def test_a_variable_frame_rate_is_read_exactly(mp4):
    durations = [512 + 4096 * (number % 5 == 3) + 97 * (number % 7) for number in range(COUNT)]
    video = ep.video(with_durations(mp4, durations))
    steps = [later - earlier for earlier, later in pairwise(video.times_s)]
    unit_s = video.times_s[1] / durations[0]
    assert steps == pytest.approx([duration * unit_s for duration in durations[:-1]])
    assert video.times_s == pytest.approx([0, *accumulate(duration * unit_s for duration in durations[:-1])])
    for number in np.random.default_rng(1).permutation(COUNT).tolist():
        assert number_in(video[number]) == number


def test_a_slice_is_a_video_of_its_frames_with_their_numbers_and_times(mp4):
    part = ep.video(mp4)[10:30:5]
    assert [number_in(image) for image in part] == list(part.numbers) == [10, 15, 20, 25]
    assert part.times_s == pytest.approx((0.4, 0.6, 0.8, 1.0))
    assert number_in(part[-1]) == 25
    assert [number_in(image) for image in part[::-1][:2]] == [25, 20]
    assert len(ep.video(mp4)[5:5]) == 0


def test_a_frame_that_is_not_there_is_named(mp4):
    with pytest.raises(IndexError, match=r"There is no frame 40 of '.*belt\.mp4': it has 40, counted from 0\."):
        ep.video(mp4)[40]


def test_a_file_that_says_so_is_turned(mp4):
    content, upright_frames = mp4.read_bytes(), captured(mp4)
    upright = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    turned = struct.pack(">9I", 0, 0x10000, 0, 0xFFFF0000, 0, 0, 0, 0, 0x40000000)
    at = content.index(upright, content.index(b"tkhd"))
    mp4.write_bytes(content[:at] + turned + content[at + len(turned) :])
    video = ep.video(mp4)
    assert video[0].shape == (WIDTH, HEIGHT, 3)
    # OpenCV 4.11 does not turn it.
    assert np.array_equal(video[7], np.rot90(upright_frames[7], -1))


def test_images_are_read_only_and_a_frame_in_use_is_one_array(mp4):
    video = ep.video(mp4)
    image = video[3]
    assert not image.flags.writeable
    assert video[3] is image
    assert ep.video(mp4)[3] is image
    assert video.number_of(image) == 3
    assert video.number_of(image.copy()) is None
    assert image in video
    assert image not in video[4:]


def test_the_images_that_are_kept_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("epypes.acquisition.video._CACHE_BYTES", 5 * 3 * WIDTH * HEIGHT)
    video = ep.video(write_video(tmp_path / "belt.avi", COUNT, "MJPG"))
    alive: set[int] = set()
    for number in [*range(COUNT), *reversed(range(COUNT)), 0, 39, 5]:
        image = video[number]
        alive.add(number)
        weakref.finalize(image, alive.discard, number)
        del image
        assert len(alive) <= 6
    video.close()
    assert not alive


def test_threads_read_one_video(mp4):
    video, numbers = ep.video(mp4), np.random.default_rng(2).integers(0, COUNT, 200).tolist()
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda number: number_in(video[number]), numbers)) == numbers


def test_a_closed_video_opens_again(mp4):
    video = ep.video(mp4)
    assert number_in(video[9]) == 9
    video.close()
    video.close()
    assert number_in(video[4]) == 4


def test_a_file_that_has_changed_is_not_read_on(mp4, tmp_path):
    video = ep.video(mp4)
    video.close()
    shutil.copy(write_video(tmp_path / "other.mp4", 7), mp4)
    with pytest.raises(ImageFileError, match="has changed since it was opened"):
        video[0]
    assert len(ep.video(mp4)) == 7


# What is damaged or cut off


@pytest.mark.parametrize("part", [0.3, 0.5, 0.6])
def test_an_avi_that_was_cut_off_is_read_as_far_as_it_goes(avi, part):
    whole = captured(avi)
    avi.write_bytes(avi.read_bytes()[: int(avi.stat().st_size * part)])
    with pytest.warns(
        UserWarning, match=r"'.*belt\.avi' was cut off or is damaged: it has \d+ of 40 frames\. These are used\."
    ):
        video = ep.video(avi)
    assert part * COUNT - 6 < len(video) < part * COUNT
    assert all(np.array_equal(image, expected) for image, expected in zip(video, whole, strict=False))


def test_an_mkv_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path):
    mkv = write_video(tmp_path / "belt.mkv", COUNT)
    mkv.write_bytes(mkv.read_bytes()[: mkv.stat().st_size // 2])
    with pytest.warns(UserWarning, match=r"'.*belt\.mkv' was cut off or is damaged: it has \d\.\d s of video"):
        video = ep.video(mkv)
    assert 10 < len(video) < 30


def test_an_mp4_that_was_cut_off_says_what_is_missing(mp4):
    mp4.write_bytes(mp4.read_bytes()[: mp4.stat().st_size * 6 // 10])
    with pytest.raises(
        ImageFileError, match=r"'.*belt\.mp4' was cut off: its index is missing.* Record it again"
    ) as info:
        ep.video(mp4)
    assert info.value.path == str(mp4)


def test_a_damaged_frame_is_an_error_and_those_behind_it_are_not(avi):
    video = ep.video(with_damage(avi, 17))
    for _ in range(2):
        with pytest.raises(ImageFileError, match=r"Frame 17 of '.*belt\.avi' can't be decoded"):
            video[17]
    assert [number_in(video[number]) for number in (18, 16, 39)] == [18, 16, 39]
    assert [frame.number for frame in ep.camera(avi)] == [*range(17), *range(18, COUNT)]


# What is refused


@pytest.mark.parametrize(
    ("content", "reason"),
    [(None, "can't be read: No such file"), (b"", "is empty"), (b"no video" * 99, "is neither an image nor a video")],
)
def test_a_file_that_is_no_video_is_named(tmp_path, content, reason, capfd):
    path = tmp_path / "x.mp4"
    if content is not None:
        path.write_bytes(content)
    for read in (ep.video, ep.camera):
        with pytest.raises(ImageFileError, match=r"x\.mp4"):
            read(path)
    with pytest.raises(ImageFileError, match=reason):
        ep.video(path)
    assert capfd.readouterr() == ("", "")


def test_a_codec_that_is_missing_has_a_way_out(avi):
    avi.write_bytes(avi.read_bytes().replace(b"MJPG", b"ZZZZ"))
    with pytest.raises(ImageFileError, match=r"PyAV has no codec .* ffmpeg -i belt\.avi -c:v libx264 belt_h264\.mp4"):
        ep.video(avi)


@pytest.mark.parametrize(("name", "codec"), [("none.avi", "MJPG"), ("none.mp4", "mp4v")])
def test_a_video_without_frames_is_refused(tmp_path, name, codec):
    with pytest.raises(ImageFileError, match=r"none\.\w+' has no (frames|video)"):
        ep.video(write_video(tmp_path / name, 0, codec))


def test_a_folder_is_refused_with_what_takes_one(tmp_path):
    with pytest.raises(ImageFileError, match="is a folder, no video"):
        ep.video(tmp_path)


# Cameras


def test_a_camera_of_a_video_is_its_frames_with_numbers_and_times(mp4):
    frames = list(ep.camera(mp4))
    assert [frame.number for frame in frames] == [number_in(frame.image) for frame in frames] == list(range(COUNT))
    assert [frame.time_s for frame in frames] == pytest.approx([number / 25 for number in range(COUNT)])
    assert all(isinstance(frame, Frame) and not frame.image.flags.writeable for frame in frames)


def test_a_loop_over_a_camera_does_not_disturb_what_is_read(mp4):
    camera = ep.camera(mp4, fps=math.inf)
    assert number_in(camera.read()) == 0
    assert [frame.number for frame in camera] == list(range(COUNT))
    assert number_in(camera.read()) == 1


def test_a_loop_does_not_keep_to_the_pace_of_the_recording(tmp_path):
    slow = write_video(tmp_path / "slow.avi", 3, "MJPG", fps=0.01)
    assert [frame.time_s for frame in ep.camera(slow)] == pytest.approx([0, 100, 200])


def test_a_loop_keeps_to_a_pace_that_was_asked_for(mp4):
    camera, seen = ep.camera(mp4, fps=1 / 3600), threading.Event()

    def loop():
        for _ in camera:
            seen.set()

    thread = threading.Thread(target=loop)
    thread.start()
    assert seen.wait(60)
    assert thread.is_alive(), "the second frame is due in an hour"
    camera.close()
    thread.join(60)
    assert not thread.is_alive()


def test_images_folders_and_lists_come_once_in_a_loop(tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(number))
    frames = list(ep.camera(tmp_path))
    assert [(frame.number, number_in(frame.image), frame.time_s) for frame in frames] == [
        (n, n, None) for n in range(3)
    ]
    assert [frame.number for frame in ep.camera([picture(0), picture(1)])] == [0, 1]
    assert [frame.number for frame in ep.camera(picture(0))] == [0]


def test_a_device_comes_without_end(mp4):
    camera = ep.camera(f"file://{mp4}")
    numbers = []
    for frame in camera:
        numbers.append((frame.number, number_in(frame.image)))
        if len(numbers) == 5:
            break
    camera.close()
    assert numbers == [(number, number) for number in range(5)]


def test_a_camera_is_made_of_a_part_of_a_video(mp4):
    camera = ep.camera(ep.video(mp4)[30:], fps=math.inf, loop=False)
    assert [number_in(camera.read()) for _ in range(10)] == list(range(30, 40))
    assert camera.read() is None


def test_an_acquisition_captures_a_video_on_its_thread(mp4):
    with ep.ImageAcquisition(ep.camera(mp4, fps=math.inf, loop=False), size=COUNT) as acquisition:
        assert acquisition.wait_for_frames(60)
        while acquisition.states != ("ended",):
            os.sched_yield()
        frames = list(acquisition.rings[0]._frames)
    assert [frame.number for frame in frames] == list(range(1, COUNT + 1))
    assert [number_in(frame.image) for frame in frames] == list(range(COUNT))


def test_a_title_in_another_encoding_is_no_obstacle(tmp_path):
    import av

    file = tmp_path / "title.mkv"
    with av.open(str(file), "w") as container:
        container.metadata["title"] = "Gr?n"
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    assert b"Gr?n" in file.read_bytes()
    file.write_bytes(file.read_bytes().replace(b"Gr?n", "Grün".encode("latin-1")))
    assert len(ep.video(file)) == 3
