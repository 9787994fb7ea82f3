"""Fingerprints of graphs: what makes stored results count as those of another computation."""

from __future__ import annotations

import functools
import importlib
import sys
import threading

import numpy as np
import pytest

import epypes as ep
from epypes.batch.cache import graph_fingerprint
from epypes.errors import ScaleError

LOCK = threading.Lock()


def scaled(factor, table=None, step=1):
    """A function that no text can be made of."""

    def scale(image, step=step):
        with LOCK:
            return float(image.mean()) * factor + step + (0 if table is None else table[0])

    return scale


def graph_of(function, outputs="out"):
    return ep.CompGraph({"f": function}, {"f": ("image", outputs)})


DIFFERENT = {
    "closures": lambda: (scaled(1), scaled(2)),
    "arrays in closures": lambda: (scaled(1, np.zeros(1)), scaled(1, np.ones(1))),
    "defaults": lambda: (scaled(1, step=1), scaled(1, step=2)),
    "constants": lambda: (lambda image: (LOCK, 1), lambda image: (LOCK, 2)),
    "names": lambda: (lambda image: (LOCK, image.min()), lambda image: (LOCK, image.max())),
    "inner functions": lambda: (lambda image: lambda: (LOCK, 1), lambda image: lambda: (LOCK, 2)),
    "functions that are called": lambda: (functools.partial(scaled(1), step=1), functools.partial(scaled(2), step=1)),
    "arguments": lambda: (functools.partial(scaled(1), step=1), functools.partial(scaled(1), step=2)),
}


@pytest.mark.parametrize("functions", DIFFERENT.values(), ids=DIFFERENT)
def test_code_that_no_text_can_be_made_of_is_told_by_what_it_does(functions):
    one, other = (graph_fingerprint(graph_of(function), None) for function in functions())
    again, _ = (graph_fingerprint(graph_of(function), None) for function in functions())
    assert one == again != other


@pytest.mark.slow
def test_a_name_given_twice_does_not_make_two_graphs_one(tmp_path):
    options = {"store": tmp_path / "r.sqlite", "name": "n"}
    images = [np.ones((2, 2))]
    ep.map(ep.CompGraphRunner(graph_of(scaled(1))), images, **options)
    ep.map(ep.CompGraphRunner(graph_of(scaled(1))), images, **options)
    for another in (graph_of(scaled(2)), graph_of(scaled(1), "other")):
        with pytest.raises(ScaleError, match="the graph has changed"):
            ep.map(ep.CompGraphRunner(another), images, **options)


GAIN = 1


def test_a_global_counts_for_who_looks_it_up_and_not_for_an_attribute_of_that_name(monkeypatch):
    def looks_up(image):
        return LOCK, GAIN

    def has_one(image):
        return LOCK, image.GAIN

    before = [graph_fingerprint(graph_of(function), None) for function in (looks_up, has_one)]
    monkeypatch.setitem(globals(), "GAIN", 2)
    after = [graph_fingerprint(graph_of(function), None) for function in (looks_up, has_one)]
    assert [one == other for one, other in zip(before, after, strict=True)] == [False, True]


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """Write modules of somebody's own, and load them anew."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def written(**texts):
        for name, text in texts.items():
            file = tmp_path / f"{name}.py"
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
        for name in [name for name in sys.modules if name.startswith("own_")]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return importlib.import_module("own_functions").f

    yield written
    for name in [name for name in sys.modules if name.startswith("own_")]:
        del sys.modules[name]


HELPER = "def h(image):\n    return float(image.mean() * {})\n"
USING = {
    "the module itself": {"own_functions": "def f(image):\n    return float(image.mean() * {})\n"},
    "one that it imports": {
        "own_functions": "import own_h\ndef f(image):\n    return own_h.h(image)\n",
        "own_h": HELPER,
    },
    "one that a function imports": {
        "own_functions": "def f(image):\n    from own_h import h\n    return h(image)\n",
        "own_h": HELPER,
    },
    "one of a package": {
        "own_functions": "from own_p import f\n",
        "own_p/__init__": "from .inner import f\n",
        "own_p/inner": "from . import h\ndef f(image):\n    return h.h(image)\n",
        "own_p/h": HELPER,
    },
}


@pytest.mark.parametrize("texts", USING.values(), ids=USING)
def test_a_module_that_was_edited_is_another_computation(texts, modules, tmp_path):
    for factor in (1, 5):
        f = modules(**{name: text.replace("{}", str(factor)) for name, text in texts.items()})
        for _ in range(2):
            (found,) = ep.map(ep.CompGraphRunner(graph_of(f)), [np.ones((2, 2))], store=tmp_path / "r.sqlite")
            assert found.values == {"out": float(factor)}
    with ep.Store(tmp_path / "r.sqlite") as store:
        assert len(store.names("map")) == 2


def test_installed_packages_count_by_version(monkeypatch):
    import cv2

    cg, text = graph_of(cv2.mean), "import cv2\n"
    before = graph_fingerprint(cg, text)
    assert graph_fingerprint(cg, text) == before
    from importlib import metadata

    monkeypatch.setattr(metadata, "version", lambda name: "0.0.1")
    assert graph_fingerprint(cg, text) != before
