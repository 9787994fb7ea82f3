"""What tells a value from any other one?"""

from __future__ import annotations

import enum
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from epypes.batch.cache import NoDigest, file_digest, told, value_digest


class Mode(enum.Enum):
    FINE = 1
    COARSE = 2


class Measured(np.ndarray):
    unit = ""


class Corner(NamedTuple):
    x: int
    y: int


class Size(NamedTuple):
    x: int
    y: int


def image(level: int) -> np.ndarray:
    """One of which a repr shows nothing but zeros."""
    made = np.zeros((100, 100), np.uint8)
    made[40:60, 40:60] = level
    return made


def measured(unit: str) -> np.ndarray:
    made = image(1).view(Measured)
    made.unit = unit
    return made


def objects(level: int) -> np.ndarray:
    made = np.empty(2000, object)
    made[1000] = image(level)
    return made


DIFFERENT = {
    "arrays": (image(1), image(2)),
    "types of arrays": (image(1), image(1).astype(np.int8)),
    "shapes": (image(1), image(1).reshape(-1)),
    "arrays in lists": ([image(1), image(1)], [image(1), image(2)]),
    "arrays in tuples": ((image(1),), (image(2),)),
    "masked arrays": (np.ma.masked_equal(image(1), 1), np.ma.masked_equal(image(1), 0)),
    "masked levels": (np.ma.masked_equal(image(1), 9), np.ma.masked_equal(image(2), 9)),
    "what a class of arrays keeps beside the numbers": (measured("mm"), measured("inch")),
    "arrays of objects": (objects(1), objects(2)),
    "structured arrays": (np.zeros(1, [("x", int)]), np.zeros(1, [("y", int)])),
    "views of memory": (memoryview(image(1)), memoryview(image(2))),
    "keypoints": ([cv2.KeyPoint(1, 1, 1, 1, 0.5)], [cv2.KeyPoint(1, 1, 1, 1, 0.25)]),
    "members": (Mode.FINE, Mode.COARSE),
    "a member and its value": (Mode.FINE, 1),
    "a number, a float, a truth value": (1, 1.0, True, np.uint8(1), np.int64(1), "1", b"1"),
    "very long numbers": (10**9999, 10**9999 + 1),
    "where a text ends": (["ab", "c"], ["a", "bc"]),
    "what is in what": ([[1], 2], [[1, 2]], (1, 2), {1: 2}, {1, 2}),
    "named tuples": (Corner(1, 2), Size(1, 2), (1, 2)),
    "order of keys": ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "signs of zero": (0.0, -0.0),
}


@pytest.mark.parametrize("values", DIFFERENT.values(), ids=DIFFERENT)
def test_what_differs_has_another_digest_and_another_text(values):
    assert len({value_digest(value) for value in values}) == len(values)
    assert len({told(value) for value in values}) == len(values)


@pytest.mark.parametrize("level", [1, 7])
def test_an_array_in_a_file_is_told_by_what_is_in_it(tmp_path, level):
    found = []
    for number, content in enumerate((image(level), image(level), image(level + 1))):
        mapped = np.memmap(tmp_path / f"{number}.dat", np.uint8, "w+", shape=(100, 100))
        mapped[:] = content
        found.append(value_digest(mapped))
    assert found[0] == found[1] != found[2]


def test_how_an_array_lies_in_memory_says_nothing():
    there = np.arange(24).reshape(4, 6)
    assert value_digest(np.asfortranarray(there)) == value_digest(there) == value_digest(np.repeat(there, 2, 0)[::2])


def test_what_a_person_can_read_stays_readable():
    assert [told(value) for value in (70, "fine", (3, 3), None)] == ["70", "'fine'", "(3, 3)", "None"]
    assert told(Mode.FINE).startswith("Mode.FINE ")
    assert told(image(1)).startswith("uint8 (100, 100) ")


@pytest.mark.slow
def test_another_process_finds_the_same(tmp_path):
    text = "from epypes.batch.cache import value_digest; print(value_digest({'a': {'x', 'y', 'z'}, 'b': [1.5, None]}))"
    found = {
        subprocess.run(
            [sys.executable, "-c", text], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1


def holding_itself() -> list:
    made: list = []
    made.append(made)
    return made


@pytest.mark.parametrize("value", [object(), [object()], {"a": lambda: 1}, (n for n in ()), holding_itself()])
def test_what_nobody_can_look_into_is_refused(value):
    with pytest.raises(NoDigest):
        value_digest(value)


def test_a_file_is_told_by_what_is_in_it_and_how_it_is_read(tmp_path):
    for name, content in (("a.png", b"1"), ("b.png", b"1"), ("c.png", b"2"), ("a.npy", b"1")):
        (tmp_path / name).write_bytes(content)
    os.mkfifo(tmp_path / "pipe.png")
    a, b, c, npy = (file_digest(tmp_path / name) for name in ("a.png", "b.png", "c.png", "a.npy"))
    assert a == b
    assert len({a, c, npy}) == 3
    for name in ("there is none.png", "pipe.png", "."):
        with pytest.raises(NoDigest):
            file_digest(tmp_path / name)


def test_a_path_that_is_a_value_is_told_by_its_name_and_its_file(tmp_path):
    assert value_digest(Path("a.txt")) != value_digest(Path("b.txt"))
    before = value_digest(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("x")
    assert value_digest(tmp_path / "a.txt") != before
