from __future__ import annotations

import functools
import math

import numpy as np
import pytest

import epypes as ep
from epypes.errors import GraphError


def kinds(error: pytest.ExceptionInfo[GraphError]) -> list[str]:
    return [finding.kind for finding in error.value.findings]


def gray(image):
    return image + 1


def edges(gray, threshold=70):
    return gray * threshold


@ep.outputs("low", "high")
def ends(edges):
    return -edges, edges


def test_parameters_are_tokens_and_a_function_makes_the_token_of_its_name():
    cg = ep.CompGraph.from_functions(ends, edges, gray)
    assert dict(cg.func_io) == {
        "gray": (("image",), "gray"),
        "edges": (("gray", "threshold"), "edges"),
        "ends": (("edges",), ("low", "high")),
    }
    run = ep.CompGraphRunner(cg, {"threshold": 2}).run(image=1)
    assert (run["edges"], run["low"], run["high"]) == (4, -4, 4)


def test_one_name_of_outputs_takes_the_value_as_it_is_and_none_means_no_output():
    @ep.outputs("pair")
    def both(x):
        return x, x

    seen = []

    @ep.outputs()
    def show(pair):
        seen.append(pair)

    cg = ep.CompGraph.from_functions(both, show)
    assert cg.func_io["show"] == (("pair",), None)
    ep.CompGraphRunner(cg).run(x=3)
    assert seen == [(3, 3)]


@pytest.mark.parametrize("names", [(1,), ("",), (len,), (None,)])
def test_outputs_takes_strings_only(names):
    with pytest.raises(TypeError, match="takes the names of tokens"):
        ep.outputs(*names)


def test_outputs_refuses_a_name_twice_and_what_cannot_be_marked():
    with pytest.raises(ValueError, match="names 'a' twice"):
        ep.outputs("a", "b", "a")
    with pytest.raises(TypeError, match="'len' can't be marked"):
        ep.outputs("size")(len)


def test_defaults_are_kept_for_source_tokens_only_and_cannot_be_changed():
    def late(edges=5, threshold=70):
        return edges

    cg = ep.CompGraph.from_functions(gray, edges, late)
    assert dict(cg.defaults) == {"threshold": 70}
    with pytest.raises(TypeError):
        cg.defaults["threshold"] = 1


def test_a_graph_of_dicts_has_no_defaults():
    assert dict(ep.CompGraph({"edges": edges}, {"edges": (("gray", "threshold"), "edges")}).defaults) == {}


def test_defaults_come_in_graph_order():
    def f(b=1, a=2, c=3):
        return b

    assert list(ep.CompGraph.from_functions(f).defaults.items()) == [("b", 1), ("a", 2), ("c", 3)]


def with_default(name, value):
    namespace = {}
    exec(f"def {name}(k=None): return k", namespace)
    namespace[name].__defaults__ = (value,)
    return namespace[name]


@pytest.mark.parametrize(
    ("one", "other", "agree"),
    [(1, 1, True), (1, 2, False), (1, True, False), (1, 1.0, False), (math.nan, math.nan, True), (0.0, -0.0, False),
     ("a", "a", True), ((1, ("x",)), (1, ("x",)), True), ((1,), (1, 2), False), ([], [], True), ([1], [1.0], False), ([], (), False),
     (np.zeros(9), np.zeros(9), True), (np.zeros(9), np.ones(9), False), (object(), object(), False), (None, None, True)],
)  # fmt: skip
def test_two_defaults_of_one_token_must_be_equal_to_the_last_bit(one, other, agree):
    functions = with_default("f", one), with_default("g", other)
    if agree:
        assert list(ep.CompGraph.from_functions(*functions).defaults) == ["k"]
    else:
        with pytest.raises(GraphError, match="Token 'k' has the default .* in 'f' and .* in 'g'") as error:
            ep.CompGraph.from_functions(*functions)
        assert kinds(error) == ["defaults"]


def test_starred_and_optional_keyword_only_parameters_are_left_alone():
    def f(x, *rest, y=1, **more):
        return x

    assert ep.CompGraph.from_functions(f).func_io["f"] == (("x",), "f")


def test_a_required_keyword_only_parameter_is_refused():
    def f(x, *, y):
        return x

    with pytest.raises(GraphError, match="needs 'y' by keyword") as error:
        ep.CompGraph.from_functions(f)
    assert kinds(error) == ["arity"]


def test_what_makes_no_function_of_a_graph_is_reported_at_once_with_the_way_out():
    with pytest.raises(GraphError) as error:
        ep.CompGraph.from_functions(lambda x: x, functools.partial(gray), iter, gray, gray, 3, ep.Placeholder())
    assert kinds(error) == ["no name", "no name", "no signature", "two functions", "not callable", "no name"]
    assert str(error.value).count("name it in CompGraph(func_dict, func_io)") == 5


def test_nodes_methods_and_decorated_functions_work():
    class Camera:
        def shot(self, exposure=3):
            return exposure

    @functools.wraps(edges)
    def wrapped(*args):
        return edges(*args)

    cg = ep.CompGraph.from_functions(ep.Node("gray", gray), wrapped, Camera().shot)
    assert list(cg.func_io) == ["gray", "edges", "shot"]
    assert dict(cg.defaults) == {"threshold": 70, "exposure": 3}


def test_a_default_survives_in_a_pipeline():
    pipe = ep.Pipeline("p", ep.CompGraph.from_functions(gray, edges))
    assert dict(pipe.network.defaults) == {"threshold": 70}
