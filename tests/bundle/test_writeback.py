"""Do tuned values get into a bundle, in those lines alone, and does it prove what it computes afterwards?"""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify, write_back
from epypes.bundle.manifest import digest
from epypes.bundle.writeback import changed_settings
from epypes.errors import BundleError, HyperparameterError, UnknownName

HPARAMS = {"side": 5, "lo": 70, "hi": 200.0}


@pytest.fixture(scope="module")
def promoted(tmp_path_factory):
    cg = ep.CompGraph(
        {"smooth": cv2.medianBlur, "canny": cv2.Canny},
        {"smooth": (("image", "side"), "smoothed"), "canny": (("smoothed", "lo", "hi"), "edges")},
    )
    runner = ep.CompGraphRunner(cg, HPARAMS)
    runner.run(image=np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8))
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges", ["edges", "smoothed"])


@pytest.fixture
def folder(promoted, tmp_path):
    return shutil.copytree(promoted.path, tmp_path / "edges")


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_values_are_written_in_their_lines_alone_and_the_bundle_proves_them(folder):
    before = contents(folder)
    expected = write_back(folder, {"lo": 30, "hi": 90.5}, dry_run=True)
    assert contents(folder) == before
    assert not [*folder.parent.glob(".*")]
    done = write_back(folder, {"lo": 30, "hi": 90.5, "side": 5})
    assert done == expected
    changed = [line for line in done.diff.splitlines() if line[0] in "+-" and line[:3] not in ("---", "+++")]
    assert changed == ["-value = 70", "+value = 30", "-value = 200.0", "+value = 90.5"]
    assert done.digest == digest(folder) != before
    assert ep.load(folder).hyperparameters == {"side": 5, "lo": 30, "hi": 90.5}
    assert verify(folder).identical
    after = contents(folder)
    assert {name for name in after if after[name] != before[name]} == {
        "MANIFEST.sha256", "pipeline.toml", "samples/000.npz"
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_values_that_a_function_refuses_leave_the_bundle_alone(folder):
    before = contents(folder)
    with pytest.raises(BundleError, match=r"were not written back: .*function 'smooth'.*side=4.*stays as it is: try"):
        write_back(folder, {"side": 4})
    assert contents(folder) == before
    assert not [*folder.parent.glob(".*")]


@pytest.mark.slow
def test_values_that_stand_there_already_change_nothing(promoted):
    assert write_back(promoted.path, HPARAMS) == write_back(promoted.path, {})
    assert write_back(promoted.path, HPARAMS).diff == ""
    assert write_back(promoted.path, HPARAMS).digest == promoted.digest


def test_unknown_names_and_values_that_toml_can_not_hold_are_refused(folder):
    with pytest.raises(UnknownName, match="Did you mean 'side'"):
        write_back(folder, {"sidee": 3})
    with pytest.raises(
        HyperparameterError, match=r"'lo' can't be a object: .* set the value in the notebook, and promote again"
    ):
        write_back(folder, {"lo": object()})
    (folder / "pipeline.py").write_text("")
    with pytest.raises(BundleError, match="was changed"):
        write_back(folder, {"lo": 3})


TEXT = """# mine
[hyperparameters.k]  # kept
value = 3 # of pixels
low = 1

[hyperparameters.mode]
kind = "none"
choices = ["a", "b"]

[hyperparameters.box]
value = [1, 2]
kind = "tuple"
"""


@pytest.mark.parametrize(
    ("values", "old", "new"),
    [
        ({"k": 5}, "value = 3 #", "value = 5 #"),
        ({"k": 3.0}, "value = 3 #", "value = 3.0 #"),
        ({"k": np.int64(4)}, "value = 3 #", "value = 4 #"),
        ({"box": (1, 3)}, "value = [1, 2]", "value = [1, 3]"),
        ({"box": [1, 2]}, 'kind = "tuple"\n', ""),
    ],
)
def test_comments_ranges_and_other_lines_stay(values, old, new):
    assert changed_settings(TEXT, values) == TEXT.replace(old, new)


def test_a_value_that_was_none_gets_one_and_keeps_its_choices():
    import tomllib

    entry = tomllib.loads(changed_settings(TEXT, {"mode": "b"}))["hyperparameters"]["mode"]
    assert entry == {"value": "b", "choices": ["a", "b"]}
    entry = tomllib.loads(changed_settings(TEXT, {"k": None}))["hyperparameters"]["k"]
    assert entry == {"kind": "none", "low": 1}
