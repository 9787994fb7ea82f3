from __future__ import annotations

import itertools
import re

import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg
from epypes.display.layout import Box, Layout, fold, lay_out, ranks, routed_layout
from epypes.display.paint.svg import paint_edges
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


def assert_in_one_row(layout):
    """All but the first two vertices stand in one row, in their order."""
    xs = [x for x, _ in layout.centres[2:]]
    assert xs == sorted(xs)
    assert len({y for _, y in layout.centres[2:]}) == 1
    assert layout.width < 500


def assert_ends_at_their_vertices(boxes, edges, layout):
    """Each edge begins at the side of one of its vertices and ends at that of the other."""
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        for point, vertex in ((spline[0], tail), (spline[-1], head)):
            x, y = layout.centres[vertex]
            assert abs(point[0] - x) <= boxes[vertex].width / 2 + 1
            assert abs(point[1] - y) <= boxes[vertex].height / 2 + 1


@pytest.mark.parametrize("count", [45, 90])
def test_a_token_that_every_function_of_a_long_chain_takes_leaves_the_chain_straight(count):
    boxes, edges = chain_with_a_shared_token(count)
    layout = lay_out(boxes, edges)
    middles = [x for x, _ in layout.centres[: 2 * count]]
    assert max(middles[1:]) - min(middles[1:]) < BOX.width, "it is not bent by the ways of the long edges"
    assert [y for _, y in layout.centres[:count]] == sorted(y for _, y in layout.centres[:count])
    assert len(layout.splines) == len(edges)
    assert_ends_at_their_vertices(boxes, edges, layout)
    for spline in layout.splines:
        assert all(0 <= x <= layout.width for x, _ in spline)


def test_edges_that_skip_few_rows_are_routed_by_graphviz():
    boxes, edges = chain_with_a_shared_token(10)
    assert max(len(spline) for spline in lay_out(boxes, edges).splines) > 5, "around the vertices in their way"


@pytest.mark.parametrize("direction", ["down", "right"])
def test_vertices_that_may_change_places_stand_in_their_order(direction):
    boxes, edges = (BOX,) * 9, ((4, 0), (3, 0), (2, 0), (0, 6), (0, 5), (5, 1), (6, 1), (1, 8), (1, 7))
    layout = lay_out(boxes, edges, False, direction)
    across = 0 if direction == "down" else 1
    for alike in ((2, 3, 4), (5, 6), (7, 8)):
        at = [layout.centres[vertex][across] for vertex in alike]
        assert at == sorted(at)
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        for point, vertex in ((spline[0], tail), (spline[-1], head)):
            assert all(abs(a - b) <= 31 for a, b in zip(point, layout.centres[vertex], strict=True)), "its own edge"


def test_vertices_of_other_sizes_or_neighbours_keep_their_places():
    boxes, edges = (BOX, BOX, HEXAGON, BOX, BOX), ((2, 0), (3, 0), (4, 0), (4, 1))
    graphviz = routed_layout(boxes, edges, ())
    assert {round(x) for x, _ in lay_out(boxes, edges).centres} in (
        {round(x) for x, _ in graphviz.centres}, {round(graphviz.width - x) for x, _ in graphviz.centres}
    )  # fmt: skip


@pytest.mark.parametrize("direction", ["down", "right"])
@pytest.mark.parametrize("tail", [5, 6], ids=["the function's own output", "a later one"])
def test_an_edge_that_leads_back_passes_no_vertex_though_both_sides_are_taken(tail, direction):
    """Functions 0 to 2; 3 and 4 stand beside the token 7 that the edge leads to, 8 and 9 beside those it leads from."""
    boxes = (BOX,) * 11
    edges = ((3, 0), (7, 0), (4, 0), (0, 8), (0, 5), (0, 9), (5, 1), (1, 6), (8, 2), (6, 2), (9, 2), (2, 10))
    layout = lay_out(boxes, edges, False, direction, ((tail, 7),))
    assert_ends_at_their_vertices(boxes, (*edges, (tail, 7)), layout)
    places = list(points_on(layout.splines[-1]))
    assert not any(is_in(place, vertex, boxes, layout) for place in places for vertex in range(11))
    assert all(0 <= x <= layout.width and 0 <= y <= layout.height for x, y in places)


