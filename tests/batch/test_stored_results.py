"""Stored results of a map, a sweep or a search are taken for the same inputs only."""

from __future__ import annotations

import os
import shutil
import threading

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import ScaleError
from tests.batch.conftest import runner_of


def above(image, level):
    return int((image > level).sum())


def difference(left, right):
    return float(left.mean()) - float(right.mean())


def total(image):
    return float(sum(np.asarray(part, float).sum() for part in image))


def strength(keypoints):
    return float(sum(one.response for one in keypoints))


@pytest.fixture
def store(tmp_path):
    with ep.Store(tmp_path / "results.sqlite") as opened:
        yield opened


@pytest.fixture
def files(tmp_path):
    for name, level in (("a.png", 100), ("b.png", 10)):
        cv2.imwrite(str(tmp_path / name), np.full((20, 20), level, np.uint8))
    return tmp_path / "a.png", tmp_path / "b.png"


def rows(store, kind="map"):
    return sum(len(store.series(kind, name)) for name in store.names(kind))


def stored(runner, images, store):
    """The values of a map with a store, which must be those without one."""
    found = [outcome.values["out"] for outcome in ep.map(runner, images, store=store)]
    assert found == [outcome.values["out"] for outcome in ep.map(runner, images)]
    return found


def test_a_file_with_other_values_beside_it_is_another_item(files, store):
    runner = runner_of(above, "image", "level")
    items = [{"image": files[0], "level": level} for level in (50, 150)]
    for _ in range(2):
        assert stored(runner, items, store) == [400, 0]
    masks = [{"image": files[0], "level": np.full((20, 20), level)} for level in (1, 200)]
    assert stored(runner, masks[:1], store) == [400]
    assert stored(runner, masks[1:], store) == [0]


def test_two_files_exchanged_are_another_item(files, store):
    runner = runner_of(difference, "left", "right")
    left, right = files
    assert stored(runner, [{"left": left, "right": right}], store) == [90.0]
    assert stored(runner, [{"right": left, "left": right}], store) == [-90.0]
    assert stored(runner, [{"right": right, "left": left}], store) == [90.0]
    assert rows(store) == 2, "the order in which tokens are given says nothing"


def test_sweeps_tell_values_beside_a_file_too(files, store):
    runner = runner_of(lambda image, level, gain: above(image, level) * gain, "image", "level", "gain", gain=1)
    items = [{"image": files[0], "level": level} for level in (50, 150)]
    for _ in range(2):
        found = ep.sweep(runner, {"gain": [1, 2]}, items, store=store, name="s")
        assert [one.values["out"] for one in found] == [400, 800, 0, 0]


@pytest.mark.slow
def test_searches_tell_values_beside_a_file_too(files, store):
    runner = runner_of(above, "image", "level", level=50)
    options = {"n": 1, "ranges": {"level": [50]}, "store": store}
    first = ep.optimize(runner, "out", [{"image": np.full((2, 2), 100)}], **options)
    second = ep.optimize(runner, "out", [{"image": np.full((2, 2), 10)}], **options)
    assert [first.best_value, second.best_value] == [4.0, 0.0]


def test_folders_of_equal_names_sizes_and_times_share_nothing(tmp_path, store):
    runner = runner_of(lambda image: float(image.mean()), "image")
    for number, day in enumerate(("day1", "day2")):
        (tmp_path / day).mkdir()
        file = tmp_path / day / "0.bmp"
        cv2.imwrite(str(file), np.full((20, 20), 10 + 100 * number, np.uint8))
        os.utime(file, (0, 0))
        assert stored(runner, tmp_path / day, store) == [10.0 + 100 * number]


def test_a_folder_that_was_moved_or_copied_goes_on(folder, tmp_path, store):
    runner = runner_of(lambda image: float(image.mean()), "image")
    before = ep.map(runner, folder, store=store)
    shutil.copytree(folder, tmp_path / "copied", copy_function=shutil.copyfile)
    shutil.move(folder, tmp_path / "moved")
    for name in ("moved", "copied"):
        assert list(ep.map(runner, tmp_path / name, store=store)) == list(before)
    assert rows(store) == 12


