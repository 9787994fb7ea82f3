"""Two promotions differ in git by what was changed, and the one before is a folder away."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

import epypes as ep
from epypes.bundle import verify
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

CELL = """\
import enum

import epypes as ep

# How much brighter.
GAIN = 3
OFFSETS = (1, 2)


class Way(enum.Enum):
    UP = 1
    DOWN = 2


# Multiplies.
def brighten(image):
    return image * GAIN


def shift(bright, way):
    step = sum(OFFSETS)
    return bright + step if way is Way.UP else bright - step
"""


def promoted(source: str, folder: Path, way: str = "UP") -> Path:
    names = cell(source)
    inner = ep.Pipeline("inner", ep.CompGraph({"brighten": names["brighten"]}, {"brighten": ("im", "bright")}))
    cg = ep.CompGraph(
        {"inner": inner, "shift": names["shift"]}, {"inner": ("image", "bright"), "shift": (("bright", "way"), "y")}
    )
    runner = ep.CompGraphRunner(cg, {"way": names["Way"][way]})
    runner.run(image=5)
    return ep.promote(runner, folder / "bright").path


def changed_lines(one: Path, other: Path) -> dict[str, list[str]]:
    """Return the lines that git shows as changed, by file; of binary files, and of the seal, none."""
    done = subprocess.run(
        ["git", "diff", "--no-index", "--unified=0", "--no-color", one, other],
        capture_output=True, text=True, env={**os.environ, "GIT_CONFIG_GLOBAL": os.devnull},
    )  # fmt: skip
    found: dict[str, list[str]] = {}
    name = ""
    for line in done.stdout.splitlines():
        if line.startswith("diff --git"):
            name = line.rpartition("/")[2]
        elif line[:1] in "+-" and not line.startswith(("+++", "---")):
            found.setdefault(name, []).append(line)
    found.pop("MANIFEST.sha256")
    return found


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    return promoted(CELL, tmp_path_factory.mktemp("first"))


def test_a_changed_constant_changes_its_line(first, tmp_path):
    second = promoted(CELL.replace("GAIN = 3", "GAIN = 4"), tmp_path)
    assert changed_lines(first, second) == {"pipeline.py": ["-GAIN = 3", "+GAIN = 4"]}


def test_a_changed_function_changes_its_lines(first, tmp_path):
    second = promoted(CELL.replace("sum(OFFSETS)", "max(OFFSETS)"), tmp_path)
    expected = ["-    step = sum(OFFSETS)", "+    step = max(OFFSETS)"]
    assert changed_lines(first, second) == {"pipeline.py": expected}


def test_a_changed_hyperparameter_changes_its_line(first, tmp_path):
    second = promoted(CELL, tmp_path, way="DOWN")
    expected = ['-value = "UP"', '+value = "DOWN"']
    assert changed_lines(first, second) == {"pipeline.toml": expected}


def test_another_cell_in_front_and_the_same_cells_run_again_change_nothing(first, tmp_path):
    cell("K = 1\n")
    assert promoted(CELL, tmp_path)
    contents = [
        {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
        for folder in (first, tmp_path / "bright")
    ]
    assert contents[0] == contents[1]


def test_rolling_back_is_pointing_at_another_folder(first, tmp_path):
    second = promoted(CELL.replace("GAIN = 3", "GAIN = 4"), tmp_path / "second")
    current = tmp_path / "current"
    current.symlink_to(second)
    assert ep.load(current).run(image=5)["y"] == 23
    current.unlink()
    current.symlink_to(first)
    assert ep.load(current).run(image=5)["y"] == 18
    assert verify(current).identical
