"""A panel on the frames of a video."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import ImageFileError, PayloadError
from epypes_widgets import tune
from epypes_widgets.picture.images import VideoPayloads, payloads
from tests.colours import red_runner
from tests.videos import number_in, with_damage, write_video

COUNT = 30


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "belt.avi", COUNT, "MJPG")


def gray(image: Any) -> Any:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    cg = ep.CompGraph(
        {"gray": gray, "above": lambda grey, level: grey > level},
        {"gray": ("image", "grey"), "above": (("grey", "level"), "mask")},
    )
    return ep.CompGraphRunner(cg, {"level": 100})


def until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Return when a condition holds."""
    asking, deadline_s = threading.Event(), monotonic() + timeout_s
    while not condition():
        assert monotonic() < deadline_s, "it never came to that"
        asking.wait(0.001)


def setup(panel: Any) -> dict[str, Any]:
    content: dict[str, Any] = panel._setup()[0]
    return content


def go_to(panel: Any, index: int, kind: str = "image") -> None:
    """Do what the view asks for with a click, or while its slider is moved."""
    content = {"kind": "image", "index": index}
    if kind == "move":
        content = {"kind": "move", "values": {}, "places": {}, "image": index}
    panel._screen.view._handle(None, content, ())
    panel.wait(60)


@pytest.mark.parametrize("kind", ["path", "text", "video"])
def test_a_panel_starts_on_the_first_frame_and_goes_to_any(runner: ep.CompGraphRunner, video: Path, kind: str) -> None:
    panel = tune(runner, images={"path": video, "text": str(video), "video": ep.video(video)}[kind])
    panel.wait(60)
    assert number_in(panel.result["image"]) == 0
    for index, how in ((17, "image"), (29, "move"), (3, "move")):
        go_to(panel, index, how)
        assert number_in(panel.result["image"]) == index
        assert panel._session.image == index
        assert np.array_equal(panel.result["grey"], gray(ep.video(video)[index]))
    panel.close()


def test_the_view_gets_the_numbers_of_the_frames_and_no_thumbnails(runner: ep.CompGraphRunner, video: Path) -> None:
    panel = tune(runner, images=ep.video(video)[4:20:2])
    panel.wait(60)
    assert setup(panel)["frames"] == {"name": "belt.avi", "numbers": {"start": 4, "step": 2, "count": 8}}
    assert setup(panel)["images"] == []
    go_to(panel, 3)
    content = panel._screen.view.frames.newest.content
    assert content["image"] == 3
    assert content["time_s"] == pytest.approx(0.4)
    assert number_in(panel.result["image"]) == 10
    assert "belt.avi #10, 0.400 s" in panel._static_html()
    panel.close()
    other = tune(runner)
    assert setup(other)["frames"] is None
    other.close()


def test_frames_are_read_when_they_are_asked_for(
    runner: ep.CompGraphRunner, video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    original = ep.acquisition.Video.image  # type: ignore[attr-defined]
    monkeypatch.setattr(
        "epypes.acquisition.Video.image",
        lambda self, number, *order: read.append(number) or original(self, number, *order),
    )
    panel = tune(runner, images=video)
    panel.wait(60)
    assert set(read) == {0}
    go_to(panel, 21)
    assert set(read) == {0, 21}
    panel.set(level=120)
    panel.wait(60)
    assert set(read) == {0, 21}
    panel.close()


def test_only_a_bounded_part_of_a_video_is_in_memory(
    runner: ep.CompGraphRunner, video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("epypes.acquisition.video._CACHE_BYTES", 4 * 3 * 160 * 120)
    frames = VideoPayloads(ep.video(video), "image", "bgr")
    alive: set[int] = set()
    for index in [*range(COUNT), *reversed(range(COUNT))]:
        image = frames[index].values["image"]
        alive.add(index)
        weakref.finalize(image, alive.discard, index)
        del image
        assert len(alive) <= 5


def test_frames_that_are_looked_at_in_turn_are_one_entry_of_the_history(
    runner: ep.CompGraphRunner, video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("epypes_widgets.tuning.REST_S", 3600.0)
    panel = tune(runner, images=video)
    before = len(panel.history)
    for index in (5, 9, 14):
        panel._screen.view._handle(None, {"kind": "move", "values": {}, "places": {}, "image": index}, ())
    until(lambda: panel._session.image == 14 and not panel._worker.is_pending("compute"))
    assert len(panel.history) == before
    panel.undo()
    assert panel.history["image"].tolist()[-1] == 14
    panel.close()


def test_a_new_panel_on_the_runner_goes_on_with_the_frame(runner: ep.CompGraphRunner, video: Path) -> None:
    first = tune(runner, images=video)
    first.wait(60)
    go_to(first, 12)
    again = tune(runner, images=str(video))
    again.wait(60)
    assert again._session.image == 12
    runner.run(image=np.zeros((120, 160, 3), np.uint8))
    again.wait(60)
    assert again._session.image is None
    first.close()
    again.close()


def test_a_damaged_frame_is_an_error_of_the_panel_and_the_next_one_is_shown(
    runner: ep.CompGraphRunner, video: Path
) -> None:
    panel = tune(runner, images=with_damage(video, 7))
    panel.wait(60)
    go_to(panel, 7)
    assert "Frame 7 of" in panel.error
    assert number_in(panel.result["image"]) == 0
    go_to(panel, 8)
    assert panel.error == ""
    assert number_in(panel.result["image"]) == 8
    panel.close()


def test_frames_have_the_order_of_their_token(video: Path) -> None:
    (token,) = red_runner().free_source_tokens
    given = payloads(red_runner(), video)
    assert np.array_equal(given[3].values[token], ep.video(video)[3][..., ::-1])


def test_what_is_no_video_or_does_not_fit_is_refused(runner: ep.CompGraphRunner, video: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mp4").write_bytes(b"nothing")
    with pytest.raises(ImageFileError, match=r"bad\.mp4' is neither"):
        tune(runner, images=tmp_path / "bad.mp4")
    with pytest.raises(TypeError, match="A video in a list of images"):
        tune(runner, images=[ep.video(video)])
    with pytest.raises(TypeError, match="is a frame of a video, which a panel does not check"):
        tune(runner, cases=[ep.Case(video, metrics={"value": {"token": "level", "min": 1}})])
    cg = ep.CompGraph({"difference": cv2.absdiff}, {"difference": (("left", "right"), "out")})
    with pytest.raises(PayloadError, match="A frame of the video does not say which of 'left', 'right' it is"):
        tune(ep.CompGraphRunner(cg), images=video)


@pytest.mark.slow
def test_a_search_looks_at_the_frames(runner: ep.CompGraphRunner, video: Path) -> None:
    panel = tune(
        runner, images=ep.video(video)[:3], metric=lambda tokens, case: float(tokens["mask"].mean()), level=(90, 200)
    )
    panel.search.start(3)
    panel.search.wait(60)
    assert len(panel.search.result) == 3
    panel.close()