@pytest.mark.parametrize(
    "given",
    [
        lambda image: {"image": [image, image]},
        lambda image: {"image": (image,)},
        lambda image: np.ma.masked_equal(image, 255),
        lambda image: {"image": {"left": image}.values()},
    ],
    ids=["list", "tuple", "masked", "of nobody knows what"],
)
def test_values_that_are_no_plain_arrays_are_compared_by_content(given, store):
    runner = runner_of(total, "image")
    for level in (10, 200):
        image = np.zeros((100, 100), np.uint8)
        image[40:60, 40:60] = level
        assert stored(runner, [given(image)], store)


def test_keypoints_are_compared_by_content(store):
    runner = runner_of(strength, "keypoints")
    for _ in range(2):
        for response in range(10):
            keypoints = [cv2.KeyPoint(1, 1, 1, 1, float(response))]
            assert stored(runner, [{"keypoints": keypoints}], store) == [float(response)]
    assert rows(store) == 10


def test_an_item_without_a_digest_is_run_each_time_and_not_written(store):
    class Frame(threading.local):
        def __init__(self, level):
            self.level = level

    runner = runner_of(lambda frame: frame.level, "frame")
    for level in (1, 2):
        assert ep.map(runner, [{"frame": Frame(level)}], store=store, name="n")[0].values == {"out": level}
    assert rows(store) == 0


def test_hyperparameters_in_tuples_are_compared_by_content(store):
    image = np.zeros((2, 2))
    table = np.zeros(5000)
    runner = runner_of(lambda image, tables: float(tables[0].sum()), "image", "tables", tables=(table.copy(),))
    assert stored(runner, [image], store) == [0.0]
    table[2500] = 7
    runner["tables"] = (table,)
    assert stored(runner, [image], store) == [7.0]


def test_a_hyperparameter_without_a_digest_is_refused_by_name(store):
    runner = runner_of(lambda image, model: 1, "image", "model", model=cv2.ORB_create())
    with pytest.raises(ScaleError, match=r"Hyperparameter 'model' is or holds a 'ORB'"):
        ep.map(runner, [np.zeros((2, 2))], store=store, name="n")


def test_settings_with_arrays_are_compared_by_content(store):
    runner = runner_of(lambda image, table: float(table[0].sum()), "image", "table", table=(np.zeros(1),))
    for level in (1.0, 2.0):
        table = np.zeros(5000)
        table[2500] = level
        (found,) = ep.sweep(runner, [{"table": (table,)}], [np.zeros((2, 2))], store=store, name="s")
        assert found.values["out"] == level


# -- what can't be written --------------------------------------------------------------------------------------


def number_of(image):
    return 10**5000 if image.flat[0] == 3 else int(image.flat[0])


def levels(count):
    return [np.full((3, 3), level) for level in range(count)]


def test_a_number_too_long_to_be_read_is_a_short_text_and_the_others_are_stored(store):
    runner = runner_of(number_of, "image")
    for _ in range(2):
        found = [one.values["out"] for one in ep.map(runner, levels(6), store=store)]
        assert found == [0, 1, 2, "int of 16,610 bits", 4, 5]
    assert rows(store) == 6
    by_length = runner_of(lambda image, size: size % 10, "image", "size", size=1)
    swept = ep.sweep(by_length, {"size": [10**5000, 3]}, levels(1), store=store, name="s")
    assert [one.values["out"] for one in swept] == [0, 3]
    assert rows(store, "sweep") == 2


def test_a_generators_own_error_is_the_one_that_is_raised(tmp_path):
    def frames():
        yield from levels(3)
        (tmp_path / "r.sqlite").write_text("no database")
        raise RuntimeError("camera gone")

    with pytest.raises(RuntimeError, match="camera gone") as caught:
        ep.map(runner_of(number_of, "image"), frames(), store=tmp_path / "r.sqlite")
    assert "What waited to be stored could not be" in caught.value.__notes__[0]