def test_many_edges_that_lead_far_back_are_arcs():
    boxes, edges = chain_with_a_shared_token(60)
    back = tuple((60 + index, 60) for index in range(30, 61))
    layout = lay_out(boxes, edges, back=back)
    assert_ends_at_their_vertices(boxes, (*edges, *back), layout)


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
        f"{x:.0f},{y:.0f}" for (x, y), *_ in lay_out(boxes, edges).splines
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
    assert_ends_at_their_vertices(boxes, edges, layout)
    middles = [x for x, _ in layout.centres[: 2 * count]]
    assert max(middles[1:]) - min(middles[1:]) < HEXAGON.width


@pytest.mark.parametrize("count", [5, 8, 11])
def test_narrow_sources_stand_in_one_row_and_their_edges_meet_below_it(count):
    lying = Box("hexagon", 28.0, 110.0)
    boxes, edges = sources_of(count, 2, lying)
    layout = lay_out(boxes, edges)
    assert_in_one_row(layout)
    doors = set()
    for (tail, _), spline in zip(edges, layout.splines, strict=True):
        x, y = layout.centres[tail]
        assert abs(spline[0][0] - x) < 1
        assert abs(spline[0][1] - y - lying.height / 2) < 1
        doors.add(spline[3])
        assert not any(
            is_in(place, vertex, boxes, layout) for place in points_on(spline) for vertex in range(2, len(boxes))
        )
    assert len(doors) == 1


# -- blocks of sinks ---------------------------------------------------------------------------------------------------


ELLIPSE = Box("ellipse", 90.0, 32.0)


def sinks_of(count, functions=1, sink=IMAGE):
    """Vertices: the functions, then the sinks, each of which comes from all functions."""
    boxes, edges = sources_of(count, functions, sink)
    return boxes, tuple((function, sink) for sink, function in edges)


