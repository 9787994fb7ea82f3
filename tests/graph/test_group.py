"""A group is for the eye only, and every graph made of a grouped one has it too."""

from __future__ import annotations

import copy
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.errors import GraphError, UnknownName
from epypes.graph import with_defaults, with_functions


def double(x):
    return 2 * x


@pytest.fixture
def chain():
    """a -> f -> b -> g -> c -> h -> d."""
    names = "fgh"
    io = {name: (made, taken) for name, made, taken in zip(names, "abc", "bcd", strict=True)}
    return ep.CompGraph(dict.fromkeys(names, double), io)


@pytest.fixture
def grouped(chain):
    return ep.group(chain, "first", functions=["g", "f"])


def test_a_group_names_its_functions_in_run_order(chain, grouped):
    assert dict(grouped.groups) == {"first": ("f", "g")}
    assert dict(chain.groups) == {}, "the graph stays as it is"
    with pytest.raises(TypeError):
        grouped.groups["other"] = ()


def test_groups_come_by_their_first_functions(chain):
    cg = ep.group(ep.group(chain, "last", functions=["h"]), "first", functions="f")
    assert list(cg.groups.items()) == [("first", ("f",)), ("last", ("h",))]


def test_a_group_changes_neither_order_nor_values(chain, grouped):
    assert dict(grouped.functions) == dict(chain.functions)
    assert dict(grouped.func_io) == dict(chain.func_io)
    assert grouped.tokens == chain.tokens
    assert dict(ep.CompGraphRunner(grouped).run(a=1)) == dict(ep.CompGraphRunner(chain).run(a=1))


MADE = {
    "union with another": (lambda cg: cg | ep.CompGraph({"i": double}, {"i": ("d", "e")}), {"first": ("f", "g")}),
    "union with itself": (lambda cg: cg | cg, {"first": ("f", "g")}),
    "union with suffixes": (
        lambda cg: ep.union(cg, cg, suffixes=("_1", "_2")),
        {"first_1": ("f_1", "g_1"), "first_2": ("f_2", "g_2")},
    ),
    "union with a shared function": (
        lambda cg: ep.union(cg, cg, suffixes=("_1", "_2"), keep=("a", "f", "b")),
        {"first": ("f",), "first_1": ("g_1",), "first_2": ("g_2",)},
    ),
    "extend": (lambda cg: ep.extend(cg, {"i": double}, {"i": ("d", "e")}), {"first": ("f", "g")}),
    "rename functions": (lambda cg: ep.rename(cg, functions={"f": "g", "g": "f"}), {"first": ("g", "f")}),
    "rename tokens": (lambda cg: ep.rename(cg, tokens={"a": "z"}), {"first": ("f", "g")}),
    "suffix": (lambda cg: ep.suffix(cg, "_1"), {"first_1": ("f_1", "g_1")}),
    "a part of it": (lambda cg: ep.subgraph(cg, "b"), {"first": ("f",)}),
    "other callables": (lambda cg: with_functions(cg, dict.fromkeys(cg.functions, abs)), {"first": ("f", "g")}),
    "other defaults": (lambda cg: with_defaults(cg, {"a": 1}), {"first": ("f", "g")}),
    "pickle": (lambda cg: pickle.loads(pickle.dumps(cg)), {"first": ("f", "g")}),
    "copy": (copy.copy, {"first": ("f", "g")}),
    "deep copy": (copy.deepcopy, {"first": ("f", "g")}),
    "a pipeline's network": (lambda cg: ep.Pipeline("p", cg).cg, {"first": ("f", "g")}),
}


@pytest.mark.parametrize("way", MADE)
def test_a_graph_made_of_a_grouped_one_has_its_groups(grouped, way):
    make, expected = MADE[way]
    assert dict(make(grouped).groups) == expected


def test_a_group_vanishes_with_its_last_function(chain):
    assert dict(ep.subgraph(ep.group(chain, "last", functions=["h"]), "c").groups) == {}


def test_groups_of_one_name_become_one_in_a_union(grouped):
    other = ep.group(ep.CompGraph({"i": double}, {"i": ("d", "e")}), "first", functions=["i"])
    assert dict((grouped | other).groups) == {"first": ("f", "g", "i")}


def test_a_placeholder_that_is_filled_stays_in_its_group():
    sketch = ep.group(ep.CompGraph({"f": ep.Placeholder()}, {"f": ("x", "y")}), "sketch", functions=["f"])
    filled = ep.extend(sketch, {"f": double})
    assert dict(filled.groups) == {"sketch": ("f",)}
    assert not filled.placeholders


@pytest.mark.fuzz
@given(st.lists(st.sampled_from(["one", "two", None]), min_size=3, max_size=3), st.lists(st.sampled_from("abcdfgh")))
def test_functions_keep_their_neighbours_in_a_group_through_suffix_and_renaming(places, keep):
    io = {name: (made, taken) for name, made, taken in zip("fgh", "abc", "bcd", strict=True)}
    cg = ep.CompGraph(dict.fromkeys("fgh", double), io)
    for name in ("one", "two"):
        inside = [function for function, place in zip("fgh", places, strict=True) if place == name]
        cg = ep.group(cg, name, functions=inside) if inside else cg
    there = ep.suffix(cg, "_x", keep=keep)
    kept = {function for function in "fgh" if function in keep}
    expected = {}
    for name, inside in cg.groups.items():
        for function in inside:
            ending = "" if function in kept else "_x"
            expected.setdefault(name + ending, []).append(function + ending)
    assert {name: list(inside) for name, inside in there.groups.items()} == expected


def test_a_function_that_is_not_there_is_refused_with_the_nearest(chain):
    with pytest.raises(UnknownName, match=r"No function 'ff' in this graph. Did you mean 'f'\?"):
        ep.group(chain, "first", functions=["ff"])


@pytest.mark.parametrize(
    ("name", "functions", "said"),
    [
        ("empty", [], "would have no function"),
        ("f", ["h"], "a function outside it are both called 'f'"),
        ("first", ["h"], "There is a group 'first' already, of f, g"),
        ("second", ["g", "h"], "Function 'g' is in the group 'first' already"),
    ],
)
def test_what_can_not_be_a_group_is_refused(grouped, name, functions, said):
    with pytest.raises(GraphError, match=said):
        ep.group(grouped, name, functions=functions)


def test_a_group_may_be_called_like_a_function_inside_it(chain):
    assert dict(ep.group(chain, "f", functions=["f", "g"]).groups) == {"f": ("f", "g")}


def test_two_problems_are_reported_at_once(grouped):
    with pytest.raises(GraphError) as caught:
        ep.group(grouped, "first", functions=["g"])
    assert len(caught.value.findings) == 2


def test_a_function_in_different_groups_of_two_graphs_is_refused(chain, grouped):
    with pytest.raises(GraphError, match="in the group 'first' of one graph and in 'second' of another"):
        grouped | ep.group(chain, "second", functions=["f"])


def test_a_renaming_that_gives_a_function_the_name_of_a_group_is_refused(grouped):
    with pytest.raises(GraphError, match="both called 'first'"):
        ep.rename(grouped, functions={"h": "first"})


@pytest.mark.parametrize("name", ["", None, 3])
def test_the_name_of_a_group_is_a_text(chain, name):
    with pytest.raises(TypeError, match="not empty"):
        ep.group(chain, name, functions=["f"])


def test_a_runner_is_refused_with_the_way_to_its_graph(chain):
    with pytest.raises(TypeError, match=r"Give its graph: \.cg"):
        ep.group(ep.CompGraphRunner(chain), "first", functions=["f"])
