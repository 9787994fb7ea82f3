"""Videos as the inputs of maps, sweeps, checks and searches."""

from __future__ import annotations

import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from typing import Annotated

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import Video, read_image
from epypes.batch.items import image_set, items_of
from epypes.errors import ImageFileError, ScaleError
from tests.calls import log_to
from tests.videos import with_damage, write_video

COUNT = 24


def number(image):
    """The number in black and white squares at the top of the image, as the test's video has it."""
    import numpy

    squares = [image[4:12, bit * 16 + 4 : bit * 16 + 12] for bit in range(8)]
    return int(sum(1 << bit for bit, square in enumerate(squares) if numpy.mean(square) > 128))


def brightness(image):
    return float(image.mean())


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "belt.avi", COUNT, "MJPG")


@pytest.fixture
def runner():
    cg = ep.CompGraph(
        {"number": number, "brightness": brightness, "above": lambda seen, least: seen >= least},
        {"number": ("image", "seen"), "brightness": ("image", "light"), "above": (("seen", "least"), "is_late")},
    )
    return ep.CompGraphRunner(cg, {"least": 12})


@pytest.fixture
def plain():
    """A graph that can go to other processes."""
    cg = ep.CompGraph({"number": number, "gray": cv2.cvtColor}, {"number": ("image", "seen"), "gray": (("image", "code"), "gray")})  # fmt: skip
    return ep.CompGraphRunner(cg, {"code": cv2.COLOR_BGR2GRAY})


def column(result, token):
    return [outcome.values.get(token) for outcome in result]


def seen(outcomes):
    return [outcome.kept["seen"] for outcome in outcomes]


def test_a_video_becomes_a_table_with_the_number_and_time_of_each_frame(video, runner):
    frame = ep.map(runner, str(video)).to_frame()
    assert list(frame.columns[:5]) == ["name", "frame", "time_s", "failure", "light"]
    assert frame["name"].tolist() == [f"belt.avi #{n}" for n in range(COUNT)]
    assert frame["frame"].tolist() == list(range(COUNT))
    assert frame["time_s"].tolist() == pytest.approx([n / 25 for n in range(COUNT)])
    assert frame["is_late"].tolist() == [n >= 12 for n in range(COUNT)]
    assert ep.map(runner, video, keep="seen")[5].kept["seen"] == 5


def test_the_values_are_those_of_a_loop_over_opencv(video, runner):
    capture, expected = cv2.VideoCapture(str(video)), []
    while (found := capture.read())[0]:
        expected.append(float(found[1].mean()))
    assert column(ep.map(runner, video), "light") == expected


def test_a_table_of_images_has_no_columns_of_frames(runner):
    frame = ep.map(runner, [np.zeros((20, 160, 3), np.uint8)]).to_frame()
    assert not {"frame", "time_s"} & set(frame.columns)


def test_the_table_in_a_notebook_shows_the_times(video, runner):
    html = ep.map(runner, ep.video(video)[3:5])._repr_mimebundle_()["text/html"]
    assert "time of the frame" in html
    assert "0.120 s" in html
    assert "belt.avi #4" in html


def test_a_token_called_frame_keeps_its_column(video):
    runner = ep.CompGraphRunner(ep.CompGraph({"number": number}, {"number": ("image", "frame")}))
    frame = ep.map(runner, ep.video(video)[4:6]).to_frame()
    assert frame["frame"].tolist() == [4, 5]
    assert frame["frame (token)"].tolist() == [4, 5]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_workers_side_by_side_give_the_frames_in_their_order(video, plain, kind):
    alone = ep.map(plain, video, keep=["seen", "gray"])
    make = {
        "threads": lambda: ThreadPoolExecutor(3),
        "processes": lambda: ProcessPoolExecutor(2, mp_context=get_context("spawn")),
    }
    with make[kind]() as executor:
        result = ep.map(plain, ep.video(video), executor, keep=["seen", "gray"])
    assert seen(result) == seen(alone) == list(range(COUNT))
    assert all(np.array_equal(one.kept["gray"], other.kept["gray"]) for one, other in zip(result, alone, strict=True))
    assert [(one.name, one.frame, one.time_s) for one in result] == [(one.name, one.frame, one.time_s) for one in alone]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "threads", "processes"])