@pytest.mark.parametrize("sink", [ELLIPSE, IMAGE], ids=lambda box: box.shape)
@pytest.mark.parametrize("functions", [1, 2])
@pytest.mark.parametrize("count", [5, 6, 8, 9, 10, 17, 36, 100])
def test_many_sinks_of_the_same_functions_stand_in_rows(count, functions, sink):
    boxes, edges = sinks_of(count, functions, sink)
    layout = lay_out(boxes, edges)
    rows = {}
    for x, y in layout.centres[functions:]:
        rows.setdefault(round(y), []).append(x)
    assert layout.width < 700, "no more than 4 columns of images"
    assert list(rows) == sorted(rows), "from top to bottom"
    assert all(xs == sorted(xs) for xs in rows.values()), "from left to right"
    assert len({len(xs) for xs in [*rows.values()][:-1]}) == 1 < len(rows)
    assert len(rows[max(rows)]) <= len(rows[min(rows)]) <= -(-count // len(rows))
    assert min(rows) > max(y for _, y in layout.centres[:functions]), "below their functions"
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not overlap(one, other, boxes, layout)
    for vertex, (x, y) in enumerate(layout.centres):
        assert boxes[vertex].width / 2 - 1 <= x <= layout.width - boxes[vertex].width / 2 + 1
        assert boxes[vertex].height / 2 - 1 <= y <= layout.height - boxes[vertex].height / 2 + 1


@pytest.mark.parametrize("sink", [ELLIPSE, IMAGE], ids=lambda box: box.shape)
@pytest.mark.parametrize("functions", [1, 2])
@pytest.mark.parametrize("count", [5, 9, 17, 36])
def test_the_edges_into_a_block_pass_none_of_its_vertices(count, functions, sink):
    boxes, edges = sinks_of(count, functions, sink)
    layout = lay_out(boxes, edges)
    doors = set()
    (block,) = fold(boxes, edges).blocks.values()
    for (tail, head), spline in zip(edges, layout.splines, strict=True):
        (x, y), (x1, y1) = layout.centres[tail], layout.centres[head]
        assert abs(spline[0][0] - x) <= BOX.width / 2 + 1
        assert abs(spline[0][1] - y) <= BOX.height / 2 + 1
        (x2, y2), (end, y3) = spline[-1], spline[-2]
        assert abs(abs(x2 - x1) - sink.width / 2) < 1, "the tip is at its side"
        assert abs(y2 - y1) < 1
        assert y3 == pytest.approx(y2)
        assert 5 < abs(end - x1) - sink.width / 2 < 12, "and points to it"
        places = list(points_on(spline))
        assert not any(
            is_in(place, vertex, boxes, layout) for place in places for vertex in range(functions, len(boxes))
        )
        steps = [abs(a - c) + abs(b - d) for (a, b), (c, d) in itertools.pairwise(places)]
        assert max(steps) < 144, "without gaps"
        inside = len(block.ways[block.members.index(head)])
        doors.add(spline[-inside])
        before, door, after = (x for x, _ in spline[-inside - 1 :][:3])
        assert abs(before - door) < 1 > abs(after - door), "downwards, without a bend"
    assert len(doors) == 1, "together"


@pytest.mark.parametrize("is_live", [True, False])
def test_each_sink_of_a_block_gets_the_tip_of_an_arrow(is_live):
    boxes, edges = sinks_of(9)
    views = tuple(EdgeView(tail, head - 1, False, is_live=is_live) for tail, head in edges)
    curves, tips = re.findall(r' d="([^"]*)"', "".join(paint_edges(views, edges, lay_out(boxes, edges))))
    assert tips.count("M") == 9
    assert curves.count("M") == (9 if is_live else 1 + 8), "a way of its own, or one and eight turns off it"


def test_edges_that_no_run_uses_are_not_painted_over_each_other():
    boxes, edges = sinks_of(9, sink=ELLIPSE)
    layout = lay_out(boxes, edges)
    views = tuple(EdgeView(tail, head - 1, False, is_live=False) for tail, head in edges)
    curves, _ = re.findall(r' d="([^"]*)"', "".join(paint_edges(views, edges, layout)))
    down = 0.0
    for start, points in re.findall(r"M([^C]*)C([^M]*)", curves):
        ys = [float(place.split(",")[1]) for place in (start, *points.split())]
        down += ys[-1] - ys[0]
    assert down < layout.height + 9 * 12, "one lane, and nine bends off it"


def test_an_edge_keeps_its_corners():
    corner = ((0.0, 0.0), (0.0, 0.0), (0.0, 50.0), (0.0, 50.0), (0.0, 50.0), (30.0, 50.0), (30.0, 50.0))
    layout = Layout(40.0, 60.0, ((0.0, 0.0), (40.0, 50.0)), ((*corner, (40.0, 50.0)),))
    painted = "".join(paint_edges((EdgeView(0, 0, True),), ((0, 1),), layout))
    assert re.search(r"C[^M]* 0(?:\.0)?,50(?:\.0)? ", painted)


@pytest.mark.parametrize("direction", ["down", "right"])
@pytest.mark.parametrize("makes", [True, False], ids=["makes", "takes"])
def test_a_function_of_250_tokens_is_drawn_within_the_limits(makes, direction):
    count = 250
    names = tuple(f"t{index}" for index in range(count))
    io = {"f": ("x", names) if makes else (names, "x")}
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda *_: tuple(range(count))}, io))
    run = runner.run(**dict.fromkeys(("x",) if makes else names, 1))
    bundle = ep.show(run, direction=direction)._repr_mimebundle_()
    limit = 30_000 + 600 * (count + 2)
    assert len(bundle["image/svg+xml"]) <= limit
    assert len(bundle["text/html"]) <= limit
    pieces = re.search(r'class="edge" d="M([^"]*)"', bundle["image/svg+xml"])[1].split("M")
    assert len(pieces) == count + 1
    assert max(len(piece.split()) for piece in pieces) < 40, "whatever the number of rows"


def test_few_sinks_stand_in_one_row():
    boxes, edges = sinks_of(4)
    assert len({y for _, y in lay_out(boxes, edges).centres[1:]}) == 1


def test_images_and_ellipses_of_one_function_stand_in_blocks_of_their_own():
    boxes = (BOX, *(ELLIPSE, ELLIPSE, IMAGE, IMAGE) * 3)
    layout = lay_out(boxes, tuple((0, sink) for sink in range(1, 13)))
    ellipses, images = (
        [layout.centres[sink][0] for sink in range(1, 13) if boxes[sink] is box] for box in (ELLIPSE, IMAGE)
    )
    assert max(ellipses) < min(images) or max(images) < min(ellipses)


def test_sinks_of_different_sizes_do_not_overlap():
    sizes = (IMAGE, Box("box", 171.0, 100.0), Box("box", 60.0, 30.0))
    boxes = (BOX, *sizes * 5)
    layout = lay_out(boxes, tuple((0, sink) for sink in range(1, 16)))
    assert layout.width < 5 * 171
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not overlap(one, other, boxes, layout)
    for head, spline in enumerate(layout.splines, start=1):
        assert abs(abs(spline[-1][0] - layout.centres[head][0]) - boxes[head].width / 2) < 1
        assert not any(is_in(place, vertex, boxes, layout) for place in points_on(spline) for vertex in range(1, 16))


