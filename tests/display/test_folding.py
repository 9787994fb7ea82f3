"""Graphs that are too large for a page open folded."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import epypes as ep
from epypes.display import view


def passed(*values):
    return values[0]


def graph_of(io):
    return ep.CompGraph(dict.fromkeys(io, passed), io)


def stereo(count=20):
    """Return a graph of two branches of so many functions, and as many that follow where they meet."""
    io = {}
    for side, index in itertools.product(("left", "right"), range(count)):
        io[f"{side}_{index}"] = ((f"{side}_im_{index}", f"k_{side}_{index}"), f"{side}_im_{index + 1}")
    io["meet"] = ((f"left_im_{count}", f"right_im_{count}"), "d_0")
    io |= {f"post_{index}": (f"d_{index}", f"d_{index + 1}") for index in range(count - 1)}
    return graph_of(io)


def boxes(cg):
    """Return by group of a picture the functions in it."""
    return {group.name: [function.name for function in group.graph.functions] for group in view(cg).groups}


def test_a_graph_of_60_functions_opens_as_about_ten_boxes_that_open():
    cg = stereo()
    assert len(cg.functions) == 60
    graph = view(cg)
    assert len(graph.functions) <= 12
    assert sorted(itertools.chain(*boxes(cg).values())) == sorted(cg.functions)
    first = next(iter(boxes(cg)))
    assert first == "left_0 … left_5"
    assert "left_3" in [function.name for function in view(cg, open=[first]).functions]
    assert len(view(cg, collapse=False).functions) == 60


def test_a_stretch_ends_where_a_branch_ends():
    found = boxes(stereo()).values()
    assert all(len({name.partition("_")[0] for name in inside} & {"left", "right"}) <= 1 for inside in found)


def test_a_graph_that_fits_on_a_page_is_shown_whole():
    assert boxes(graph_of({f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(24)})) == {}


def test_functions_in_groups_of_their_own_stay_in_them():
    cg = ep.group(stereo(), "first", functions=["left_0", "left_1", "left_2"])
    found = boxes(cg)
    assert found.pop("first") == ["left_0", "left_1", "left_2"]
    assert "left_0" not in itertools.chain(*found.values())


@pytest.mark.parametrize("seed", range(5))
def test_boxes_of_any_graph_never_depend_on_each_other_in_a_ring(seed):
    rng = np.random.default_rng(seed)
    tokens, io = ["t"], {}
    for index in range(80):
        io[f"f{index}"] = (tuple(dict.fromkeys(rng.choice(tokens, 3))), f"t{index}")
        tokens.append(f"t{index}")
    cg = graph_of(io)
    home = {name: group for group, inside in boxes(cg).items() for name in inside}
    after: dict[str, set[str]] = {}
    for name, (inputs, _) in io.items():
        for token in inputs:
            maker = cg.digraph.producer.get(token)
            if maker is not None and home.get(maker, maker) != home.get(name, name):
                after.setdefault(home.get(maker, maker), set()).add(home.get(name, name))
    left = {*after, *itertools.chain(*after.values())}
    while left:
        ready = {box for box in left if not after.get(box, set()) & left}
        assert ready, "a ring"
        left -= ready


def test_a_chain_of_thousands_is_folded_at_once():
    cg = graph_of({f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(3000)})
    assert [len(inside) for inside in boxes(cg).values()] == [300] * 10
