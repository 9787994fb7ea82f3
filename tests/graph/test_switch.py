from __future__ import annotations

import enum

import pytest

import epypes as ep
from epypes.errors import GraphError, UnknownName
from epypes.graph import Switch, as_switch


class Method(enum.Enum):
    CANNY = 1


@pytest.fixture
def choose():
    return ep.switch("choose", {"canny": "edges_canny", "sobel": "edges_sobel"}, by="method", output="edges")


def test_a_switch_is_one_function_that_takes_the_selector_and_every_branch(choose):
    assert dict(choose.func_io) == {"choose": (("method", "edges_canny", "edges_sobel"), "edges")}
    assert choose.switches == ("choose",)
    function = choose.functions["choose"]
    assert isinstance(function, Switch)
    assert function.branches == ("canny", "sobel")
    assert [function.branch_index(key) for key in function.branches] == [0, 1]
    assert function("sobel", 1, 2) == 2
    assert len(repr(function)) < 100


def test_keys_may_be_anything_hashable_and_branches_may_share_a_token():
    cg = ep.switch("s", {1: "a", "one": "a", Method.CANNY: "b", None: "c"}, by="k", output="out")
    function = cg.functions["s"]
    assert cg.func_inputs("s") == ("k", "a", "a", "b", "c")
    assert [function.branch_index(key) for key in (1, "one", Method.CANNY, None)] == [0, 1, 2, 3]


@pytest.mark.parametrize("selector", ["cany", 3, ["canny"], {}, None])
def test_an_unknown_branch_is_refused_with_those_there_are(choose, selector):
    with pytest.raises(UnknownName, match="^No branch .* of switch 'choose'") as error:
        choose.functions["choose"].branch_index(selector)
    assert error.value.known == ("canny", "sobel")
    assert ("Did you mean 'canny'" in str(error.value)) is (selector in ("cany", ["canny"]))


def test_branches_must_be_a_mapping_with_something_in_it():
    with pytest.raises(ValueError, match="'s' has no branches"):
        ep.switch("s", {}, by="k", output="out")
    with pytest.raises(TypeError, match="must be a mapping"):
        ep.switch("s", ["a", "b"], by="k", output="out")
    with pytest.raises(GraphError, match="The io of function 's'"):
        ep.switch("s", {"a": 3}, by="k", output="out")


@pytest.mark.parametrize("output", [("o", "p"), ("o",), ["o"], None, 5])
def test_a_switch_passes_one_value_on_and_so_takes_one_output(output):
    with pytest.raises(TypeError, match="output takes one token, not .* Put a function behind it"):
        ep.switch("s", {"a": "t", "b": "u"}, by="m", output=output)


def test_the_selector_must_be_a_source_token(choose):
    with pytest.raises(
        GraphError, match="selects the branch of switch 'choose', but function 'decide' makes it"
    ) as error:
        ep.extend(choose, {"decide": abs}, {"decide": ("x", "method")})
    assert [finding.kind for finding in error.value.findings] == ["selector"]
    assert ep.extend(choose, {"f": abs}, {"f": ("x", "edges_canny")}).switches == ("choose",)


def test_the_number_of_inputs_of_a_switch_is_checked(choose):
    with pytest.raises(GraphError, match="takes 3 inputs"):
        ep.CompGraph({"s": choose.functions["choose"]}, {"s": (("k", "a"), "b")})


def test_a_node_around_a_switch_is_a_switch(choose):
    pipe = ep.Pipeline("p", choose)
    assert pipe.network.switches == ("choose",)
    assert as_switch(pipe.network.functions["choose"]) is choose.functions["choose"]
    assert as_switch(abs) is None