def test_a_damaged_frame_is_a_row_that_says_so(video, plain, kind):
    with_damage(video, 7)
    if kind == "none":
        result = ep.map(plain, video, keep="seen")
    else:
        pools = {"threads": ThreadPoolExecutor, "processes": ProcessPoolExecutor}
        with pools[kind](2) as executor:
            result = ep.map(plain, video, executor, keep="seen")
    assert [outcome.frame for outcome in result] == list(range(COUNT))
    assert [outcome.frame for outcome in result.failures] == [7]
    assert "Frame 7 of" in result[7].error_info.message
    assert result[7].time_s == pytest.approx(0.28)
    assert result[8].kept["seen"] == 8


def test_colours_are_in_the_order_of_the_token(video):
    def corner(image: Annotated[np.ndarray, ep.Image(order="rgb")]):
        return image[60, 80].tolist()

    runner = ep.CompGraphRunner(ep.CompGraph({"corner": corner}, {"corner": ("image", "colour")}))
    (outcome,) = ep.map(runner, ep.video(video)[3:4], keep="colour")
    assert outcome.kept["colour"] == ep.video(video)[3][60, 80, ::-1].tolist()


def test_lists_globs_and_generators_may_have_videos(video, tmp_path, runner):
    other = write_video(tmp_path / "celt.avi", 3, "MJPG")
    image = np.zeros((20, 160, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "still.png"), image)
    names = [f"belt.avi #{n}" for n in range(COUNT)] + [f"celt.avi #{n}" for n in range(3)]
    assert [outcome.name for outcome in ep.map(runner, str(tmp_path / "[bc]elt.avi"))] == names
    mixed = [video, image, str(tmp_path / "still.png"), ep.video(other)[1:], {"image": str(other)}]
    assert image_set(mixed).count == COUNT + 1 + 1 + 2 + 3
    for given in (mixed, iter(mixed)):
        result = ep.map(runner, given, keep="seen")
        assert seen(result) == [*range(COUNT), 0, 0, 1, 2, 0, 1, 2]
        assert [outcome.frame for outcome in result][-6:] == [None, 1, 2, 0, 1, 2]


def test_frames_of_a_camera_keep_their_numbers_and_times(video, runner):
    frames = (frame for frame in ep.camera(video) if frame.number % 10 == 4)
    table = ep.map(runner, frames).to_frame()
    assert table["frame"].tolist() == [4, 14]
    assert table["time_s"].tolist() == pytest.approx([0.16, 0.56])
    assert len(ep.map(runner, ep.camera(video))) == COUNT


def test_the_frames_of_one_video_are_known_as_a_series(video, tmp_path, runner):
    other = write_video(tmp_path / "other.avi", 2, "MJPG")
    items = list(items_of([video, other, np.zeros((20, 160, 3), np.uint8)], runner))
    assert [item.series for item in items] == [str(video)] * COUNT + [str(other)] * 2 + [""]
    assert [item.frame for item in items] == [*range(COUNT), 0, 1, None]
    assert [item.number for item in items] == list(range(COUNT + 3))


def test_two_videos_in_one_dict_are_refused_with_the_way_to_pair_them(video):
    cg = ep.CompGraph({"difference": cv2.absdiff}, {"difference": (("left", "right"), "out")})
    runner = ep.CompGraphRunner(cg)
    with pytest.raises(ScaleError, match=r"has videos for 'left', 'right'.* zip\(ep\.video\('left\.mp4'\)"):
        ep.map(runner, [{"left": video, "right": video}])
    pairs = ({"left": left, "right": right} for left, right in zip(ep.video(video), ep.video(video), strict=True))
    assert all(not outcome.kept["out"].any() for outcome in ep.map(runner, pairs, keep="out"))


def test_a_video_that_can_not_be_opened_is_refused_before_anything_is_run(video, tmp_path, runner):
    (tmp_path / "bad.mp4").write_bytes(b"nothing")
    for images in (tmp_path / "bad.mp4", [video, tmp_path / "bad.mp4"]):
        with pytest.raises(ImageFileError, match=r"bad\.mp4' is neither an image nor a video"):
            ep.map(runner, images)


def test_a_video_where_one_image_is_wanted_says_so(video):
    with pytest.raises(
        ImageFileError, match=r"belt\.avi' is a video, where one image is wanted.*ep\.video\(path\)\[0\]"
    ):
        read_image(video)


# What is stored


