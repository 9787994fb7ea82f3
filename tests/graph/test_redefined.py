from __future__ import annotations

import functools
import sys
import types

import pytest

import epypes as ep
from epypes.graph import redefined


@pytest.fixture
def cell(monkeypatch):
    """Return a function that executes source as a notebook does: again and again in one module."""
    module = types.ModuleType("a_notebook")
    monkeypatch.setitem(sys.modules, "a_notebook", module)

    def execute(source):
        exec(source, vars(module))
        return module

    return execute


def graph(function):
    return ep.CompGraph({"f": function}, {"f": ("x", "y")})


BLUR = "def blur(x, k=3):\n    return [x + k for _ in range(2)]\n"


def test_a_function_whose_name_now_means_another_is_named(cell):
    cg = graph(cell(BLUR).blur)
    assert redefined(cg) == ()
    cell("def blur(x, k=3):\n    return x - k\n")
    assert redefined(cg) == ("f",)
    assert repr(cg) == "<CompGraph: 1 function, 2 tokens; x -> y; 'f' was redefined>"


def test_the_same_words_again_are_the_same_even_on_another_line(cell):
    cg = graph(cell(BLUR).blur)
    cell(BLUR)
    assert redefined(cg) == ()
    cell("import math\n\n" + BLUR)
    assert redefined(cg) == ()


@pytest.mark.parametrize(
    "source",
    [
        BLUR.replace("k=3", "k=4"),
        BLUR.replace("k=3", "*, k=3"),
        BLUR.replace("range(2)", "range(3)"),
        "def make():\n    n = 1\n    def blur(x, k=3): return n\n    blur.__qualname__ = 'blur'\n    return blur\nblur = make()",
    ],
)
def test_another_default_constant_or_closure_is_another_function(cell, source):
    cg = graph(cell(BLUR).blur)
    cell(source)
    assert redefined(cg) == ("f",)


def test_a_decorated_function_is_looked_at_inside(cell):
    decorate = (
        "import functools\ndef deco(f):\n    @functools.wraps(f)\n    def inner(*a): return f(*a)\n    return inner\n"
    )
    cg = graph(cell(decorate + "@deco\n" + BLUR).blur)
    cell(decorate + "@deco\n" + BLUR)
    assert redefined(cg) == ()
    cell("@deco\ndef blur(x): return x\n")
    assert redefined(cg) == ("f",)


@pytest.mark.parametrize("wrap", [functools.partial, lambda f: ep.Node("n", f)])
def test_nodes_and_partials_are_looked_at_inside(cell, wrap):
    cg = graph(wrap(cell(BLUR).blur))
    assert redefined(cg) == ()
    cell("def blur(x): return x")
    assert redefined(cg) == ("f",)


def test_a_pipeline_is_redefined_when_a_function_inside_it_is(cell):
    pipe = ep.Pipeline("inner", graph(cell(BLUR).blur))
    deep = ep.Pipeline("middle", ep.CompGraph({"inner": pipe}, {"inner": ("a", "b")}))
    cg = ep.CompGraph({"middle": deep, "f": abs}, {"middle": ("b", "c"), "f": ("c", "d")})
    assert redefined(cg) == ()
    cell("def blur(x, k=3): return x - k")
    assert redefined(pipe.cg) == ("f",)
    assert redefined(cg) == ("middle",)
    assert repr(cg).endswith("; a function inside 'middle' was redefined>")


def test_methods_are_found_in_their_class(cell):
    source = "class Camera:\n    def shot(self, x): return x\n    @staticmethod\n    def still(x): return x\n"
    module = cell(source)
    cg = ep.CompGraph({"f": module.Camera().shot, "g": module.Camera.still}, {"f": ("x", "y"), "g": ("x", "z")})
    assert redefined(cg) == ()
    cell(source.replace("return x", "return -x"))
    assert redefined(cg) == ("f", "g")
    assert "; 2 functions were redefined>" in repr(cg)


def test_what_is_gone_or_is_no_function_any_more_is_not_redefined(cell):
    cg = graph(cell(BLUR).blur)
    cell("blur = 5")
    assert redefined(cg) == ()
    cell("del blur")
    assert redefined(cg) == ()
    cg = graph(lambda x: x)
    assert redefined(cg) == ()


class Hostile:
    __wrapped__ = property(lambda self: 1 / 0)
    __slots__ = ()

    def __call__(self, x):
        return x


def test_odd_objects_never_make_a_repr_fail(cell):
    for odd in (Hostile(), ep.Placeholder(), len, functools.partial(len), int):
        assert "was redefined" not in repr(graph(odd))
    numpy_default = "import numpy\ndef blur(x, k=numpy.ones(3)): return x\n"
    cg = graph(cell(numpy_default).blur)
    cell(numpy_default)
    assert len(repr(cg)) < 100


@pytest.mark.slow
def test_the_repr_stays_short_when_names_are_long(cell):
    name = "a_function_with_a_very_long_name"
    functions = {f"f{index}": abs for index in range(20_000)} | {name: cell(BLUR).blur}
    io = {f"f{index}": (f"token_{index}", f"made_{index}") for index in range(20_000)} | {name: ("x", "y")}
    cg = ep.CompGraph(functions, io)
    cell("def blur(x): return x")
    assert len(repr(cg)) < 100
    assert "was redefined" in repr(cg)
