"""The inputs of image sets, and their names."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.batch.items import Item, image_set, items_of, payload_of
from epypes.errors import ImageFileError, ScaleError


@pytest.fixture
def stereo():
    cg = ep.CompGraph({"difference": cv2.absdiff}, {"difference": (("left", "right"), "out")})
    return ep.CompGraphRunner(cg)


def names(images, runner):
    return [item.name for item in items_of(images, runner)]


def test_a_folder_gives_its_images_by_name_with_numbers_in_order(folder, runner):
    assert names(folder, runner) == [f"crop{number}.png" for number in range(12)]
    assert names(str(folder), runner) == names(folder, runner)


def test_a_glob_gives_names_relative_to_its_fixed_part(folder, runner):
    (folder / "more").mkdir()
    (folder / "crop7.png").rename(folder / "more" / "crop7.png")
    assert names(str(folder / "crop1*.png"), runner) == ["crop1.png", "crop10.png", "crop11.png"]
    assert "more/crop7.png" in names(str(folder / "**" / "*.png"), runner)


def test_a_folder_whose_name_has_marks_of_a_glob_is_a_folder(folder, runner):
    marked = folder.rename(folder.with_name("set[1]"))
    assert len(names(str(marked), runner)) == 12


def test_one_file_is_a_set_of_one(folder, runner):
    assert names(folder / "crop3.png", runner) == ["crop3.png"]


def test_arrays_are_named_by_their_place_and_paths_by_themselves(folder, runner, crops):
    path = folder / "crop0.png"
    assert names([crops[0], str(path), path], runner) == ["#0", str(path), str(path)]


def test_items_are_taken_one_by_one(runner, crops):
    taken = []

    def images():
        for crop in crops:
            taken.append(crop)
            yield crop

    items = items_of(images(), runner)
    assert not taken
    next(items)
    assert len(taken) == 1


def test_an_item_by_token_names_exactly_the_free_source_tokens(stereo, crops):
    (item,) = items_of([{"left": crops[0], "right": crops[1]}], stereo)
    assert set(item.payload) == {"left", "right"}
    with pytest.raises(ScaleError, match=r"Item #0 gives left; the graph's free source tokens are: left, right"):
        list(items_of([{"left": crops[0]}], stereo))
    with pytest.raises(ScaleError, match=r"item #0 is one value. Give dicts: \[\{'left': \.\.\., 'right': \.\.\.\}"):
        list(items_of([crops[0]], stereo))


def test_a_folder_for_two_tokens_is_refused_at_once(stereo, folder):
    with pytest.raises(ScaleError, match="gives one image"):
        items_of(folder, stereo)


def test_an_empty_set_says_what_was_looked_at(tmp_path, runner):
    with pytest.raises(ScaleError, match=r"There are no images in folder .*\.png"):
        items_of(tmp_path, runner)
    with pytest.raises(ScaleError, match=r"No file matches '.*nothing\*'"):
        items_of(str(tmp_path / "nothing*"), runner)
    with pytest.raises(ScaleError, match="There is no folder or file"):
        items_of(tmp_path / "nowhere", runner)
    with pytest.raises(ScaleError, match="The image set is empty: the list gave nothing"):
        list(items_of([], runner))


@pytest.mark.parametrize(
    ("images", "said"),
    [
        ({"image": 1}, "is one dict"),
        (np.zeros((4, 5), np.uint8), "Give a list of images"),
        (np.zeros((4, 5, 3), np.uint8), "Give a list of images"),
        (7, "images can't be 'int'"),
        (b"abc", "content of a file is. Give the path"),
        (bytearray(b"abc"), "imdecode"),
        ([None], "is None"),
    ],
)
def test_what_is_no_set_of_images_is_refused_with_the_way_out(images, said, runner):
    with pytest.raises(ScaleError, match=said):
        list(items_of(images, runner))


def test_a_stack_of_images_is_a_set(runner, crops):
    assert names(np.stack(crops), runner) == [f"#{number}" for number in range(12)]


def test_files_are_read_in_the_order_of_the_tokens_colours(folder, crops):
    def first(image: ep.Image(order="rgb")):
        return image

    cg = ep.CompGraph({"first": first}, {"first": ("image", "out")})
    (item,) = items_of(folder / "crop0.png", ep.CompGraphRunner(cg))
    assert np.array_equal(payload_of(item, cg)["image"], crops[0][..., ::-1])


def test_files_are_found_from_another_folder_too(folder, runner, monkeypatch):
    monkeypatch.chdir(folder)
    items = [*items_of(["crop0.png"], runner), *items_of(".", runner)]
    monkeypatch.chdir("/")
    assert [item.name for item in items[:2]] == ["crop0.png", "crop0.png"]
    assert all(payload_of(item, runner.cg)["image"].shape == (100, 150, 3) for item in items)


def test_a_text_by_token_stays_a_text_and_a_missing_file_raises_when_it_is_read(runner):
    text = Item(0, "#0", {"image": "no path"})
    assert payload_of(text, runner.cg) == {"image": "no path"}
    (missing,) = items_of(["nowhere.png"], runner)
    with pytest.raises(ImageFileError, match=r"nowhere\.png"):
        payload_of(missing, runner.cg)


def test_a_text_by_token_is_a_file_if_it_has_the_ending_of_one_and_is_there(folder, stereo, tmp_path, monkeypatch):
    np.save(tmp_path / "right.npy", np.ones((100, 150, 3), np.uint8))
    (tmp_path / "note").write_text("no image")
    monkeypatch.chdir(folder)
    (item,) = items_of([{"left": "crop0.png", "right": str(tmp_path / "right.npy")}], stereo)
    assert item.name == f"crop0.png, {tmp_path / 'right.npy'}"
    assert {token: value.shape for token, value in payload_of(item, stereo.cg).items()} == dict.fromkeys(
        ("left", "right"), (100, 150, 3)
    )
    texts = {"left": "nowhere.png", "right": str(tmp_path / "note")}
    (item,) = items_of([texts], stereo)
    assert payload_of(item, stereo.cg) == texts


def test_how_many_there_are_is_known_without_going_through_them(folder, crops):
    assert image_set(folder).count == 12
    assert image_set(crops).count == 12
    assert image_set(iter(crops)).count is None
