"""How pictures are shown: limits are drawn by the kernel, all is remembered by token and saved with the settings."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.errors import SettingsError, UnknownName
from epypes_widgets import Panel, tune
from epypes_widgets.picture.picture_settings import PictureSettings, auto_limits
from epypes_widgets.settings import load, save
from tests.widgets.frontend import FrontEnd


def deep(image: Any, offset: int) -> Any:
    return (image.astype(np.uint16) + np.uint16(offset)) * np.uint16(4)


def measured(image: Any) -> Any:
    return image.astype(np.float32) / 10 - 3


def mask(image: Any, threshold: int) -> Any:
    return (image > threshold).astype(np.uint8) * 255


def half(image: Any) -> Any:
    return image[::2, ::2].copy()


def labels(mask: Any) -> Any:
    return cv2.connectedComponents(mask)[1]


def n_labels(labels: Any) -> int:
    return int(labels.max())


def level(image: Any) -> float:
    return float(image.mean())


def blobs(image: Any) -> Any:
    return [cv2.KeyPoint(20, 20, 8)]


def n_blobs(blobs: Any) -> int:
    return len(blobs)


@pytest.fixture
def image() -> Any:
    image = np.full((60, 80), 20, np.uint8)
    image[10:30, 10:30] = np.linspace(40, 140, 20, dtype=np.uint8)
    image[35:50, 40:70] = 120
    return image


@pytest.fixture
def panel(image: Any) -> Iterator[Panel]:
    cg = ep.CompGraph.from_functions(deep, measured, mask, half, labels, n_labels, level, blobs, n_blobs)
    runner = ep.CompGraphRunner(cg, {"offset": 200, "threshold": 80})
    runner.run(image=image)
    panel = tune(runner, offset=(0, 900), threshold=(0, 255))
    panel.wait(60)
    yield panel
    panel.close(60)


@pytest.fixture
def front_end(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def shown(panel: Panel, front_end: FrontEnd, token: str | None = None) -> tuple[dict[str, Any], Any]:
    """Return what the last frame says of its big picture, and its pixels."""
    if token is not None:
        front_end.tell("stage", token=token)
    panel.wait(60)
    at = max(place for place, message in enumerate(front_end.messages) if message["kind"] == "frame")
    picture = front_end.messages[at]["pictures"][0]
    return picture, np.asarray(Image.open(io.BytesIO(front_end.buffers[at][0])).convert("L")).astype(int)


def change(panel: Panel, front_end: FrontEnd, token: str, **settings: Any) -> tuple[dict[str, Any], Any]:
    front_end.tell("picture", token=token, change=settings)
    return shown(panel, front_end)


# -- contrast limits ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("token", "limits"), [("deep", (880, 1360)), ("measured", (-1, 11)), ("image", (20, 140))])
def test_limits_use_all_of_black_to_white_and_reset_takes_them_back(
    panel: Panel, front_end: FrontEnd, token: str, limits: tuple[float, float]
) -> None:
    before, dim = shown(panel, front_end, token)
    assert before["limits"] == before["range"]
    assert dim.max() - dim.min() < 230
    said, bright = change(panel, front_end, token, limits=limits)
    assert (said["limits"], said["range"]) == (list(limits), before["range"])
    assert (bright.min() <= 4, bright.max() >= 250) == (True, True)
    said, again = change(panel, front_end, token, limits=None)
    assert said["limits"] == said["range"] == before["range"]
    np.testing.assert_array_equal(again, dim)


def test_automatic_limits_are_those_of_the_picture_now_and_stay(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "deep")
    said, pixels = change(panel, front_end, "deep", limits="auto")
    assert said["limits"] == [880.0, 1360.0]
    panel["offset"] = 500
    said, brighter = shown(panel, front_end)
    assert said["limits"] == [880.0, 1360.0]
    assert brighter.mean() > pixels.mean() + 50


def test_a_reset_forgets_the_range_of_the_first_image(panel: Panel, front_end: FrontEnd) -> None:
    before, _ = shown(panel, front_end, "deep")
    assert before["range"] == [0.0, 4095.0]
    panel["offset"] = 900
    assert shown(panel, front_end)[0]["range"] == [0.0, 4095.0]
    assert change(panel, front_end, "deep", limits=None)[0]["range"] == [0.0, 16383.0]


def test_limits_are_each_tokens_own_and_hold_for_what_is_drawn_over_it(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "image")
    change(panel, front_end, "image", limits=[20, 140])
    said, _ = shown(panel, front_end, "blobs")
    assert (said["image"], said["limits"]) == ("image", [20, 140])
    assert shown(panel, front_end, "deep")[0]["limits"] == [0, 4095]
    assert shown(panel, front_end, "image")[0]["limits"] == [20, 140]


def test_the_histogram_covers_the_limits(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "deep")
    front_end.tell("histogram", on=True)
    change(panel, front_end, "deep", limits=[880, 1360])
    histogram = front_end.last("frame")["histogram"]
    assert (histogram["low"], histogram["high"]) == (880, 1360)


def test_what_a_picture_is_compared_with_has_its_limits_too(panel: Panel, front_end: FrontEnd) -> None:
    panel["offset"] = 300
    shown(panel, front_end, "deep")
    front_end.tell("compare", **{"with": {"kind": "default"}})
    panel.wait(60)
    change(panel, front_end, "deep", limits=[880, 1360])
    assert front_end.last("reference")["picture"]["limits"] == [880, 1360]


def test_a_change_of_limits_runs_nothing(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "deep")
    change(panel, front_end, "deep", limits=[880, 1360])
    assert front_end.last("frame")["ran"] == 0


@pytest.mark.parametrize(
    ("image", "limits"),
    [
        (np.arange(100_000, dtype=np.uint16).reshape(250, 400) % 5000, (16, 4981)),
        (np.where(np.eye(90) > 0, np.nan, np.linspace(-1, 1, 90)).astype(np.float32), (-1.0, 1.0)),
        (np.full((9, 9), 7.0), None),
        (np.full((9, 9), np.nan), None),
        (np.eye(9) > 0, None),
        (np.pad([[[5.0]]], ((0, 99), (0, 99), (0, 0))), (0.0, 5.0)),
    ],
)
def test_automatic_limits_leave_out_very_few_pixels(image: Any, limits: Any) -> None:
    assert auto_limits(image) == limits


# -- what lies over what --------------------------------------------------------------------------------------


def test_a_mask_and_labels_may_lie_over_images_of_their_size_and_these_come_with_them(
    panel: Panel, front_end: FrontEnd
) -> None:
    said, _ = shown(panel, front_end, "mask")
    assert (said["kind"], said["beneath"]) == ("mask", ["image", "deep", "measured", "labels"])
    change(panel, front_end, "mask", over="deep")
    roles = [(each["token"], each["role"]) for each in front_end.last("frame")["pictures"]]
    assert roles == [("mask", "main"), ("deep", "under")]
    assert shown(panel, front_end, "labels")[0]["kind"] == "labels"
    assert len(front_end.last("frame")["pictures"]) == 1
    shown(panel, front_end, "mask")
    assert len(front_end.last("frame")["pictures"]) == 2


def test_what_lies_under_a_mask_is_computed_with_it(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "mask")
    change(panel, front_end, "mask", over="deep")
    panel["offset"] = 350
    panel.wait(60)
    assert [each["media_type"] for each in front_end.last("frame")["pictures"]] == ["image/png", "image/jpeg"]
    assert int(panel.result["deep"].min()) == 4 * 370


def test_an_image_of_another_size_is_not_laid_under(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "mask")
    change(panel, front_end, "mask", over="half")
    assert len(front_end.last("frame")["pictures"]) == 1


def test_a_photograph_lies_over_nothing(panel: Panel, front_end: FrontEnd) -> None:
    assert "beneath" not in shown(panel, front_end, "image")[0]
    change(panel, front_end, "image", over="deep")
    assert len(front_end.last("frame")["pictures"]) == 1


# -- numbers on the picture ------------------------------------------------------------------------------------


def numbers(front_end: FrontEnd) -> dict[str, str]:
    return {each["token"]: each["text"] for each in front_end.last("frame")["scalars"]}


def test_numbers_are_written_on_the_picture_that_they_were_made_from(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "image")
    assert numbers(front_end) == {}
    front_end.tell("scalars", on=True)
    panel.wait(60)
    assert numbers(front_end) == {"level": f"{panel.result['level']:.6g}", "n_blobs": "1"}
    shown(panel, front_end, "labels")
    assert numbers(front_end) == {"n_labels": "2"}
    shown(panel, front_end, "blobs")
    assert set(numbers(front_end)) == {"level", "n_blobs"}
    shown(panel, front_end, "mask")
    assert numbers(front_end) == {}


def test_numbers_follow_the_values_and_go_when_they_are_switched_off(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "labels")
    front_end.tell("scalars", on=True)
    panel["threshold"] = 130
    panel.wait(60)
    assert numbers(front_end) == {"n_labels": "1"}
    front_end.tell("scalars", on=False)
    panel.wait(60)
    assert numbers(front_end) == {}


# -- in code, and remembered ----------------------------------------------------------------------------------


def test_code_changes_how_a_picture_is_shown_and_a_view_hears_of_it(panel: Panel, front_end: FrontEnd) -> None:
    panel.show_as("deep", limits=(880, 1360), colour_map="viridis")
    panel.show_as("deep", zoom="nearest")
    assert panel.pictures == {"deep": PictureSettings((880, 1360), "viridis", zoom="nearest")}
    said = front_end.last("setup")["pictures"]["deep"]
    assert said == {"limits": [880, 1360], "colour_map": "viridis", "over": "", "opacity": 0.6, "zoom": "nearest"}
    assert shown(panel, front_end, "deep")[0]["limits"] == [880, 1360]


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"limits": (5, 5)}, "the lower first"),
        ({"limits": (0, float("inf"))}, "two numbers"),
        ({"limits": 3}, "two numbers"),
        ({"colour_map": "pink"}, "one of gray, inverted, viridis"),
        ({"opacity": 2}, "from 0 to 1"),
        ({"zoom": "cubic"}, "one of auto, nearest, smooth"),
        ({"over": 3}, "3"),
        ({"contrast": 3}, "'contrast' is no setting"),
    ],
)
def test_a_setting_that_is_none_is_refused(panel: Panel, settings: dict[str, Any], reason: str) -> None:
    with pytest.raises((ValueError, UnknownName), match=reason):
        panel.show_as("deep", **settings)
    assert panel.pictures == {}


def test_a_token_that_is_not_there_is_refused(panel: Panel) -> None:
    for token, settings in (("depp", {}), ("mask", {"over": "imaeg"})):
        with pytest.raises(UnknownName, match=r"deep|image"):
            panel.show_as(token, **settings)


def test_a_cell_that_is_run_again_shows_pictures_as_they_were(panel: Panel) -> None:
    panel.show_as("mask", over="image", opacity=0.3)
    again = tune(panel._runner)
    assert again.pictures == {"mask": PictureSettings(over="image", opacity=0.3)}
    again.close(60)


def test_settings_are_saved_and_loaded_with_the_values(panel: Panel, front_end: FrontEnd, tmp_path: Path) -> None:
    panel.show_as("deep", limits=(880, 1360), colour_map="viridis")
    panel.show_as("mask", over="image", opacity=0.25, zoom="smooth")
    panel.show_as("image", zoom="nearest")
    panel.show_as("image", zoom="auto")
    pictures = panel.pictures
    file = panel.save(tmp_path / "good")
    assert tomllib.loads(file.read_text())["pictures"] == {
        "deep": {"limits": [880.0, 1360.0], "colour_map": "viridis"},
        "mask": {"over": "image", "opacity": 0.25, "zoom": "smooth"},
    }
    panel.show_as("deep", limits=None, colour_map="gray")
    panel.show_as("mask", over="", opacity=1)
    panel.load(file)
    assert {token: panel.pictures[token] for token in ("deep", "mask")} == {
        token: pictures[token] for token in ("deep", "mask")
    }
    assert shown(panel, front_end, "deep")[0]["limits"] == [880, 1360]


def test_a_file_of_another_graph_leaves_out_tokens_that_are_not_there(panel: Panel, tmp_path: Path) -> None:
    others = {"gone": PictureSettings(zoom="smooth"), "mask": PictureSettings(over="gone")}
    panel.load(save(tmp_path / "other", {"threshold": 90}, pictures=others))
    assert (panel["threshold"], panel.pictures) == (90, {})


@pytest.mark.parametrize("limits", ["[1, 1" + 400 * "0" + "]", '"12"', '["1", "2"]', "{1 = 1, 2 = 2}", "[nan, 2]"])
def test_limits_that_are_no_two_numbers_are_refused_with_their_place(tmp_path: Path, limits: str) -> None:
    file = save(tmp_path / "edges", {"k": 3})
    file.write_text(f"{file.read_text()}\n[pictures.image]\nlimits = {limits}\n")
    with pytest.raises(SettingsError, match=r"\[pictures.image\]: limits can't be"):
        load(file, {"k": 3})


def test_a_file_without_pictures_has_no_section(tmp_path: Path) -> None:
    assert "pictures" not in save(tmp_path / "plain", {"k": 3}, pictures={"image": PictureSettings()}).read_text()
    assert load(tmp_path / "plain", {"k": 3}).pictures == {}


def test_every_setting_in_a_file_that_is_none_is_named(tmp_path: Path) -> None:
    file = save(tmp_path / "broken", {"k": 3})
    file.write_text(file.read_text() + '[pictures]\na = 3\n[pictures.b]\nzoom = "far"\n[pictures.c]\nlimits = [3, 2]\n')
    with pytest.raises(SettingsError) as caught:
        load(file, {"k": 3})
    assert len(caught.value.reasons) == 3
    assert "[pictures.b]: zoom can't be 'far'" in caught.value.reasons[1]


def test_the_static_picture_has_the_limits(panel: Panel, front_end: FrontEnd) -> None:
    shown(panel, front_end, "deep")
    before = panel._static_html()
    change(panel, front_end, "deep", limits=[880, 1360])
    assert panel._static_html() != before