def test_a_token_that_a_function_takes_stands_outside_the_block_of_sinks():
    boxes, edges = sinks_of(9)
    (block,) = fold((*boxes, BOX), (*edges, (4, 10))).blocks.values()
    assert set(block.members) == {1, 2, 3, 5, 6, 7, 8, 9}


@pytest.mark.parametrize("direction", ["down", "right"])
def test_a_block_of_sources_can_lead_to_one_of_sinks(direction):
    boxes = (HEXAGON,) * 6 + (IMAGE,) * 7
    edges = tuple((source, sink) for source in range(6) for sink in range(6, 13))
    layout = lay_out(boxes, edges, direction=direction)
    assert len(fold(boxes, edges).boxes) == 2
    assert_ends_at_their_vertices(boxes, edges, layout)
    for spline in layout.splines:
        assert not any(is_in(place, vertex, boxes, layout) for place in points_on(spline) for vertex in range(13))


@pytest.mark.parametrize("count", [5, 8, 11])
def test_narrow_sinks_stand_in_one_row_and_their_edges_part_above_it(count):
    narrow = Box("ellipse", 28.0, 110.0)
    boxes, edges = sinks_of(count, 2, narrow)
    layout = lay_out(boxes, edges)
    assert_in_one_row(layout)
    doors = set()
    for (_, head), spline in zip(edges, layout.splines, strict=True):
        x, y = layout.centres[head]
        assert spline[-1] == pytest.approx((x, y - narrow.height / 2)), "the tip is at its top"
        assert spline[-2][0] == pytest.approx(x), "and comes from above"
        assert 5 < spline[-1][1] - spline[-2][1] < 12
        doors.add(spline[-5])
        assert not any(
            is_in(place, vertex, boxes, layout) for place in points_on(spline) for vertex in range(2, len(boxes))
        )
    assert len(doors) == 1


# -- directions -------------------------------------------------------------------------------------------------------


def lying(boxes):
    return tuple(Box(box.shape, box.height, box.width) for box in boxes)


