"""``epypes check`` reports each case, by its output, its exit status and JUnit XML."""

from __future__ import annotations

import json
import re
import shutil
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest
from skimage import data

import epypes as ep
from epypes.acquisition import write_image


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A bundle, two images and what is expected of one of them."""
    folder = tmp_path_factory.mktemp("labelled")
    runner = ep.CompGraphRunner(
        ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")}), {"lo": 70, "hi": 200}
    )
    coins, camera = data.coins(), data.camera()
    run = runner.run(image=coins)
    ep.promote(runner, folder / "edges")
    write_image(folder / "coins.png", coins)
    write_image(folder / "camera.png", camera)
    write_image(folder / "coins_edges.png", run["edges"])
    np.save(folder / "camera_edges.npy", cv2.Canny(camera, 30, 200))
    return folder


CASES = """
[[case]]
inputs = {image = "coins.png"}
[[case.check]]
expected = "coins_edges.png"
[[case.check]]
metric = "count"
of = "nonzero"
min = 1000

[[case]]
name = "camera"
inputs = {image = "camera.png"}
hyperparameters = {lo = LO}
[[case.check]]
expected = "camera_edges.npy"
metric = "iou"
min = 0.99
"""


@pytest.fixture
def cases(labelled, tmp_path):
    """Return a file of cases with this threshold, beside its images, but not in the working folder."""

    def written(lo):
        path = shutil.copytree(labelled, tmp_path / f"labelled {lo}") / "cases.toml"
        path.write_text(CASES.replace("LO", str(lo)))
        return path

    return written


@pytest.mark.slow
def test_a_set_that_passes_exits_with_0(labelled, cases, epypes, tmp_path):
    junit = tmp_path / "checks.xml"
    done = epypes("check", labelled / "edges", cases(30), "--junit", junit)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == f"{labelled / 'edges'}: 2 cases passed, 3 checks in all."
    [suite] = ET.parse(junit).getroot()
    assert [suite.get(key) for key in ("name", "tests", "failures", "errors")] == ["epypes check edges", "3", "0", "0"]


def test_a_set_that_fails_exits_with_1_and_says_which_case_and_why(labelled, cases, epypes, tmp_path):
    junit, path = tmp_path / "checks.xml", cases(90)
    done = epypes("check", labelled / "edges", path, "--junit", junit)
    assert done.returncode == 1
    assert "camera" in done.stdout
    assert "iou of edges" in done.stdout
    assert "coins" not in done.stdout
    [line] = done.stderr.strip().splitlines()
    assert line.startswith(f"epypes: {labelled / 'edges'} does not pass {path}: 1 of 2 cases failed: camera. First: ")
    assert line.endswith("is not at least 0.99.")
    [suite] = ET.parse(junit).getroot()
    assert [len(test) for test in suite] == [0, 0, 1]


def things(n):
    class Uncountable:
        def __len__(self):
            raise AssertionError

    return [0] * n if n > 0 else Uncountable()


@pytest.mark.slow
def test_a_metric_that_raises_without_a_text_exits_with_1_and_is_an_error(epypes, tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"things": things}, {"things": ("n", "found")}))
    runner.run(n=3)
    ep.promote(runner, tmp_path / "things")
    path, junit = tmp_path / "cases.toml", tmp_path / "checks.xml"
    path.write_text('[[case]]\ninputs = {n = 0}\n[[case.check]]\nmetric = "count"\nmin = 1\n')
    done = epypes("check", tmp_path / "things", path, "--junit", junit)
    assert done.returncode == 1
    assert done.stderr.strip().endswith("First: #0, count of found: AssertionError.")
    [suite] = ET.parse(junit).getroot()
    assert [suite.get(key) for key in ("tests", "failures", "errors")] == ["1", "0", "1"]


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("new/dir/j.xml", "there is no folder .*new/dir'. Make it, or name another"),
        (".", "is a folder. Name a file in"),
    ],
)
def test_where_no_xml_can_be_written_is_told_before_anything_is_run(labelled, cases, epypes, tmp_path, place, said):
    path = cases(90)
    (path.parent / "coins.png").unlink()
    done = epypes("check", labelled / "edges", path, "--junit", tmp_path / place)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.search(said, done.stderr)


def test_the_reason_of_a_failure_has_one_full_stop(labelled, epypes, tmp_path):
    text = '[[case]]\ninputs = {image = "../coins.png"}\n[[case.check]]\nmetric = "count"\nmin = 1\n'
    (tmp_path / "cases.toml").write_text(text.replace("../coins.png", str(labelled / "coins.png")))
    done = epypes("check", labelled / "edges", tmp_path / "cases.toml")
    assert done.returncode == 1
    assert done.stderr.strip().endswith("give of='items', 'nonzero' or 'labels'.")


def test_json_has_every_check(labelled, cases, epypes):
    done = epypes("check", labelled / "edges", cases(90), "--json")
    found = json.loads(done.stdout)
    assert (found["passed"], found["cases"]) == (False, {"coins.png": True, "camera": False})
    assert [check["check"] for check in found["checks"]] == ["equal of edges", "count of edges", "iou of edges"]
    assert found["checks"][2]["value"] < 0.99
    assert found["checks"][2]["reason"].endswith("is not at least 0.99")
