"""State between runs goes into a bundle: the module says it, loading begins with it, samples are replayed with it."""

from __future__ import annotations

import queue
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import epypes as ep
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.bundle.settings import read_settings
from epypes.errors import BundleError, PromotionRefused
from epypes.wire import Envelope
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

CELL = """\
import cv2
import numpy as np

import epypes as ep

MAP = np.linspace(0, 1, 1000).reshape(20, 50)


def smooth(x, before, k):
    return x if before is None else k * x + (1 - k) * before


def scale(value, by):
    return value * by


def add(image, total):
    return image + total
"""


def smoothing(names):
    cg = ep.CompGraph(
        {"smooth": names["smooth"], "scale": names["scale"]},
        {"smooth": (("x", "before", "k"), "smoothed"), "scale": (("smoothed", "by"), "y")},
    )
    return ep.delay(cg, "smoothed", "before")


def adding(names):
    """Return a graph whose state begins with a large array, beside that of a nested pipeline."""
    inner = ep.Pipeline("inner", smoothing(names), {"k": 0.5, "by": 10})
    cg = ep.CompGraph(
        {"add": names["add"], "inner": inner, "mean": names["np"].mean},
        {"add": (("image", "total"), "sum"), "mean": ("sum", "x"), "inner": ("x", "y")},
    )
    return ep.delay(cg, "sum", "total", names["MAP"])


@pytest.fixture(scope="module")
def names():
    return cell(CELL)


class Promoted:
    """A runner with state, its bundle, and what it computes of a series."""

    def __init__(self, names, folder: Path) -> None:
        self.runner = ep.CompGraphRunner(adding(names))
        self.images = [np.full((20, 50), float(number)) for number in range(4)]
        self.series = [self.runner.run(image=image)["y"] for image in self.images]
        self.runner.reset()
        self.runner.run(image=self.images[0])
        self.bundle = ep.promote(self.runner, folder)


@pytest.fixture(scope="module")
def promoted(names, tmp_path_factory):
    return Promoted(names, tmp_path_factory.mktemp("bundles") / "adding")


def test_the_module_says_the_delays_and_linters_leave_it_as_it_is(promoted, tmp_path):
    text = (promoted.bundle.path / "pipeline.py").read_text()
    assert 'cg = ep.delay(cg, "sum", "total", initial=stored_array("total"))' in text
    assert '"smoothed",\n        "before",\n        initial=None,\n' in text
    (tmp_path / "pipeline.py").write_text(text)
    for command in (["check"], ["format", "--check", "--diff"]):
        ruff = Path(sys.executable).with_name("ruff")
        options = ["--isolated", "--no-cache", "pipeline.py"]
        done = subprocess.run([ruff, *command, *options], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def test_the_settings_name_the_states_and_no_event_brings_them(promoted):
    settings = read_settings(promoted.bundle.path / "pipeline.toml")
    assert settings.states == {"total": "sum", "inner.before": "inner.smoothed"}
    assert (settings.inputs, settings.outputs) == (("image",), ("y",))


def test_a_loaded_runner_begins_with_the_initial_state(promoted):
    again = ep.load(promoted.bundle.path)
    assert again.state.keys() == promoted.runner.state.keys()
    assert again.state["total"].tobytes() == np.linspace(0, 1, 1000).tobytes()
    assert [again.run(image=image)["y"] for image in promoted.images] == promoted.series
    again.reset()
    assert again.run(image=promoted.images[0])["y"] == promoted.series[0]


def test_a_loaded_pipeline_answers_a_series_that_begins_with_the_initial_state(promoted):
    q_in, q_out = queue.Queue(), queue.Queue()
    with ep.load_pipeline(promoted.bundle.path, q_in, q_out):
        for image in promoted.images:
            q_in.put(Envelope("frame", {"image": image}))
        assert [q_out.get(timeout=60).parts["y"] for _ in promoted.images] == promoted.series


def test_a_bundle_with_state_is_promoted_again_to_the_same_text(promoted, tmp_path):
    again = ep.load(promoted.bundle.path)
    again.run(image=promoted.images[0])
    other = ep.promote(again, tmp_path / "adding")
    for name in ("pipeline.py", "pipeline.toml", "arrays/total.npy"):
        assert (other.path / name).read_bytes() == (promoted.bundle.path / name).read_bytes()


def test_another_delay_or_initial_value_is_another_bundle(names, tmp_path):
    digests = set()
    for number, initial in enumerate((0.0, -0.0, float("nan"), 0)):
        cg = ep.CompGraph({"smooth": names["scale"]}, {"smooth": (("x", "before"), "y")})
        runner = ep.CompGraphRunner(ep.delay(cg, "y", "before", initial))
        runner.run(x=1)
        bundle = ep.promote(runner, tmp_path / f"{number}")
        digests.add(bundle.digest)
        ((key, value),) = ep.load(bundle.path).state.items()
        assert (key, repr(value)) == ("before", repr(initial))
    assert len(digests) == 4


def test_states_that_module_and_settings_name_otherwise_are_refused(promoted, tmp_path):
    folder = shutil.copytree(promoted.bundle.path, tmp_path / "adding")
    settings = folder / "pipeline.toml"
    settings.write_text(settings.read_text().replace('total = "sum"\n', ""))
    write_manifest(folder)
    with pytest.raises(BundleError, match=r"other states between runs: .'total', 'sum'.*Promote the graph again"):
        read_bundle(folder)


def test_an_initial_value_that_no_expression_makes_is_refused_with_the_way_out(names, tmp_path):
    cg = ep.delay(ep.CompGraph({"scale": names["scale"]}, {"scale": (("x", "model"), "y")}), "y", "model", object())
    runner = ep.CompGraphRunner(cg)
    runner.state = {"model": 2}
    runner.run(x=1)
    with pytest.raises(PromotionRefused, match="initial value of 'model' is of type object.*get") as refused:
        ep.promote(runner, tmp_path / "model")
    assert 'ep.delay(cg, "y", "model", initial=None)' in str(refused.value)