def test_stored_frames_are_neither_run_nor_decoded_again(video, tmp_path, monkeypatch):
    calls = log_to(tmp_path)

    def noted(image):
        calls.add("run")
        return float(image.mean())

    runner = ep.CompGraphRunner(ep.CompGraph({"light": noted}, {"light": ("image", "brightness")}))
    store = tmp_path / "results.sqlite"
    first = ep.map(runner, video, store=store, name="belt")
    monkeypatch.setattr(Video, "image", lambda *_: pytest.fail("a frame was decoded"))
    again = ep.map(runner, video, store=store, name="belt")
    assert column(again, "brightness") == column(first, "brightness")
    assert [outcome.frame for outcome in again] == list(range(COUNT))
    assert [outcome.time_s for outcome in again] == [outcome.time_s for outcome in first]
    part = ep.map(runner, ep.video(video)[4:8], store=store, name="belt")
    assert column(part, "brightness") == column(first, "brightness")[4:8]


def test_a_video_with_other_content_is_run_again(video, tmp_path, runner):
    store = tmp_path / "results.sqlite"
    before = ep.map(runner, video, store=store, name="belt")
    shutil.copy(write_video(tmp_path / "other.avi", COUNT, "XVID"), video)
    after = ep.map(runner, video, store=store, name="belt")
    assert column(after, "light") != column(before, "light")
    assert column(after, "light") == column(ep.map(runner, video), "light")


# Sweeps, checks and searches


def test_a_sweep_runs_each_setting_on_each_frame(video, runner):
    result = ep.sweep(runner, {"least": [3, 6]}, images=ep.video(video)[2:8:2], show=())
    frame = result.to_frame()
    assert frame["frame"].tolist() == [2, 2, 4, 4, 6, 6]
    assert frame["least"].tolist() == [3, 6] * 3
    assert frame["is_late"].tolist() == [False, False, True, False, True, True]
    assert len(ep.sweep(runner, {"least": [3, 6]}, images=video, show=())) == 2 * COUNT


def test_each_frame_of_a_video_is_checked(video, runner):
    checks = {"value": {"token": "seen", "min": 2, "max": 100}}
    result = ep.check(
        runner, [ep.Case(video, metrics=checks), ep.Case(ep.video(video)[:2], metrics=checks, name="start")]
    )
    assert len(result.cases) == COUNT + 2
    assert [name for name, passed in result.cases.items() if not passed] == [
        "belt.avi #0", "belt.avi #1", "start #0", "start #1",
    ]  # fmt: skip
    assert ep.check(runner, str(video)).passed
    assert len(ep.check(runner, ep.video(video)).cases) == COUNT


def test_a_file_of_cases_may_name_a_video(video, runner):
    cases = video.with_name("CASES.toml")
    cases.write_text(
        '[[case]]\ninputs = {image = "belt.avi"}\n[[case.check]]\ntoken = "seen"\nmetric = "value"\nmax = 22\n'
    )
    result = ep.check(runner, cases)
    assert [name for name, passed in result.cases.items() if not passed] == ["belt.avi #23"]


@pytest.mark.slow
@pytest.mark.parametrize("as_path", [True, False])
def test_a_search_takes_the_frames_of_a_video(video, runner, as_path):
    found = ep.optimize(
        runner, lambda tokens, case: abs(tokens["seen"] - 5) if tokens["is_late"] else 3, video if as_path else ep.video(video)[:8], 4,
        direction="minimize", ranges={"least": (0, 20)}, keep=["seen", "is_late"], progress=False,
    )  # fmt: skip
    assert len(found) == 4
    assert not found.failures


def redness(image):
    return float(image[..., 0].mean())


def test_frames_of_a_camera_have_the_order_of_their_token(tmp_path):
    video = tmp_path / "red.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    for _ in range(3):
        writer.write(np.full((48, 64, 3), (0, 0, 250), np.uint8))
    writer.release()
    bgr = ep.CompGraph({"redness": redness}, {"redness": ("image", "first_channel")})
    rgb = bgr | ep.CompGraph(
        {"gray": lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)}, {"gray": ("image", "image_gray")}
    )
    for cg, expected in ((bgr, 0), (rgb, 250)):
        for images in (video, ep.video(video), ep.camera(video), [*ep.camera(video)]):
            found = ep.map(ep.CompGraphRunner(cg), images, progress=False).to_frame()["first_channel"]
            assert np.allclose(found, expected, atol=8)
