"""Pipelines in graphs, nodes and pipelines of users' classes, and ports of their own go into a bundle."""

from __future__ import annotations

import queue
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.load import pipeline_of, read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.bundle.settings import read_settings
from epypes.errors import PromotionRefused, ReplayDiffers
from epypes.wire import Envelope
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

CELL = '''\
import enum
from dataclasses import dataclass

import cv2
import numpy as np

import epypes as ep


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


@dataclass(frozen=True)
class Limits:
    """From where to where."""

    low: int = 0
    high: int = 255

    def clip(self, image):
        return np.clip(image, self.low, self.high).astype(np.uint8)


LIMITS = Limits(high=250)


# Weighs the channels as people see them.
def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def blur(img, k):
    return LIMITS.clip(cv2.GaussianBlur(img, (k, k), 0))


def sobel(img):
    return cv2.convertScaleAbs(cv2.Sobel(img, cv2.CV_16S, 1, 1))


def weigh(edges, kernel):
    return cv2.filter2D(edges, -1, kernel)


class Gain(ep.Node):
    """Multiplies what its function returns."""

    def __init__(self, name, func, gain=1.0):
        super().__init__(name, func)
        self.gain = gain
        self.seen = 0

    def compute(self, *args):
        self.seen += 1
        return cv2.convertScaleAbs(self.func(*args), alpha=self.gain)


class Inspector(ep.FullPipeline):
    """Counts what it was asked."""

    def __init__(self, name, cg, q_in, q_out, f_in, f_out, hparams=None, *, limit=5):
        super().__init__(name, cg, q_in, q_out, f_in, f_out, hparams)
        self.limit = limit

    def compute(self, *args):
        self.attributes["asked"] = self.attributes.get("asked", 0) + 1
        return super().compute(*args)


def unpack(event):
    return {"image": np.frombuffer(event, np.uint8).reshape(40, 60, 3)}


def pack(view):
    return view["edges"].tobytes()[: view.attributes["most"]]
'''
KERNEL = np.array([[0.1, 0.2, 0.1], [0.2, 0.4, 0.2], [0.1, 0.2, 0.1]], np.float32)
IMAGE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def graph_of(names: dict) -> ep.CompGraph:
    """Return a graph with all that a graph may have: a pipeline with a group inside, a node, a switch, a group."""
    inner = ep.group(
        ep.CompGraph(
            {"gray": names["grayscale"], "blur": names["blur"]},
            {"gray": ("image", "image_gray"), "blur": (("image_gray", "k"), "image_blurred")},
        ),
        "box", ["gray", "blur"],
    )  # fmt: skip
    cg = ep.CompGraph(
        {
            "smooth": ep.Pipeline("smooth", inner, {"k": 5}), "canny": names["cv2"].Canny,
            "sobel": names["Gain"]("sobel", names["sobel"], 2.0), "weigh": names["weigh"],
        },
        {
            "smooth": ("image", "smoothed"), "canny": (("smoothed", "lo", "hi"), "edges_canny"),
            "sobel": ("smoothed", "edges_sobel"), "weigh": (("chosen", "kernel"), "edges"),
        },
    )  # fmt: skip
    canny, sobel = names["Method"]
    cg |= ep.switch("choose", {canny: "edges_canny", sobel: "edges_sobel"}, by="method", output="chosen")
    return ep.group(cg, "ways", ["canny", "sobel"])


class Promoted:
    """A pipeline of a notebook, and its bundle."""

    def __init__(self, folder: Path) -> None:
        self.names = cell(CELL)
        self.cg = graph_of(self.names)
        values = {"lo": 70, "hi": 200.0, "method": self.names["Method"].SOBEL, "kernel": KERNEL}
        ports = self.names["unpack"], self.names["pack"]
        self.pipe = self.names["Inspector"]("edges", self.cg, None, None, *ports, values, limit=7)
        self.pipe.attributes["most"] = 90
        self.pipe.run(image=IMAGE)
        self.bundle = ep.promote(self.pipe, folder, samples=[IMAGE[::-1], {"image": IMAGE[:, ::-1]}])

    @property
    def text(self) -> str:
        return (self.bundle.path / "pipeline.py").read_text()