CASES = {
    "a block": sources_of(9, 2),
    "a block of sinks": sinks_of(9, 2),
    "a chain with arcs": chain_with_a_shared_token(45),
    "a row": sources_of(3),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("is_dense", [False, True])
def test_a_picture_to_the_right_is_one_downwards_seen_over_the_diagonal(case, is_dense):
    boxes, edges = CASES[case]
    right, down = lay_out(boxes, edges, is_dense, "right"), lay_out(lying(boxes), edges, is_dense)
    assert (right.width, right.height) == (down.height, down.width)
    assert right.centres == tuple((y, x) for x, y in down.centres)
    assert right.splines == tuple(tuple((y, x) for x, y in spline) for spline in down.splines)


@pytest.mark.parametrize("case", CASES)
def test_to_the_right_every_edge_leads_to_the_right_and_no_vertices_overlap(case):
    boxes, edges = CASES[case]
    layout = lay_out(boxes, edges, direction="right")
    assert all(layout.centres[tail][0] < layout.centres[head][0] for tail, head in edges)
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not overlap(one, other, boxes, layout)
    assert_ends_at_their_vertices(boxes, edges, layout)


@pytest.mark.parametrize("direction", ["down", "right"])
def test_inputs_and_branches_stand_in_their_order(direction):
    """Two branches of two functions each, and what joins them; the joining function takes them in this order."""
    axis = 0 if direction == "down" else 1
    for first, second in ((5, 8), (8, 5)):
        edges = [(5, 0), (0, 6), (6, 1), (1, 7), (8, 2), (2, 9), (9, 3), (3, 10), (7, 4), (10, 4), (4, 11)]
        if first == 8:
            edges[8:10] = edges[9], edges[8]
        layout = lay_out((BOX,) * 12, tuple(edges), direction=direction)
        assert layout.centres[first][axis] < layout.centres[second][axis]


def test_the_images_of_the_orb_graph_stand_in_their_order():
    io = {"match": (("descriptors_1", "descriptors_2", "normType", "crossCheck"), "matches")}
    for index in (1, 2):
        shared = ("nfeatures", "scaleFactor", "nlevels", "edgeThreshold", "WTA_K", "scoreType", "patchSize")
        inputs = (f"image_{index}", f"mask_{index}", *shared)
        io[f"detect_and_describe_features_{index}"] = (inputs, (f"keypoints_{index}", f"descriptors_{index}"))
    io["gather_keypoints"] = (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired")
    svg = to_svg(ep.CompGraph(dict.fromkeys(io, ep.Placeholder()), io))
    one, two = (float(re.search(rf'id="token-image_{index}".*?<text[^>]* x="([^"]*)"', svg)[1]) for index in (1, 2))
    assert one < two


# -- rings and large graphs -------------------------------------------------------------------------------------------


RING = (BOX,) * 6, ((4, 0), (0, 2), (2, 1), (1, 3), (3, 0), (1, 5))


@pytest.mark.parametrize("direction", ["down", "right"])
@pytest.mark.parametrize("is_dense", [False, True])
def test_boxes_that_lead_to_each_other_in_a_ring_are_placed(direction, is_dense):
    boxes, edges = RING
    layout = lay_out(boxes, edges, is_dense, direction)
    for one, other in itertools.combinations(range(len(boxes)), 2):
        assert not overlap(one, other, boxes, layout)
    assert len(layout.splines) == (0 if is_dense else len(edges))


def test_a_ring_is_cut_at_its_first_vertex():
    assert ranks(3, [(0, 1), (1, 2), (2, 0)]) == [0, 1, 2]
    assert ranks(*(len(RING[0]), RING[1])) == [1, 3, 2, 4, 0, 4], "where it is entered"


def test_rows_do_not_depend_on_the_order_of_edges():
    edges = [(0, 1), (1, 2), (2, 3), (0, 3), (4, 2)]
    for shuffled in itertools.permutations(edges):
        assert ranks(5, shuffled) == [0, 1, 2, 3, 0]


def test_a_very_large_graph_is_drawn_in_rows_without_a_word(capfd):
    count = 600
    io = {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)}
    cg = ep.CompGraph(dict.fromkeys(io, abs), io)
    svg = ep.show(cg, collapse=False).svg
    assert svg.count("<g ") == len(cg.functions) + len(cg.tokens) == 1201
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_graph_of_200_functions_is_laid_out_once_whatever_its_values():
    io = {f"f{index}": ((f"t{index - index % 4}", f"k{index}"), f"t{index + 1}") for index in range(200)}
    runner = ep.CompGraphRunner(
        ep.CompGraph(dict.fromkeys(io, lambda x, k: x + k), io), {f"k{index}": 1 for index in range(200)}
    )
    lay_out.cache_clear()
    mimebundle(ep.show(runner.run(t0=100_000), collapse=False))
    for value in (2, 3, 4):
        mimebundle(ep.show(runner.rerun(k100=value), collapse=False))
    assert lay_out.cache_info().misses == 1


def test_hyperparameters_stand_in_stacks_where_the_graph_would_be_wider_than_a_page():
    names = {side: tuple(f"a_long_name_{side}_{index}" for index in range(4)) for side in ("left", "right")}
    io = {side: ((f"image_{side}", *names[side]), f"result_{side}") for side in names}
    io["meet"] = (("result_left", "result_right"), "result")
    cg = ep.CompGraph(dict.fromkeys(io, lambda *values: 1), io)
    runner = ep.CompGraphRunner(cg, dict.fromkeys((*names["left"], *names["right"]), 1))
    svg = to_svg(runner)
    at = {name: re.search(rf'id="token-{name}".*?<text [^>]*x="(\d+)" y="(\d+)"', svg) for name in names["left"]}
    assert float(re.search(r'width="(\d+)"', svg)[1]) < 1_000
    assert len({found[1] for found in at.values()}) == 1, "one below the other"
    assert [int(found[2]) for found in at.values()] == sorted(int(found[2]) for found in at.values())


def test_data_flows_straight_down_past_hyperparameters():
    io = {f"f{index}": ((f"t{index}", f"threshold_{index}"), f"t{index + 1}") for index in range(6)}
    runner = ep.CompGraphRunner(
        ep.CompGraph(dict.fromkeys(io, lambda *values: 1), io), {f"threshold_{index}": 1 for index in range(6)}
    )
    svg = to_svg(runner)
    middles = {re.search(rf'id="token-t{index}".*?<text [^>]*x="(\d+)"', svg)[1] for index in range(1, 7)}
    assert len(middles) == 1
