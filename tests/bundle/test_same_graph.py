"""A graph that comes back from a bundle behaves as the one in the notebook did."""

from __future__ import annotations

import linecache
import queue
import shutil
import tomllib

import pytest

import epypes as ep
from epypes.bundle.load import read_bundle
from epypes.bundle.settings import read_settings, writable_defaults
from epypes.errors import BundleError, GraphError
from epypes.wire import Envelope

CELL = """\
def scaled(image, gain=3, offset=(1, 2)) -> str:
    return image * gain + sum(offset)

@ep.outputs("low", "high")
def ends(scaled: int, margin=None, spread=1):
    margin = 10 if margin is None else margin
    return scaled - margin * spread, scaled + margin * spread
"""


@pytest.fixture(scope="module")
def runner():
    """A graph of functions with defaults, two of them changed and one given by events, whose annotations disagree."""
    name = "<cell of defaults>"
    linecache.cache[name] = (len(CELL), None, CELL.splitlines(keepends=True), name)
    names = {"__name__": "__main__", "ep": ep}
    exec(compile(CELL, name, "exec"), names)
    functions = names["scaled"], names["ends"]
    with pytest.raises(GraphError, match="no value is both"):
        ep.CompGraph.from_functions(*functions)
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(*functions, types=False), {"gain": 5})
    runner.unfreeze("spread")
    runner.run(image=2, spread=2)
    return runner


@pytest.fixture(scope="module")
def path(runner, tmp_path_factory):
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "ends").path


@pytest.mark.slow
def test_the_graph_has_its_io_defaults_and_leniency(runner, path):
    cg = ep.load(path).cg
    assert (cg.func_io, cg.types) == (runner.cg.func_io, False)
    assert dict(runner.cg.defaults) == {"gain": 3, "offset": (1, 2), "margin": None, "spread": 1}
    assert dict(cg.defaults) == {"gain": 3, "offset": (1, 2), "margin": None}, "what events bring has no default"
    assert ep.union(cg, cg, suffixes=("_1", "_2")).types is False


def test_the_runner_has_the_hyperparameters_and_free_tokens_of_the_notebook(runner, path):
    again = ep.load(path)
    assert dict(again.hyperparameters) == dict(runner.hyperparameters) == {"gain": 5, "offset": (1, 2), "margin": None}
    assert again.free_source_tokens == runner.free_source_tokens == ("image", "spread")
    assert again.run(image=2, spread=2)["high"] == runner["high"] == 33
    assert again.rerun(margin=0)["high"] == 13


def test_a_new_runner_of_the_graph_has_the_defaults(runner, path):
    cg = ep.load(path).cg
    fresh = ep.CompGraphRunner(cg)
    assert dict(fresh.hyperparameters) == dict(cg.defaults)
    assert ep.Pipeline("p", cg, {"spread": 1})(2) == ep.Pipeline("p", runner.cg)(2) == (-1, 19)


def test_the_pipeline_that_serves_has_the_hyperparameters_of_the_notebook(runner, path):
    pipe = ep.load_pipeline(path, queue.Queue(), queue.Queue())
    assert dict(pipe.runner.hyperparameters) == dict(runner.hyperparameters)
    with pipe:
        pipe.q_in.put(Envelope("image", parts={"image": 2, "spread": 2}))
        assert pipe.q_out.get(timeout=60).parts == {"low": -7, "high": 33}


def test_the_settings_say_only_what_is_not_usual(path):
    document = tomllib.loads((path / "pipeline.toml").read_text())
    assert document["bundle"]["types"] is False
    assert document["defaults"] == {
        "gain": {"value": 3}, "offset": {"value": [1, 2], "kind": "tuple"}, "margin": {"kind": "none"},
    }  # fmt: skip


def test_settings_without_defaults_and_types_are_those_of_a_usual_graph(path, tmp_path):
    """As bundles are that were made before graphs had defaults."""
    copy = shutil.copytree(path, tmp_path / "ends")
    settings = copy / "pipeline.toml"
    text = settings.read_text()
    settings.write_text(text[: text.index("[defaults")].replace("types = false\n", ""))
    found = read_settings(settings)
    assert (dict(found.defaults), found.types) == ({}, True)
    with pytest.raises(GraphError, match="no value is both"):
        read_bundle(copy, compare=False)


@pytest.mark.parametrize("spoilt", ["[defaults]\ngain = 3", "[defaults.gain]\nlow = 3", "defaults = 3\n"])
def test_settings_whose_defaults_make_no_sense_are_refused(path, tmp_path, spoilt):
    text = (path / "pipeline.toml").read_text()
    settings = tmp_path / "pipeline.toml"
    text = text[: text.index("[defaults")]
    settings.write_text(f"{spoilt}{text}" if spoilt.startswith("defaults") else f"{text}{spoilt}\n")
    with pytest.raises(BundleError):
        read_settings(settings)


def test_a_default_that_toml_cannot_hold_is_left_out():
    def half(image, by=len, rounds=1):
        return image / by * rounds

    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(half), {"by": 2})
    assert writable_defaults(runner.cg, runner.hyperparameters) == {"rounds": 1}
