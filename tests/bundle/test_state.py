"""State between runs goes into a bundle: the module says it, loading begins with it, samples are replayed with it."""

from __future__ import annotations

import queue
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import epypes as ep
from epypes.batch.cache import graph_fingerprint
from epypes.bundle import verify
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.bundle.proof.replay import replay
from epypes.bundle.settings import read_settings
from epypes.bundle.writeback import write_back
from epypes.errors import BundleError, PromotionRefused, ReplayDiffers
from epypes.wire import Envelope
from epypes.wire.samples import read_sample, save_sample
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

CELL = """\
import random

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


def drift(x, before):
    return before + random.random() * x


def letters(x, seen):
    return " ".join({"canny", "sobel", "scharr", "prewitt", "laplace", x, *(seen or "").split()})


def parts(x, before):
    split = np.array_split(np.sin(np.arange(10_000.0)) * x, cv2.getNumThreads() + 1)
    return before + sum(np.cumsum(part)[-1] for part in split)


def appended(x, known):
    found = dict(known or {"points": []})
    found["points"].append(x)
    return found


def tracked(x, known):
    points = known["points"] if known else []
    return {"points": [*points, cv2.KeyPoint(x, 1.0, 2.0)], "sizes": np.array([np.nan, x]), "ago": float("nan")}


def kept(x, before):
    return {"last": x, "seen": [*before.get("seen", ()), x]}


class Model:
    def __init__(self, x):
        self.x = x


def learnt(x, model):
    return Model(x)


def of_model(model):
    return model.x


def negated(x):
    return -x
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
        self.bundle = ep.promote(self.runner, folder, samples=self.images[:2])


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
    digests, fingerprints, texts = set(), set(), set()
    for number, initial in enumerate((0.0, -0.0, float("nan"), 0)):
        cg = ep.CompGraph({"smooth": names["scale"]}, {"smooth": (("x", "before"), "y")})
        runner = ep.CompGraphRunner(ep.delay(cg, "y", "before", initial))
        runner.run(x=1)
        bundle = ep.promote(runner, tmp_path / f"{number}")
        digests.add(bundle.digest)
        text = (bundle.path / "pipeline.py").read_text()
        texts.add(re.sub(r"initial=.*\)\n|graph \d", "", text))
        fingerprints.add((graph_fingerprint(runner.cg).code, graph_fingerprint(runner.cg).state))
        ((key, value),) = ep.load(bundle.path).state.items()
        assert (key, repr(value)) == ("before", repr(initial))
    assert (len(digests), len(fingerprints), len(texts)) == (4, 4, 1), "one line of the module differs"


def test_states_that_module_and_settings_name_otherwise_are_refused(promoted, tmp_path):
    folder = shutil.copytree(promoted.bundle.path, tmp_path / "adding")
    settings = folder / "pipeline.toml"
    settings.write_text(settings.read_text().replace('total = "sum"\n', ""))
    write_manifest(folder)
    with pytest.raises(BundleError, match=r"other states between runs: .'total', 'sum'.*Promote the graph again"):
        read_bundle(folder)


@pytest.fixture
def copied(promoted, tmp_path):
    """A copy of the bundle that a test may spoil."""
    return shutil.copytree(promoted.bundle.path, tmp_path / "adding")


def delayed(function, outputs=("made", "y"), previous="before", initial=None, reader=len):
    """Return a graph of a function of x and its own value before, which another function reads."""
    made, y = outputs
    cg = ep.CompGraph({"step": function, "read": reader}, {"step": (("x", previous), made), "read": (made, y)})
    return ep.delay(cg, made, previous, initial)


def states(bundle):
    """Return what each sample began with and left."""
    return [(sample.state, sample.state_after) for sample in map(read_sample, bundle.samples)]


def test_samples_are_a_sequence_from_the_last_run_and_one_run_begins_as_the_service_does(names, tmp_path):
    runner = ep.CompGraphRunner(smoothing(names), {"k": 0.5, "by": 1})
    for x in (4.0, 2.0):
        runner.run(x=x)
    runner.rerun(k=0.25)
    bundle = ep.promote(runner, tmp_path / "smooth", samples=[1.5, {"x": 7.5}])
    assert [(before["before"], after["before"]) for before, after in states(bundle)] == [
        (4.0, 3.5), (3.5, 3.0), (3.0, 4.125), (None, 2.0),
    ]  # fmt: skip
    assert dict(runner.state) == {"before": 3.5}
    report = verify(bundle.path)
    assert (report.identical, report.samples, report.tokens) == (True, 4, 8)
    runner.reset()
    runner.run(x=1.0)
    assert len(ep.promote(runner, tmp_path / "smooth").samples) == 1, "that run began as the service does"


def test_each_sample_can_be_replayed_without_those_before_it(copied):
    for name in ("000", "001"):
        (copied / "samples" / f"{name}.npz").unlink()
        write_manifest(copied)
        assert verify(copied).identical


@pytest.mark.parametrize(
    ("side", "key", "token"),
    [("state_after", "total", "sum"), ("state_after", "inner.before", "inner.smoothed"), ("state", "total", "sum")],
)
def test_a_state_that_is_not_the_recorded_one_is_found_with_its_token(copied, side, key, token):
    path = copied / "samples" / "001.npz"
    sample = read_sample(path)
    getattr(sample, side)[key] = getattr(sample, side)[key] + 1.0
    save_sample(path, **sample._asdict())
    write_manifest(copied)
    with pytest.raises(ReplayDiffers, match=f"sample 001, token '{token}': .*kept as '"):
        verify(copied)


def test_a_replay_goes_on_from_what_it_has_left_and_not_from_what_was_recorded(copied):
    first, second = (copied / "samples" / f"{name}.npz" for name in ("000", "001"))
    sample, following = read_sample(first), read_sample(second)
    for side in (sample.state_after, following.state):
        side["total"] = side["total"] + 1.0
    save_sample(first, **sample._asdict())
    save_sample(second, **following._asdict())
    found = replay(read_bundle(copied, compare=False)).differences
    assert [(entry.sample, entry.token) for entry in found] == [("000", "sum")]
    found = replay(read_bundle(copied, compare=False), twice=True).differences
    assert ("001", "y") in [(entry.sample, entry.token) for entry in found], "alone it begins as recorded"


def test_a_sample_without_the_states_of_the_settings_is_refused(copied):
    path = copied / "samples" / "001.npz"
    sample = read_sample(path)
    save_sample(path, sample.inputs, sample.outputs)
    write_manifest(copied)
    with pytest.raises(BundleError, match="Sample 001 has the states none, which are not those of pipeline.toml"):
        verify(copied)


def test_values_are_written_back_and_the_sequence_is_recorded_with_them(names, tmp_path):
    runner = ep.CompGraphRunner(smoothing(names), {"k": 0.5, "by": 1})
    for x in (4.0, 2.0):
        runner.run(x=x)
    bundle = ep.promote(runner, tmp_path / "smooth", samples=[1.0])
    assert "value = 0.25" in write_back(bundle.path, {"k": 0.25}).diff
    assert [(before["before"], after["before"]) for before, after in states(bundle)] == [
        (4.0, 3.5), (3.5, 2.875), (None, 2.0),
    ]  # fmt: skip
    assert verify(bundle.path).identical


@pytest.mark.usefixtures("fresh_interpreter")
@pytest.mark.parametrize(
    ("step", "initial", "x", "reason"),
    [
        ("drift", 0.0, 2.0, "token 'made'.*in which order function 'step' is called"),
        ("letters", None, "g", r"token 'made'.*It depends on the hash seed \(PYTHONHASHSEED\)"),
        ("appended", None, 2.0, "Function 'step' has changed its input 'before' in place"),
        (
            "learnt",
            None,
            2.0,
            "State 'before', which token 'made' leaves for the next run, .*Model, which has no codec",
        ),
    ],
)
def test_state_that_can_not_be_repeated_is_refused_with_its_token_and_the_condition(
    names, tmp_path, step, initial, x, reason
):
    readers = {"drift": names["negated"], "learnt": names["of_model"]}
    runner = ep.CompGraphRunner(delayed(names[step], initial=initial, reader=readers.get(step, len)))
    for _ in range(2):
        runner.run(x=x)
    with pytest.raises(PromotionRefused, match=reason):
        ep.promote(runner, tmp_path / "refused")


def test_noise_of_threads_in_a_state_becomes_a_tolerance_of_its_token(names, tmp_path):
    runner = ep.CompGraphRunner(delayed(names["parts"], initial=0.0, reader=round))
    for _ in range(2):
        runner.run(x=3.0)
    bundle = ep.promote(runner, tmp_path / "noise", samples=[1.0, 2.0])
    assert 0 < bundle.settings.tolerances["made"].relative < 1e-6
    assert verify(bundle.path).identical


def test_a_state_of_keypoints_dicts_and_nan_is_recorded_and_replayed(names, tmp_path):
    runner = ep.CompGraphRunner(delayed(names["tracked"]))
    for x in (4.0, 2.0):
        runner.run(x=x)
    bundle = ep.promote(runner, tmp_path / "tracks", samples=[1.0])
    (_, after), _, _ = states(bundle)
    assert [point.pt[0] for point in after["before"]["points"]] == [4.0, 2.0]
    assert np.isnan(after["before"]["ago"])


def test_a_switch_a_source_token_and_a_delay_of_a_delay_leave_what_they_left_in_the_notebook(names, tmp_path):
    cg = smoothing(names) | ep.CompGraph({"negated": names["negated"]}, {"negated": ("x", "negative")})
    cg |= ep.switch("choose", {"on": "y", "off": "negative"}, by="mode", output="chosen")
    ago = {"one": ("one_before", "last"), "two": ("two_before", "earlier")}
    cg |= ep.CompGraph(dict.fromkeys(ago, names["negated"]), ago)
    cg = ep.delay(ep.delay(cg, "x", "one_before", 0), "one_before", "two_before", 0)
    runner = ep.CompGraphRunner(cg, {"k": 0.5, "by": 10})
    series = [(4.0, "on"), (100.0, "off"), (2.0, "on"), (8.0, "off"), (6.0, "on")]
    payloads = [{"x": x, "mode": mode} for x, mode in series]
    expected = [(run["chosen"], run["earlier"]) for run in map(runner.run_on, payloads)]
    runner.reset()
    runner.run_on(payloads[0])
    bundle = ep.promote(runner, tmp_path / "switch", samples=payloads[1:])
    again = ep.load(bundle.path)
    assert [(run["chosen"], run["earlier"]) for run in map(again.run_on, payloads)] == expected
    left = [after["before"] for _, after in states(bundle)]
    assert left == [4.0, 4.0, 3.0, 3.0, 4.5]
    assert bundle.settings.states == {"before": "smoothed", "one_before": "x", "two_before": "one_before"}


def test_a_rerun_that_chose_another_branch_is_a_sample_that_leaves_the_state_as_it_was(names, tmp_path):
    cg = smoothing(names) | ep.CompGraph({"negated": names["negated"]}, {"negated": ("x", "negative")})
    cg |= ep.switch("choose", {"on": "y", "off": "negative"}, by="mode", output="chosen")
    runner = ep.CompGraphRunner(cg, {"k": 0.5, "by": 1, "mode": "on"})
    runner.run(x=4.0)
    runner.rerun(mode="off")
    loaded = ep.load(ep.promote(runner, tmp_path / "switch").path)
    assert (loaded.run(x=4.0)["chosen"], dict(loaded.state)) == (-4.0, {"before": None})


def test_an_initial_value_that_no_run_takes_or_no_expression_makes_is_refused_with_the_way_out(names, tmp_path):
    for initial in (None, object()):
        runner = ep.CompGraphRunner(delayed(names["drift"], initial=initial, reader=names["negated"]))
        runner.state = {"before": 2.0}
        runner.run(x=1.0)
        with pytest.raises(PromotionRefused) as refused:
            ep.promote(runner, tmp_path / "model")
        if initial is None:
            assert "A service begins with the initial state, and the last payload can't be run with it" in str(refused)
            assert "ep.delay(cg, token, previous, initial=...)" in str(refused.value)
        else:
            assert "The initial value of 'before' is of type object, and no expression" in str(refused.value)
            assert 'ep.delay(cg, "made", "before", initial=None)' in str(refused.value)


# By what keeps something from call to call: a cell that defines `step`, and the line that the reason names.
KEPT = {
    "a global": ("N = 0\ndef step(x):\n    global N\n    N += 1\n    return x + N", "'n', 'n_before', initial=0"),
    "a list": ("SEEN = []\ndef step(x):\n    SEEN.append(x)\n    return x", "'seen', 'seen_before', initial=[]"),
    "a closure": (
        "def make():\n    n = 0.0\n    def step(x):\n        nonlocal n\n        n += x\n        return n\n    return step\n"
        "step = make()",
        "'n', 'n_before', initial=0.0",
    ),
    "a mutable default": (
        "def step(x, seen=[]):\n    seen.append(x)\n    return x",
        "'seen', 'seen_before', initial=None",
    ),
    "a cache": (
        "import functools\n@functools.cache\ndef seen():\n    return []\ndef step(x):\n    seen().append(x)\n    return x",
        "'seen', 'seen_before', initial=None",
    ),
    "a background model": (
        "import cv2\nimport numpy as np\nMODEL = cv2.createBackgroundSubtractorMOG2()\n"
        "def step(x):\n    return MODEL.apply(np.full((9, 9), x))",
        "'model', 'model_before', initial=None",
    ),
    "an object with a method": (
        "class Counter:\n    n = 0\n    def step(self, x):\n        self.n += 1\n        return x + self.n\n"
        "step = Counter().step",
        "'state', 'state_before', initial=None",
    ),
}


@pytest.mark.parametrize("what", KEPT)
def test_state_outside_of_the_graph_is_refused_with_a_line_that_makes_it_a_delay(what, tmp_path):
    source, line = KEPT[what]
    runner = ep.CompGraphRunner(ep.CompGraph({"step": cell(source)["step"]}, {"step": ("x", "y")}))
    runner.run(x=3)
    with pytest.raises(PromotionRefused) as refused:
        ep.promote(runner, tmp_path / "kept")
    (reason,) = refused.value.reasons
    assert f"cg = ep.delay(cg, {line})." in reason


def test_the_line_of_a_refusal_can_be_pasted(tmp_path):
    text = "SEEN = []\ndef step(x):\n    SEEN.append(x)\n    return sum(SEEN)\n"
    cg = ep.CompGraph({"step": cell(text)["step"]}, {"step": ("x", "y")})
    runner = ep.CompGraphRunner(cg)
    runner.run(x=3)
    with pytest.raises(PromotionRefused) as refused:
        ep.promote(runner, tmp_path / "kept")
    line = re.search(r"cg = ep\.delay\(.*\)", refused.value.reasons[0])[0]
    step = "def step(x, seen_before):\n    seen = [*seen_before, x]\n    return seen, sum(seen)\n"
    graph = 'cg = ep.CompGraph({"step": step}, {"step": (("x", "seen_before"), ("seen", "y"))})\n'
    names = cell(f"import epypes as ep\n{step}{graph}{line}\n")
    runner = ep.CompGraphRunner(names["cg"])
    assert [runner.run(x=x)["y"] for x in (3, 4)] == [3, 7]
    bundle = ep.promote(runner, tmp_path / "kept", outputs=["y"])
    assert [ep.load(bundle.path).run(x=x)["y"] for x in (3, 4)] == [3, 4]


def test_the_state_of_a_runner_is_no_hidden_state_of_the_functions(names, tmp_path):
    """Arrays, dicts and lists that a run leaves are compared with nothing: only what functions refer to is."""
    inner = ep.Pipeline("inner", ep.delay(ep.CompGraph({"a": names["kept"]}, {"a": (("x", "b"), "m")}), "m", "b", {}))
    cg = ep.CompGraph({"inner": inner, "keep": names["kept"]}, {"inner": ("x", "m"), "keep": (("m", "b"), "k")})
    runner = ep.CompGraphRunner(ep.delay(cg, "k", "b", {}))
    runner.run(x=1)
    again = ep.load(ep.promote(runner, tmp_path / "kept").path)
    for x in range(3):
        run = again.run(x=x)
        assert again.rerun()["k"] == run["k"]
    assert again.state["inner.b"] == {"last": 2, "seen": [0, 1, 2]}
    assert len(again.state["b"]["seen"]) == 3
