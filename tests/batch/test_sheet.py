"""The contact sheet of a sweep: where each outcome stands, and the size of its page."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.batch.contact_sheet import Tile
from epypes.batch.results import short_text
from epypes.batch.thumbnails import Thumbnail
from epypes.display.text import CHARACTERS, THUMBNAIL_CHARACTERS
from epypes.errors import ScaleError, UnknownName


def shifted(image: Any, offset: int, gain: int) -> Any:
    if offset == 13:
        raise ValueError("13 is <no> offset")
    return (image * gain + offset).astype(np.uint8)


def mean(bright: Any, power: int) -> float:
    return float(bright.mean()) ** power


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    cg = ep.CompGraph(
        {"shifted": shifted, "mean": mean},
        {"shifted": (("image", "offset", "gain"), "bright"), "mean": (("bright", "power"), "level")},
    )
    runner = ep.CompGraphRunner(cg, {"offset": 0, "gain": 1, "power": 1})
    runner.run(image=np.random.default_rng(0).integers(0, 255, (96, 128), dtype=np.uint8))
    return runner


def places(rows: tuple[tuple[tuple[Tile, ...], ...], ...]) -> list[list[list[int]]]:
    return [[[tile.place for tile in cell] for cell in row] for row in rows]


def test_the_first_two_that_vary_are_rows_and_columns(runner: ep.CompGraphRunner) -> None:
    sheet = ep.sweep(runner, {"offset": [1, 2], "power": [1], "gain": [1, 2, 3]}).sheet()
    assert (sheet.rows, sheet.columns) == ("offset", "gain")
    assert (sheet.row_labels, sheet.column_labels) == (("1", "2"), ("1", "2", "3"))
    assert [places(block.rows) for block in sheet.blocks] == [[[[0], [1], [2]], [[3], [4], [5]]]]
    assert sheet.token == "bright"


def test_rows_and_columns_can_be_exchanged_and_one_is_enough(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": [1, 2], "gain": [1, 2, 3]})
    assert places(result.sheet(rows="gain").blocks[0].rows) == [[[0], [3]], [[1], [4]], [[2], [5]]]
    assert result.sheet(columns="offset") == result.sheet(rows="gain", columns="offset")


def test_a_third_that_varies_and_several_images_give_further_blocks(runner: ep.CompGraphRunner) -> None:
    images = [np.zeros((9, 9), np.uint8), np.ones((9, 9), np.uint8)]
    sheet = ep.sweep(runner, {"offset": [1, 2], "gain": [1, 2], "power": [1, 2]}, images).sheet()
    assert [block.title for block in sheet.blocks] == ["#0, power 1", "#0, power 2", "#1, power 1", "#1, power 2"]
    assert [places(block.rows) for block in sheet.blocks[:2]] == [[[[0], [2]], [[4], [6]]], [[[1], [3]], [[5], [7]]]]
    assert all(tile.label == "" for tile in sheet.tiles)


def test_settings_that_fill_no_table_stand_one_after_another_each_with_its_label(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": (0, 9), "gain": (1, 5)}, how="latin", n=5)
    sheet = result.sheet()
    assert (sheet.rows, sheet.columns) == (None, None)
    assert [tile.label for tile in sheet.tiles] == [
        f"offset {one.setting['offset']}, gain {one.setting['gain']}" for one in result
    ]
    laid = result.sheet(rows="gain")
    assert sorted(tile.place for tile in laid.tiles) == [0, 1, 2, 3, 4]
    assert all(tile.label.startswith("offset ") for tile in laid.tiles)


def test_zeros_of_either_sign_are_two_values_since_both_are_run(runner: ep.CompGraphRunner) -> None:
    sheet = ep.sweep(runner, {"offset": [0.0, -0.0], "gain": [(0.0,), (-0.0,), (0.0,)]}).sheet()
    assert (sheet.row_labels, sheet.column_labels) == (("0.0", "-0.0"), ("(0.0,)", "(-0.0,)"))
    assert places(sheet.blocks[0].rows) == [[[0, 2], [1]], [[3, 5], [4]]]


def test_any_token_that_has_pictures_can_be_shown(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": [1, 2]}, show=["image"])
    assert result.sheet().token == "image"
    with pytest.raises(
        ScaleError, match=r"No pictures of 'bright'.*There are pictures of image.*Run it again with show=\('bright',\)"
    ):
        result.sheet("bright")
    with pytest.raises(UnknownName, match="Did you mean 'bright'"):
        result.sheet("brigt")
    with pytest.raises(
        UnknownName, match="No hyperparameter 'ofset' that this sweep has varied. Did you mean 'offset'"
    ):
        result.sheet(rows="ofset")
    with pytest.raises(ScaleError, match="both 'offset'"):
        result.sheet(rows="offset", columns="offset")


def test_without_pictures_values_are_shown(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"power": [0, 1]}, show=())
    assert result.sheet().tiles[0].text == "level 1.0"
    assert "level 1.0" in html_of(result)


def table_of(level: float) -> Any:
    return pd.DataFrame({"level": [level]})


def halved(level: float) -> float:
    return level / 2


def test_a_token_without_pictures_is_shown_as_text() -> None:
    cg = ep.CompGraph(
        {"mean": mean, "table": table_of, "halved": halved},
        {
            "mean": (("bright", "power"), "level"),
            "table": ("level", "table"),
            "halved": ("level", "half"),
        },
    )
    runner = ep.CompGraphRunner(cg, {"power": 1})
    runner.run(bright=np.full((9, 9), 4, np.uint8))
    result = ep.sweep(runner, {"power": [1, 2]})
    assert [tile.text for tile in result.sheet("level").tiles] == ["4.0", "16.0"]
    assert [tile.text for tile in result.sheet("half").tiles] == ["2.0", "8.0"]
    assert [tile.text for tile in result.sheet("table").tiles] == [short_text(table_of(4.0))] * 2
    assert "16.0" in html_of(result.sheet("level"))
    assert "power" not in result[0].texts
    only = ep.sweep(runner, {"power": [1, 2]}, show=())
    assert [tile.text for tile in only.sheet("half").tiles] == ["2.0", "8.0"]
    with pytest.raises(ScaleError, match=r"show=\('level',\)"):
        only.sheet("level")
    again = ep.sweep(runner, {"power": [1, 2]}, show=("level",))
    assert [tile.text for tile in again.sheet("level").tiles] == ["4.0", "16.0"]


def test_a_sheet_of_failures_needs_no_pictures(runner: ep.CompGraphRunner) -> None:
    sheet = ep.sweep(runner, {"offset": [13]}).sheet("level")
    assert [tile.has_failed for tile in sheet.tiles] == [True]


def test_an_image_of_one_value_is_told_by_it() -> None:
    cg = ep.CompGraph({"level": np.full_like}, {"level": (("image", "fill"), "flat")})
    images = [np.zeros((16, 16), np.int16), np.zeros((16, 16), np.int32), np.zeros((16, 16), np.float32)]
    result = ep.sweep(ep.CompGraphRunner(cg, {"fill": 0}), {"fill": [0, 1, 127]}, images)
    assert [tile.text for tile in result.sheet("flat").tiles] == [
        *(f"int16 16 x 16, all {level}" for level in (0, 1, 127)),
        "int32 16 x 16",
        "int32 16 x 16",
        "int32 16 x 16, all 127",
        "float32 16 x 16",
        "float32 16 x 16",
        "float32 16 x 16, all 127.0",
    ]


def html_of(shown: Any) -> str:
    return str(shown._repr_mimebundle_()["text/html"])


def test_the_page_has_a_picture_a_cell_and_marks_failures_with_their_message(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": [1, 13], "gain": [1, 2]})
    page = html_of(result)
    assert page.count("<img ") == 2
    assert page.count('class="cell failed"') == 2
    assert "13 is &lt;no&gt; offset" in page
    assert re.findall(r'<th scope="row">([^<]*)', page) == ["1", "13"]
    assert re.findall(r'<th scope="col">([^<]*)', page) == ["offset", "1", "2"]
    assert len(repr(result)) < 100
    assert len(repr(result.sheet())) < 100


def test_numbers_stand_below_their_pictures(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": [1, 13], "gain": [1]})
    level = result[0].values["level"]
    assert [tile.numbers for tile in result.sheet().tiles] == [(f"level {level:.6g}",), ()]
    assert f"<span>level {level:.6g}</span></div>" in html_of(result)
    assert result.sheet("level").tiles[0].numbers == (), "a number is its own text"


@pytest.mark.parametrize(
    ("area", "text"), [(15099.5, "15099.5"), (1234567.5, "1234568"), (0.0, "0.0"), (2e15, "2e+15"), (1e-7, "1e-07")]
)
def test_a_number_below_a_picture_is_that_of_the_table_without_an_exponent(area: float, text: str) -> None:
    cg = ep.CompGraph(
        {"bright": lambda image, gain: image * gain, "area": lambda bright: area},
        {"bright": (("image", "gain"), "bright"), "area": ("bright", "area")},
    )
    runner = ep.CompGraphRunner(cg, {"gain": 1})
    runner.run(image=np.ones((8, 8), np.uint8))
    result = ep.sweep(runner, {"gain": [1]})
    assert result.sheet("bright").tiles[0].numbers == (f"area {text}",)


def test_a_map_has_a_sheet_too_with_what_failed_first(runner: ep.CompGraphRunner) -> None:
    images = [np.full((9, 9), value, np.uint8) for value in (1, 2)]
    result = ep.map(runner, [images[0], "nowhere.png", images[1]], show=["bright"])
    sheet = result.sheet()
    assert (sheet.token, sheet.rows, sheet.columns, [block.title for block in sheet.blocks]) == (
        "bright",
        None,
        None,
        [""],
    )
    assert [(tile.label, tile.has_failed, tile.numbers) for tile in sheet.tiles] == [
        ("nowhere.png", True, ()),
        ("#0", False, ("level 1.0",)),
        ("#2", False, ("level 2.0",)),
    ]
    with pytest.raises(ScaleError, match="No pictures of 'image' were kept"):
        result.sheet("image")


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 30, 130, 700])
def test_the_page_is_no_larger_than_other_pictures_and_says_what_is_left_out(
    runner: ep.CompGraphRunner, count: int
) -> None:
    result = ep.sweep(runner, {"offset": list(range(20, 25)), "gain": list(range(count // 5))})
    page = html_of(result)
    assert len(page) <= CHARACTERS + THUMBNAIL_CHARACTERS
    pictures = page.count("<img ")
    assert pictures == min(count, pictures)
    assert pictures >= min(count, 25)
    left_out = re.search(r"and ([\d,]+) more", page)
    assert (left_out is None) == (pictures == count)
    if left_out is not None:
        assert int(left_out[1].replace(",", "")) == count - pictures


def test_what_can_not_be_painted_is_told_as_text(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"offset": [1, 2]})
    outcomes = tuple(
        replace(one, thumbnails={"bright": Thumbnail("image/png", b"no picture" * 9_000, "")}) for one in result
    )
    bundle = replace(result, outcomes=outcomes)._repr_mimebundle_()
    assert list(bundle) == ["text/plain"]
    assert bundle["text/plain"].startswith(f"{result!r}\n(no picture: ")


def test_a_cut_sheet_keeps_its_labels_beside_their_rows(runner: ep.CompGraphRunner) -> None:
    sheet = ep.sweep(runner, [{"offset": 1, "gain": 1}, {"offset": 2, "gain": 2}, {"offset": 3, "gain": 3}]).sheet(
        rows="offset", columns="gain"
    )
    assert places(sheet.first(2).blocks[0].rows) == [[[0], [], []], [[], [1], []]]
    assert sheet.first(3) == sheet
    assert sheet.first(0).tiles == ()


def test_the_same_sweep_gives_the_same_page(runner: ep.CompGraphRunner) -> None:
    assert html_of(ep.sweep(runner, {"offset": [1, 2]})) == html_of(ep.sweep(runner, {"offset": [1, 2]}))
