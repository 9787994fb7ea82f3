"""The algebra of graphs keeps its laws on random bipartite graphs, faulty unions left out."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep

pytestmark = pytest.mark.slow  # many graphs are made


def computing(name, count):
    """Return a function that can be told apart by what it returns: one value, ``count`` values, or nothing."""
    if count is None:
        return lambda *xs: (name, *xs)
    return lambda *xs: tuple((name, index, *xs) for index in range(count))


@st.composite
def graphs(draw, prefix="", shared=("s0", "s1")):
    """Return a graph: functions with several, one or no outputs and inputs, some inputs of a shared set of tokens."""
    known, functions, io = list(shared), {}, {}
    for index in range(draw(st.integers(0, 6))):
        name = f"{prefix}f{index}"
        inputs = tuple(draw(st.lists(st.sampled_from(known), max_size=3)))
        shape = draw(st.sampled_from(["single", "none", 1, 2, 3]))
        outputs = tuple(f"{prefix}t{index}_{place}" for place in range(shape if isinstance(shape, int) else 1))
        functions[name] = computing(name, len(outputs) if isinstance(shape, int) else None)
        io[name] = (inputs, None if shape == "none" else outputs[0] if shape == "single" else outputs)
        known += [] if shape == "none" else outputs
    order = draw(st.permutations(list(functions)))
    return ep.CompGraph({name: functions[name] for name in order}, {name: io[name] for name in order})


def content(cg):
    return dict(cg.functions), dict(cg.func_io), dict(cg.defaults)


def values(cg):
    return dict(ep.CompGraphRunner(cg).run(**{token: token for token in cg.source_tokens}))


three = st.tuples(graphs("a"), graphs("b"), graphs("c"))


@pytest.mark.fuzz
@given(three)
def test_union_is_associative_and_commutative_up_to_order(parts):
    a, b, c = parts
    assert content((a | b) | c) == content(a | (b | c)) == content(ep.union(a, b, c))
    assert content(a | b) == content(b | a)
    assert values(a | b) == values(b | a) == {**values(a), **values(b)}


@pytest.mark.fuzz
@given(graphs())
def test_union_with_itself_changes_nothing(cg):
    assert content(cg | cg) == content(cg)
    assert list((cg | cg).functions) == list(cg.functions)
    assert (cg | ep.CompGraph({}, {})).tokens == cg.tokens


@pytest.mark.fuzz
@given(graphs(), st.randoms(use_true_random=False))
def test_a_renaming_and_its_inverse_give_the_same_graph(cg, random):
    functions, tokens = (dict(zip(names, random.sample(list(names), len(names)), strict=True))
                         for names in (cg.functions, cg.tokens))  # fmt: skip
    there = ep.rename(cg, functions, tokens)
    back = ep.rename(there, {new: old for old, new in functions.items()}, {new: old for old, new in tokens.items()})
    assert content(back) == content(cg)


@pytest.mark.fuzz
@given(graphs(), st.data())
def test_a_suffix_is_taken_back_by_renaming_and_kept_names_stay(cg, data):
    names = [*cg.functions, *cg.tokens]
    keep = data.draw(st.lists(st.sampled_from(names), unique=True)) if names else []
    there = ep.suffix(cg, "_x", keep=keep)
    assert set(keep) <= {*there.functions, *there.tokens}
    back = ep.rename(
        there,
        {name: name.removesuffix("_x") for name in there.functions},
        {token: token.removesuffix("_x") for token in there.tokens},
    )
    assert content(back) == content(cg)


@pytest.mark.fuzz
@given(graphs(), st.data())
def test_running_a_subgraph_gives_what_running_the_graph_gives(cg, data):
    made = list(cg.digraph.producer)
    targets = data.draw(st.lists(st.sampled_from(made), min_size=1, unique=True)) if made else []
    part = ep.subgraph(cg, targets)
    run = ep.CompGraphRunner(cg).run(*targets, **{token: token for token in cg.source_tokens})
    found = values(part)
    assert {token: found[token] for token in targets} == {token: run[token] for token in targets}
    if targets:
        assert tuple(part.functions) == run.report.ran


@pytest.mark.fuzz
@given(graphs())
def test_a_graph_joined_to_itself_by_suffixes_runs_like_two(cg):
    shared = [token for token in cg.source_tokens if token == "s0"]
    both = ep.union(cg, cg, suffixes=("_1", "_2"), keep=shared)
    payloads = [
        {token: f"{token}{ending}" for token in cg.source_tokens if token not in shared} for ending in ("_1", "_2")
    ]
    common = dict.fromkeys(shared, "shared")
    whole = ep.CompGraphRunner(both).run(
        **common, **{token + ending: value for ending, payload in zip(("_1", "_2"), payloads, strict=True)
                     for token, value in payload.items()}
    )  # fmt: skip
    for ending, payload in zip(("_1", "_2"), payloads, strict=True):
        alone = ep.CompGraphRunner(cg).run(**common, **payload)
        assert dict(alone) == {token: whole[token if token in shared else token + ending] for token in cg.tokens}