@pytest.fixture(scope="module")
def promoted(tmp_path_factory) -> Promoted:
    return Promoted(tmp_path_factory.mktemp("bundles") / "edges")


def test_the_graph_comes_back_as_it_was(promoted):
    again = ep.load(promoted.bundle.path)
    assert again.cg.func_io == promoted.cg.func_io
    assert (again.cg.switches, again.cg.groups) == (("choose",), promoted.cg.groups)
    assert list(again.cg.functions) == list(promoted.cg.functions)
    smooth, gain = again.cg.functions["smooth"], again.cg.functions["sobel"]
    assert (type(smooth), smooth.name, smooth["k"]) == (ep.Pipeline, "smooth", 5)
    assert smooth.cg.groups == {"box": ("gray", "blur")}
    assert (type(gain).__name__, gain.gain, gain.seen) == ("Gain", 2.0, 0)
    assert again.hyperparameters["method"].name == "SOBEL"
    assert again.hyperparameters["kernel"].tobytes() == KERNEL.tobytes()
    other = again.run(image=IMAGE[::-1])["edges"]
    assert np.array_equal(other, promoted.pipe.runner.run(image=IMAGE[::-1])["edges"])
    promoted.pipe.run(image=IMAGE)


def test_further_payloads_are_recorded_and_replayed(promoted):
    assert [path.name for path in promoted.bundle.samples] == ["000.npz", "001.npz", "002.npz"]
    report = verify(promoted.bundle.path)
    assert (report.identical, report.samples) == (True, 3)


def test_the_module_reads_as_it_was_written(promoted):
    text = promoted.text
    parts = [
        "import enum\nfrom dataclasses import dataclass\n\nimport cv2\nimport epypes as ep\nimport numpy as np\n",
        "# Weighs the channels as people see them.\ndef grayscale(im):\n",
        "LIMITS = Limits(high=250)\n",
        '# A graph of its own: image, k -> image_blurred.\nsmooth_functions = {\n    "gray": grayscale,\n',
        'smooth = ep.Pipeline(\n    name="smooth",\n    cg=ep.group(\n        ep.CompGraph(smooth_functions, smooth_io),',
        'sobel_ = Gain(name="sobel", func=sobel, gain=2.0)\n',
        "# Only the branch that method chooses is computed.\nchoose = ep.switch(\n",
        '    "smooth": smooth,\n    "canny": cv2.Canny,\n    "sobel": sobel_,\n    "choose": choose.functions["choose"],\n',
        '# Drawn as one box each.\nfunc_groups = {\n    "ways": ["canny", "sobel"],\n}\n',
        "# How an event becomes a payload.\nf_in = unpack\n",
    ]
    places = [text.find(part) for part in parts]
    assert -1 not in places, parts[places.index(-1)]
    assert text.count("class Gain(") == text.count("class Inspector(") == text.count("def unpack(") == 1


