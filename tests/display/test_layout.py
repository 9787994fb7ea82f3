from __future__ import annotations

import pytest

from epypes.display.layout import Box, lay_out

BOX = Box("box", 60.0, 30.0)


def chain_with_a_shared_token(count):
    """Vertices: the functions, then the tokens of the chain, then the token that every function takes."""
    shared = 2 * count + 1
    edges = []
    for index in range(count):
        edges += [(count + index, index), (shared, index), (index, count + index + 1)]
    return (BOX,) * (2 * count + 2), tuple(edges)


@pytest.mark.parametrize("count", [45, 90])
def test_a_token_that_every_function_of_a_long_chain_takes_leaves_the_chain_straight(count):
    boxes, edges = chain_with_a_shared_token(count)
    layout = lay_out(boxes, edges)
    middles = [x for x, _ in layout.centres[: 2 * count]]
    assert max(middles[1:]) - min(middles[1:]) < BOX.width, "it is not bent by the ways of the long edges"
    assert [y for _, y in layout.centres[:count]] == sorted(y for _, y in layout.centres[:count])
    assert len(layout.splines) == len(edges)
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        for point, vertex in ((spline[0], tail), (spline[-1], head)):
            x, y = layout.centres[vertex]
            assert abs(point[0] - x) <= BOX.width / 2 + 1
            assert abs(point[1] - y) <= BOX.height / 2 + 1
        assert all(0 <= x <= layout.width for x, _ in spline)


def test_edges_that_skip_few_rows_are_routed_by_graphviz():
    boxes, edges = chain_with_a_shared_token(10)
    assert max(len(spline) for spline in lay_out(boxes, edges).splines) > 5, "around the vertices in their way"
