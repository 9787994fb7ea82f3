"""Pipelines show what events pass, as it is at the moment."""

from __future__ import annotations

import queue
import re
import xml.etree.ElementTree as ET
from dataclasses import FrozenInstanceError, replace
from html import unescape

import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.layout import lay_out
from epypes.display.paint.svg import alt_text, paint_svg
from epypes.display.paint.tables import paint_text
from epypes.pipeline.reactive import queue_stage
from tests.display.test_display import SVG, texts, vertices
from tests.display.test_states import TIMEOUT_S, Gate


def graph(function=lambda x: x + 1) -> ep.CompGraph:
    return ep.CompGraph({"f": function, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")})


def f_in(event):
    if event == "bad":
        raise ValueError("no such event")
    return {"x": event}


def f_out(pipe):
    return pipe["z"]


def full(q_in=None, q_out=None, into=f_in, out=f_out, cg=None) -> ep.FullPipeline:
    q_in, q_out = q_in or queue.Queue(), q_out or queue.Queue()
    return ep.FullPipeline("edges", cg or graph(), q_in, q_out, into, out)


def stages(pipe) -> dict[str, ep.Stage]:
    return {stage.name: stage for stage in (*pipe.stages.before, *pipe.stages.after)}


def work_off(pipe) -> None:
    pipe.listen()
    assert pipe.loop.drain(TIMEOUT_S)


# -- what is drawn ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pipe", "before", "after"),
    [
        (ep.Pipeline("edges", graph()), [], []),
        (ep.SourcePipeline("edges", graph(), queue.Queue(), f_out), [], ["f_out", "q_out"]),
        (ep.SinkPipeline("edges", graph(), queue.Queue(), f_in), ["q_in", "EventLoop", "f_in"], []),
        (full(), ["q_in", "EventLoop", "f_in"], ["f_out", "q_out"]),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, ep.Pipeline) else "",
)
def test_a_pipeline_is_drawn_with_what_it_has(pipe, before, after):
    seen = view(pipe)
    assert seen.title == "edges"
    assert [stage.name for stage in seen.before] == before
    assert [stage.name for stage in seen.after] == after
    bundle = pipe._repr_mimebundle_()
    assert set(bundle) == {"text/plain", "text/html", "image/svg+xml"}
    found = vertices(bundle["image/svg+xml"])
    assert [name for name in found if name and name.startswith("stage-")] == [
        f"stage-{name}" for name in before + after
    ]
    assert {"function-f", "token-z"} <= set(found), "the graph is inside"
    root = ET.fromstring(bundle["image/svg+xml"])
    (label,) = (group for group in root.iter(f"{SVG}g") if group.get("class") == "label")
    assert texts(label) == ["edges"]
    left, top, _, _ = box_of(label)
    x0, y0, _, _ = map(float, root.get("viewBox").split())
    assert x0 < left
    assert y0 < top


def box_of(group: ET.Element) -> tuple[float, float, float, float]:
    rect = group if group.tag == f"{SVG}rect" else group.find(f"{SVG}rect")
    x, y, width, height = (float(rect.get(name)) for name in ("x", "y", "width", "height"))
    return x, y, x + width, y + height


@pytest.mark.parametrize("direction", ["down", "right"])
@pytest.mark.parametrize("width", [1, 9])
def test_stages_stand_beside_the_frame_and_the_frame_around_the_graph(direction, width):
    io = {f"a function with a name {index}": (f"x{index}", f"y{index}") for index in range(width)}
    pipe = full(cg=ep.CompGraph(dict.fromkeys(io, abs), io))
    svg = paint_svg(replace(view(pipe), direction=direction))
    root, found = ET.fromstring(svg), vertices(svg)
    (frame,) = (rect for rect in root.iter(f"{SVG}rect") if rect.get("class") == "frame")
    left, top, right, bottom = box_of(frame)
    x0, y0, across, down = map(float, root.get("viewBox").split())
    for name in ("q_in", "EventLoop", "f_in", "f_out", "q_out"):
        a, b, c, d = box_of(found[f"stage-{name}"])
        assert d < top or b > bottom or c < left or a > right, "outside the frame"
        assert x0 <= a < c <= x0 + across
        assert y0 <= b < d <= y0 + down
        before = name in ("q_in", "EventLoop", "f_in")
        if direction == "down":
            assert (d < top) == before
        else:
            assert (c < left) == before
    for name in io:
        a, b, c, d = box_of(found["function-" + re.sub(" ", ":20:", name)])
        assert left < a < c < right
        assert top < b < d < bottom


def test_stages_ask_for_no_layout_of_their_own():
    lay_out.cache_clear()
    pipe = full()
    to_svg(pipe.runner)
    pipe.q_in.put(1)
    to_svg(pipe)
    assert lay_out.cache_info().misses == 1


def test_the_table_the_text_and_the_alternative_text_tell_the_stages():
    pipe = full()
    html = unescape(mimebundle(pipe)["text/html"])
    for said in ("queue q_in", "loop EventLoop", "function f_out", "stopped; 0 events, 0 failed", "Queue; 0 waiting"):
        assert f"<td>{said}</td>" in html
    alt = alt_text(view(pipe))
    assert alt.startswith("Pipeline edges, events go through q_in, EventLoop, f_in, the graph, f_out, q_out. ")
    assert f'alt="{alt}"' in html
    lines = paint_text(view(pipe)).splitlines()
    assert lines[:3] == [
        "pipeline edges",
        "queue q_in  [Queue; 0 waiting]",
        "loop EventLoop  [stopped; 0 events, 0 failed]",
    ]
    assert lines.index("f(x) -> y") < lines.index("queue q_out  [Queue; 0 waiting]")


# -- live counts ------------------------------------------------------------------------------------------------------


def test_queues_tell_what_they_are_how_many_wait_and_what_was_dropped():
    mailbox = ep.Mailbox("drop_oldest", 2)
    pipe = full(queue.Queue(maxsize=4), mailbox)
    for x in range(3):
        pipe.q_in.put(x)
        mailbox.put(x)
    assert stages(pipe)["q_in"].notes == ("Queue", "3 of 4 waiting")
    assert stages(pipe)["q_out"].notes == ("Mailbox drop_oldest", "2 of 2 waiting", "1 dropped: oldest")
    assert texts(vertices(to_svg(pipe))["stage-q_out"]) == ["q_out", *stages(pipe)["q_out"].notes]


class Hostile:
    """A queue of which nothing can be asked."""

    def __getattr__(self, name):
        raise RuntimeError(name)


class Odd(queue.SimpleQueue):
    maxsize = "many"

    def qsize(self):
        return "a few"


@pytest.mark.parametrize(
    "anything", [Hostile(), Odd(), object(), None, 3, Hostile], ids=lambda thing: type(thing).__name__
)
def test_any_object_may_be_a_queue_or_a_function(anything):
    assert queue_stage("q_in", anything).notes == (type(anything).__name__,)
    pipe = ep.FullPipeline("edges", graph(), anything, anything, anything, anything)
    assert "image/svg+xml" in mimebundle(pipe)


def test_the_loop_tells_whether_it_listens_and_what_it_has_done():
    pipe = full()
    assert (stages(pipe)["EventLoop"].state, stages(pipe)["EventLoop"].notes) == ("stopped", ("0 events, 0 failed",))
    for event in (1, "bad", "text"):
        pipe.q_in.put(event)
    pipe.on_error = lambda failure: None
    work_off(pipe)
    assert stages(pipe)["EventLoop"].notes == ("3 events, 2 failed",)
    with pipe:
        assert stages(pipe)["EventLoop"].state == "running"
        group = vertices(to_svg(pipe))["stage-EventLoop"]
        assert group.get("class") == "stage loop running"
        assert texts(group)[1] == "listening"
    assert texts(vertices(to_svg(pipe))["stage-EventLoop"])[1] == "stopped"


def test_functions_tell_their_names_and_what_they_raised_for_the_last_event():
    pipe = full(out=lambda pipe: 1 / pipe["z"])
    pipe.on_error = lambda failure: None
    assert (stages(pipe)["f_in"].notes, stages(pipe)["f_out"].notes) == ((), ("<lambda>",))
    pipe.handle("bad")
    assert (stages(pipe)["f_in"].state, stages(pipe)["f_in"].notes) == ("failed", ("ValueError: no such event",))
    group = vertices(to_svg(pipe))["stage-f_in"]
    assert group.get("class") == "stage call failed"
    assert texts(group) == ["f_in", "failed", "ValueError: no such event"]
    pipe.handle(-1)
    assert stages(pipe)["f_in"].state == "static", "another event has come through"
    assert stages(pipe)["f_out"].notes == ("<lambda>", "ZeroDivisionError: division by zero")
    pipe.handle("text")
    assert {stage.state for stage in pipe.stages.after} == {"static"}, "this one failed in the graph"
    pipe.handle("bad")
    pipe.handle(1)
    assert {stage.state for stage in (*pipe.stages.before, *pipe.stages.after)} == {"static", "stopped"}


@pytest.mark.parametrize("place", ["f_in", "f", "f_out"])
def test_what_an_event_is_in_is_told_while_a_pipeline_listens(place):
    gate = Gate()
    waits = {"f_in": f_in, "f": lambda x: x, "f_out": f_out, place: lambda x: gate({"x": 1} if place == "f_in" else x)}
    pipe = full(into=waits["f_in"], cg=graph(waits["f"]), out=waits["f_out"])
    with pipe, gate.holding(lambda: pipe.q_in.put(1)):
        states = {name: stage.state for name, stage in stages(pipe).items()}
        states["f"] = view(pipe).functions[0].state
        assert {name for name, state in states.items() if state == "running"} == {"EventLoop", place}
        kind = "function" if place == "f" else "stage"
        assert "running" in texts(vertices(to_svg(pipe))[f"{kind}-{place}"])
    assert pipe.q_out.get(timeout=TIMEOUT_S) is not None
    assert stages(pipe)["f_in"].state == stages(pipe)["f_out"].state == "static"


def test_an_answer_that_waits_for_room_is_told():
    gate = Gate()

    class Full(queue.Queue):
        def put(self, item, block=True, timeout=None):
            gate(item)

    pipe = full(q_out=Full())
    with gate.holding(lambda: pipe.handle(1)):
        assert (stages(pipe)["f_out"].state, stages(pipe)["q_out"].state) == ("static", "running")
        assert "put waits for room" in texts(vertices(to_svg(pipe))["stage-q_out"])
    assert stages(pipe)["q_out"].state == "static"


@pytest.mark.parametrize("place", ["f_in", "f_out"])
def test_another_pipeline_with_the_same_functions_is_not_told_as_running(place):
    gate = Gate()
    more = {"f_in": {"into": lambda event: gate({"x": event})}, "f_out": {"out": lambda pipe: gate(1)}}[place]
    pipe, other = full(**more), full(**more)
    with gate.holding(lambda: pipe.handle(1)):
        assert (stages(pipe)[place].state, stages(other)[place].state) == ("running", "static")


def test_a_source_pipeline_tells_f_out_and_q_out_on_whatever_thread_it_runs():
    gate = Gate()
    pipe = ep.SourcePipeline("source", graph(), queue.Queue(), lambda view: gate(view["z"]))
    with gate.holding(lambda: pipe.run(x=1)):
        assert stages(pipe)["f_out"].state == "running"
    assert stages(pipe)["q_out"].notes == ("Queue", "1 waiting")


def test_looking_calls_nothing_and_takes_nothing():
    def fails(*args):
        pytest.fail("called")

    pipe = full(into=fails, out=fails, cg=graph(fails))
    pipe.q_in.put(1)
    for _ in range(2):
        mimebundle(pipe)
    assert (pipe.q_in.qsize(), pipe.loop.handled, pipe.run_count) == (1, 0, 0)
    assert not pipe.loop.is_running


# -- subclasses and what is written into names ------------------------------------------------------------------------


class Logged(ep.FullPipeline):
    """A user's pipeline with a stage of its own, which says what it likes."""

    @property
    def stages(self):
        found = super().stages
        own = ep.Stage("robot", "log" * 100, "dreaming", ("<script>alert(1)</script>", *map(str, range(99))))
        return replace(found, after=(*found.after, own))


class Broken(ep.FullPipeline):
    @property
    def stages(self):
        raise RuntimeError("not today")


def test_a_pipeline_of_ones_own_may_add_stages():
    bundle = mimebundle(Logged("<b>mine</b>", graph(), queue.Queue(), queue.Queue(), f_in, f_out))
    assert "<script>alert" not in bundle["text/html"]
    assert "<b>mine" not in bundle["text/html"] + bundle["image/svg+xml"]
    classes = [group.get("class") for group in ET.fromstring(bundle["image/svg+xml"]).iter(f"{SVG}g")]
    assert classes.count("stage call static") == 3, "what is unknown is drawn as a function"
    assert len(bundle["text/html"].encode()) < 30_000 + 600 * (5 + 6)


def test_a_pipeline_that_can_not_tell_its_stages_is_shown_without():
    shown = mimebundle(Broken("broken", graph(), queue.Queue(), queue.Queue(), f_in, f_out))
    assert "its stages can't be read: RuntimeError: not today" in unescape(shown["text/html"])
    assert "function-f" in vertices(shown["image/svg+xml"])


@pytest.mark.parametrize("name", ["\ud800", "a\0b", "two\nlines", "x" * 100_000, "数え", " ", ""], ids=ascii)
def test_a_pipeline_of_any_name_can_be_shown(name):
    pipe = ep.SinkPipeline(name, graph(), queue.Queue(), f_in)
    bundle = mimebundle(pipe)
    ET.fromstring(bundle["image/svg+xml"])
    assert len(bundle["text/html"].encode()) < 40_000
    assert len(bundle["text/plain"]) < 100


def test_a_stage_is_a_frozen_record():
    stage = full().stages.before[0]
    with pytest.raises(FrozenInstanceError):
        stage.name = "other"
    assert stage == ep.Stage("queue", "q_in", "static", ("Queue", "0 waiting"))