def test_linters_and_formatters_leave_the_module_as_it_is(promoted, tmp_path):
    (tmp_path / "pipeline.py").write_text(promoted.text)
    for command in (["check"], ["format", "--check", "--diff"]):
        options = ["--isolated", "--no-cache", "pipeline.py"]
        ruff = Path(sys.executable).with_name("ruff")
        done = subprocess.run([ruff, *command, *options], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def test_the_pipeline_that_serves_is_of_the_users_class_and_answers_bytes_with_bytes(promoted):
    pipe = ep.load_pipeline(promoted.bundle.path, queue.Queue(), queue.Queue())
    assert (type(pipe).__name__, pipe.limit, pipe.attributes["most"]) == ("Inspector", 7, 90)
    with pipe:
        pipe.q_in.put(IMAGE.tobytes())
        assert pipe.q_out.get(timeout=60) == promoted.pipe["edges"].tobytes()[:90]
    assert pipe.attributes["asked"] >= 1


@pytest.mark.usefixtures("fresh_interpreter")
def test_an_f_out_that_makes_another_answer_is_found(promoted, tmp_path):
    import shutil

    copy = shutil.copytree(promoted.bundle.path, tmp_path / "edges")
    module = copy / "pipeline.py"
    module.write_text(module.read_text().replace('["most"]]', '["most"]][::-1]'))
    write_manifest(copy)
    with pytest.raises(ReplayDiffers, match="the answer of f_out"):
        verify(copy)


def test_who_does_not_execute_the_module_knows_values_and_ranges(promoted):
    settings = read_settings(promoted.bundle.path / "pipeline.toml")
    assert settings.own == ("f_in", "f_out", "make_pipeline")
    assert settings.entries["method"] == {
        "value": "SOBEL", "kind": "enum", "enum": "Method", "choices": ["CANNY", "SOBEL"],
    }  # fmt: skip
    assert settings.entries["lo"]["soft"] == [0, 500]


def test_a_bundle_is_promoted_again_to_the_same_text(promoted, tmp_path):
    again = ep.load_pipeline(promoted.bundle.path, None, None)
    again.run(image=IMAGE)
    again.attributes.update(promoted.bundle.settings.attributes)
    second = ep.promote(again, tmp_path / "edges")
    assert (second.path / "pipeline.py").read_text() == promoted.text


PORTS = """\
import epypes as ep


def double(x):
    return 2 * x


def f_in(event):
    return {"x": int(event)}


def told(view):
    return str(view["y"]).encode()


class Twice(ep.Pipeline):
    def compute(self, *args):
        self.attributes["called"] = True
        return super().compute(*args)


class Keeping(ep.Node):
    def __init__(self, name, func, secret):
        super().__init__(name, func)


class Adding(ep.Node):
    offset = 0

    def __init__(self, name, func):
        super().__init__(name, func)
        self.more = 0

    def compute(self, *args):
        return self.func(*args) + self.more
"""


@pytest.fixture
def names() -> dict:
    return cell(PORTS)


def double_graph(names) -> ep.CompGraph:
    return ep.CompGraph({"double": names["double"]}, {"double": ("x", "y")})


@pytest.mark.usefixtures("fresh_interpreter")
def test_ports_of_the_papers_pipelines_are_promoted(names, tmp_path):
    pipe = ep.SourcePipeline("s", double_graph(names), queue.Queue(), names["told"])
    pipe.run(x=4)
    bundle = ep.promote(pipe, tmp_path / "b", f_in=names["f_in"])
    text = (bundle.path / "pipeline.py").read_text()
    assert "\nf_out = told\n" in text
    assert "f_in =" not in text, "it is called so in the notebook too"
    served = pipeline_of(bundle, queue.Queue(), queue.Queue())
    assert type(served) is ep.FullPipeline
    with served:
        served.q_in.put(b"21")
        assert served.q_out.get(timeout=60) == b"42"


def test_a_sink_takes_events_its_way_and_answers_with_envelopes(names, tmp_path):
    pipe = ep.SinkPipeline("s", double_graph(names), None, names["f_in"])
    pipe.run(x=4)
    served = pipeline_of(ep.promote(pipe, tmp_path / "b"), queue.Queue(), queue.Queue(), detach=False)
    with served:
        served.q_in.put(b"21")
        answer = served.q_out.get(timeout=60)
    assert (dict(answer.parts), answer.correlation_id) == ({"y": 42}, "")


def test_a_pipeline_of_ones_own_that_takes_no_events_learns_to(names, tmp_path):
    pipe = names["Twice"]("twice", double_graph(names))
    pipe.run(x=4)
    served = ep.load_pipeline(ep.promote(pipe, tmp_path / "b").path, queue.Queue(), queue.Queue())
    with served:
        served.q_in.put(Envelope("", {"x": 5}))
        assert served.q_out.get(timeout=60).parts == {"y": 10}
    assert served.attributes["called"]
    assert (ep.promote(pipe, tmp_path / "b").path / "pipeline.py").read_text().count(
        'type("AnsweringTwice", (ep.FullPipeline, Twice), {})('
    ) == 1


def test_the_usual_ports_of_a_bundle_are_not_written_out(names, tmp_path):
    runner = ep.CompGraphRunner(double_graph(names))
    runner.run(x=4)
    served = ep.load_pipeline(ep.promote(runner, tmp_path / "b").path, None, None)
    served.run(x=4)
    assert ep.promote(served, tmp_path / "c").settings.own == ()


def test_a_sample_brings_what_was_unfrozen_too(tmp_path):
    names = cell("def shift(x, by=1):\n    return x + by\n")
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(names["shift"]))
    runner.unfreeze("by")
    runner.run(x=1, by=5)
    bundle = ep.promote(runner, tmp_path / "b", samples=[{"x": 2, "by": 7}])
    assert (bundle.settings.inputs, verify(bundle.path).samples) == (("x", "by"), 2)


