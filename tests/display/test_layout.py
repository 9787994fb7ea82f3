from __future__ import annotations

import itertools
import re

import pytest

from epypes.display.layout.blocks import fold
from epypes.display.layout.geometry import Box
from epypes.display.layout.place import lay_out
from epypes.display.paint.edges import paint_edges
from epypes.display.views.graphview import EdgeView

BOX = Box("box", 60.0, 30.0)
HEXAGON = Box("hexagon", 110.0, 28.0)
IMAGE = Box("box", 140.0, 144.0)


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


# -- blocks -----------------------------------------------------------------------------------------------------------


def sources_of(count, functions=1, source=HEXAGON):
    """Vertices: the functions, then the sources, each of which all functions take."""
    boxes = (BOX,) * functions + (source,) * count
    return boxes, tuple((functions + index, head) for head in range(functions) for index in range(count))


def overlap(one, other, boxes, layout):
    (x0, y0), (x1, y1) = layout.centres[one], layout.centres[other]
    across, down = (boxes[one].width + boxes[other].width) / 2, (boxes[one].height + boxes[other].height) / 2
    return abs(x0 - x1) < across and abs(y0 - y1) < down


def points_on(spline):
    """Return points of all the curves of a spline; its tip is not one of them."""
    start, *controls = spline[:-1]
    assert len(controls) % 3 == 0, "curves of three points each"
    for a, b, c in zip(controls[::3], controls[1::3], controls[2::3], strict=True):
        for step in range(11):
            t = step / 10
            weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
            yield tuple(sum(w * p[axis] for w, p in zip(weights, (start, a, b, c), strict=True)) for axis in (0, 1))
        start = c


def is_in(point, vertex, boxes, layout):
    (x, y), box = layout.centres[vertex], boxes[vertex]
    return abs(point[0] - x) < box.width / 2 - 1 and abs(point[1] - y) < box.height / 2 - 1


@pytest.mark.parametrize("source", [HEXAGON, Box("ellipse", 90.0, 32.0), IMAGE], ids=lambda box: box.shape)
@pytest.mark.parametrize("functions", [1, 2])
@pytest.mark.parametrize("count", [5, 8, 9, 17, 36, 100])
def test_many_sources_of_the_same_functions_stand_in_rows(count, functions, source):
    boxes, edges = sources_of(count, functions, source)
    layout = lay_out(boxes, edges)
    rows = {round(y) for _, y in layout.centres[functions:]}
    assert len(rows) >= count**0.5 - 1
    assert layout.width < 7 * (source.width + 30)
    assert max(rows) < min(y for _, y in layout.centres[:functions]), "above their functions"
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not overlap(one, other, boxes, layout)
    for vertex, (x, y) in enumerate(layout.centres):
        assert boxes[vertex].width / 2 - 1 <= x <= layout.width - boxes[vertex].width / 2 + 1
        assert boxes[vertex].height / 2 - 1 <= y <= layout.height - boxes[vertex].height / 2 + 1


@pytest.mark.parametrize("functions", [1, 2])
@pytest.mark.parametrize("count", [5, 9, 17, 36])
def test_the_edges_of_a_block_pass_none_of_its_vertices(count, functions):
    boxes, edges = sources_of(count, functions)
    layout = lay_out(boxes, edges)
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        (x, y), (x1, y1) = layout.centres[tail], layout.centres[head]
        assert abs(abs(spline[0][0] - x) - HEXAGON.width / 2) < 1
        assert abs(spline[0][1] - y) < 1
        assert abs(spline[-1][0] - x1) <= BOX.width / 2 + 1
        assert abs(spline[-1][1] - y1) <= BOX.height / 2 + 1
        places = list(points_on(spline))
        assert not any(
            is_in(place, vertex, boxes, layout) for place in places for vertex in range(functions, len(boxes))
        )
        steps = [abs(a - c) + abs(b - d) for (a, b), (c, d) in itertools.pairwise(places)]
        assert max(steps) < HEXAGON.width, "without gaps"


@pytest.mark.parametrize("count", [9, 17])
def test_the_edges_of_a_block_leave_it_together_and_without_a_bend(count):
    boxes, edges = sources_of(count, 2)
    splines = dict(zip(edges, lay_out(boxes, edges).splines, strict=True))
    (block,) = fold(boxes, edges).blocks.values()
    doors = set()
    for (tail, _), spline in splines.items():
        inside = len(block.ways[block.members.index(tail)])
        doors.add(spline[inside - 1])
        assert abs(spline[inside][0] - spline[inside - 1][0]) < 1, "downwards, as they came"
    assert len(doors) == 1


def test_what_several_edges_share_is_painted_once():
    (boxes, edges) = sources_of(9, 2)
    views = tuple(EdgeView(head, tail - 2, True, is_live=False) for tail, head in edges)
    curves, tips = re.findall(r' d="([^"]*)"', "".join(paint_edges(views, edges, lay_out(boxes, edges))))
    painted, at = [], ""
    for move, points in re.findall(r"M([^C]*)C([^M]*)", curves):
        at, left = move, points.split()
        for place in range(0, len(left), 3):
            painted.append((at, *left[place : place + 3]))
            at = left[place + 2]
    assert len(painted) == len(set(painted)) <= 9 + 5 + 4, (
        "a bend for each source, a way down from row to row, two ends"
    )
    assert {curve[0] for curve in painted} - {curve[-1] for curve in painted} == {
        f"{x:.1f},{y:.1f}" for (x, y), *_ in lay_out(boxes, edges).splines
    }, "each edge begins at its source, and goes on somewhere"
    assert tips.count("M") == 2


def test_few_sources_stand_in_one_row():
    boxes, edges = sources_of(4)
    assert len({y for _, y in lay_out(boxes, edges).centres[1:]}) == 1


def test_images_and_hexagons_stand_in_blocks_of_their_own():
    boxes = (BOX, *(HEXAGON, HEXAGON, IMAGE, IMAGE) * 3)
    layout = lay_out(boxes, tuple((source, 0) for source in range(1, 13)))
    hexagons, images = (
        [layout.centres[source][0] for source in range(1, 13) if boxes[source] is box] for box in (HEXAGON, IMAGE)
    )
    assert max(hexagons) < min(images) or max(images) < min(hexagons)


def test_sources_of_different_functions_stand_in_different_blocks():
    boxes = (BOX, BOX, *(HEXAGON,) * 12)
    layout = lay_out(boxes, tuple((2 + index, index // 2 % 2) for index in range(12)))
    ones, others = ([layout.centres[2 + index][0] for index in range(12) if index // 2 % 2 == head] for head in (0, 1))
    assert max(ones) < min(others) or max(others) < min(ones)


def test_a_block_that_every_function_of_a_long_chain_takes_is_joined_by_arcs():
    count, shared = 90, 6
    boxes, chain = chain_with_a_shared_token(count)
    first = len(boxes) - 1
    edges = [edge for edge in chain if edge[0] != first]
    edges += [(first + index, head) for head in range(count) for index in range(shared)]
    boxes = (*boxes[:-1], *(HEXAGON,) * shared)
    layout = lay_out(boxes, tuple(edges))
    assert len(layout.splines) == len(edges)
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        for point, vertex in ((spline[0], tail), (spline[-1], head)):
            x, y = layout.centres[vertex]
            assert abs(point[0] - x) <= boxes[vertex].width / 2 + 1
            assert abs(point[1] - y) <= boxes[vertex].height / 2 + 1
    middles = [x for x, _ in layout.centres[: 2 * count]]
    assert max(middles[1:]) - min(middles[1:]) < HEXAGON.width
