"""Order and cycles agree with networkx on random graphs, faulty ones included."""

from __future__ import annotations

import networkx as nx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.graph.bipartite import BipartiteDigraph


@st.composite
def digraphs(draw):
    """Return functions that each make one token and take up to two, cycles allowed."""
    count = draw(st.integers(1, 9))
    token = st.integers(0, count - 1).map(lambda index: f"t{index}")
    inputs = {f"f{index}": tuple(draw(st.lists(token, max_size=2))) for index in range(count)}
    return BipartiteDigraph(inputs, {f"f{index}": (f"t{index}",) for index in range(count)})


def as_networkx(graph: BipartiteDigraph) -> nx.DiGraph:
    oracle = nx.DiGraph()
    oracle.add_nodes_from(graph.inputs)
    oracle.add_edges_from((graph.producer[token], name) for name, tokens in graph.inputs.items() for token in tokens)
    return oracle


@pytest.mark.slow
@pytest.mark.fuzz
@given(digraphs())
def test_the_cycle_that_is_named_is_a_shortest_one(graph):
    cycle = graph.shortest_cycle()
    shortest = min(map(len, nx.simple_cycles(as_networkx(graph))), default=0)
    assert len(cycle) == (2 * shortest + 1 if shortest else 0)
    for token, function, made in zip(cycle[::2], cycle[1::2], cycle[2::2], strict=False):
        assert token in graph.inputs[function]
        assert made in graph.outputs[function]


@pytest.mark.slow
@pytest.mark.fuzz
@given(digraphs())
def test_the_run_order_is_the_topological_order_that_comes_first_by_definition(graph):
    oracle = as_networkx(graph)
    if nx.is_directed_acyclic_graph(oracle):
        place = list(graph.inputs).index
        assert list(graph.run_order()) == list(nx.lexicographical_topological_sort(oracle, key=place))