def refusals(pipe_or_runner, folder, **more) -> str:
    with pytest.raises(PromotionRefused) as refused:
        ep.promote(pipe_or_runner, folder, **more)
    return "\n".join(refused.value.reasons)


def test_nodes_that_cannot_be_made_again_are_refused_with_the_way_out(names, tmp_path):
    keeping, adding = names["Keeping"]("a", names["double"], 3), names["Adding"]("b", names["double"])
    adding.more = 5
    cg = ep.CompGraph({"a": keeping, "b": adding}, {"a": ("x", "y"), "b": ("y", "z")})
    runner = ep.CompGraphRunner(cg)
    runner.run(x=1)
    told = refusals(runner, tmp_path / "b")
    assert "'a' is made with 'secret', which it does not keep. Keep it in __init__: self.secret = secret." in told
    runner = ep.CompGraphRunner(ep.CompGraph({"b": adding}, {"b": ("y", "z")}))
    runner.run(y=1)
    assert "its attribute 'more' is 5 in the notebook and 0 in the module." in refusals(runner, tmp_path / "b")


SET_LATER = """
import types
import epypes as ep

class Limited(ep.Node):
    def __init__(self, name):
        super().__init__(name, self.work)
        self.low, self.seen, self.settings = 10, 0, types.SimpleNamespace(high=20)

    def work(self, x):
        self.count()
        return max(self.low, min(x, self.settings.high))

    def count(self):
        self.seen += 1

    def set_low(self, low):
        self.low = low
"""


@pytest.mark.parametrize("change", ["low", "high", "none"])
def test_what_was_set_on_a_node_by_a_method_that_no_run_calls_is_refused(change, tmp_path):
    node = cell(SET_LATER)["Limited"]("n")
    if change == "low":
        node.set_low(15)
    elif change == "high":
        node.settings.high = 50
    runner = ep.CompGraphRunner(ep.CompGraph({"n": node}, {"n": ("x", "y")}))
    runner.run(x=12)
    if change == "none":
        assert ep.promote(runner, tmp_path / "b").digest
        return
    named = "'low' is 15" if change == "low" else "'settings' state['high'] is 50"
    assert f"Function 'n': its attribute {named} in the notebook and" in refusals(runner, tmp_path / "b")


def test_pipelines_that_cannot_serve_are_refused_with_the_way_out(tmp_path):
    names = cell(
        f"{PORTS}\n\nclass Source(ep.SourcePipeline):\n    pass\n\n\nclass Sink(ep.SinkPipeline):\n"
        "    def emit(self, event, run):\n        pass\n"
    )
    cg = double_graph(names)
    for pipe in (
        names["Source"]("s", cg, queue.Queue(), names["told"]),
        names["Sink"]("s", cg, None, names["f_in"]),
    ):
        pipe.run(x=1)
        assert "Make it a subclass of ep.FullPipeline, " in refusals(pipe, tmp_path / "b")


def test_ports_and_samples_that_cannot_be_promoted_are_refused(names, tmp_path):
    runner = ep.CompGraphRunner(double_graph(names))
    runner.run(x=1)
    assert "f_in must be a function, not 'int'" in refusals(runner, tmp_path / "b", f_in=3)
    assert "Sample 1 can't be run: UnknownName" in refusals(runner, tmp_path / "b", samples=[{"z": 1}])
    held = {"lock": queue.Queue()}
    pipe = ep.Pipeline("p", double_graph(names))
    pipe.run(x=1)
    pipe.attributes.update(held)
    assert "Attribute 'lock' is a Queue, which pipeline.toml can't hold" in refusals(pipe, tmp_path / "b")


def test_an_f_out_whose_answer_depends_on_the_time_is_not_compared(tmp_path):
    names = cell(f"{PORTS}\n\ndef timed(view):\n    return str(view.report.total_ns).encode()\n")
    pipe = ep.SourcePipeline("s", double_graph(names), queue.Queue(), names["timed"])
    pipe.run(x=4)
    bundle = ep.promote(pipe, tmp_path / "b")
    assert not list((bundle.path / "answers").glob("*")) if (bundle.path / "answers").exists() else True
    assert verify(bundle.path).identical


@pytest.mark.parametrize("adapter", ["functools.partial(f_out, most=2)", "lambda view: f_out(view, 2)"])
def test_an_f_out_that_calls_a_function_of_this_name_is_promoted_as_any_other(tmp_path, adapter):
    names = cell(
        "import functools\n\nimport numpy as np\n\nimport epypes as ep\nfrom epypes.wire import Envelope\n\n\n"
        "def double(x):\n    return 2 * x\n\n\n"
        "def f_in(event):\n    return {'x': event.parts['x']}\n\n\n"
        "def f_out(view, most):\n    return Envelope('first', {'first': view['y'][:most]})\n\n\n"
        f"answer = {adapter}\n"
    )
    pipe = ep.FullPipeline("p", double_graph(names), queue.Queue(), queue.Queue(), names["f_in"], names["answer"])
    pipe.run(x=np.arange(5))
    bundle = ep.promote(pipe, tmp_path / "b")
    assert verify(bundle.path).identical
    served = pipeline_of(bundle, queue.Queue(), queue.Queue())
    with served:
        served.q_in.put(Envelope("request", {"x": np.arange(4)}))
        assert served.q_out.get(timeout=60).parts["first"].tolist() == [0, 2]


def test_two_read_bundles_of_one_name_do_not_know_each_other(names, tmp_path):
    runner = ep.CompGraphRunner(double_graph(names))
    runner.run(x=1)
    path = ep.promote(runner, tmp_path / "b").path
    one, other = read_bundle(path), read_bundle(path)
    assert one.cg.functions["double"] is not other.cg.functions["double"]
    assert "epypes_bundle_b" not in sys.modules


@pytest.mark.notebook
def test_a_notebook_file_with_classes_gives_the_same_module(promoted, tmp_path):
    import inspect

    import nbformat

    from epypes.bundle.promote import promote_notebook

    graph = inspect.getsource(graph_of).replace("names: dict", "names").replace("-> ep.CompGraph", "")
    last = (
        "ports = unpack, pack\n"
        "values = {'lo': 70, 'hi': 200.0, 'method': Method.SOBEL, 'kernel': np.array(KERNEL, np.float32)}\n"
        "pipe = Inspector('edges', graph_of(globals()), None, None, *ports, values, limit=7)\n"
        "pipe.attributes['most'] = 90\n_ = pipe.run(image=np.zeros((40, 60, 3), np.uint8))"
    )
    kernel = f"KERNEL = {[[0.1, 0.2, 0.1], [0.2, 0.4, 0.2], [0.1, 0.2, 0.1]]}"
    cells = [nbformat.v4.new_code_cell(source) for source in (CELL, graph, kernel, last)]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "n.ipynb")
    promote_notebook(tmp_path / "n.ipynb", "pipe", tmp_path / "edges")
    assert (tmp_path / "edges" / "pipeline.py").read_text() == promoted.text
    assert (tmp_path / "edges" / "pipeline.toml").read_text() == (promoted.bundle.path / "pipeline.toml").read_text()
