"""Everything that was started stops, from any thread, at any time, and can be started again."""

from __future__ import annotations

import gc
import itertools
import queue
import signal
import subprocess
import sys
import threading
import time
import weakref

import pytest

import epypes as ep
from epypes.errors import StillRunning

TIMEOUT_S = 60.0
GRAPH = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})


def full(q_in=None, cg=GRAPH, f_out=lambda view: view["y"]) -> ep.FullPipeline:
    return ep.FullPipeline("p", cg, q_in or queue.SimpleQueue(), queue.SimpleQueue(), lambda event: {"x": event}, f_out)


def test_stop_does_not_wait_for_a_backlog_that_takes_long():
    started, release = threading.Event(), threading.Event()

    def hold(x):
        started.set()
        assert release.wait(TIMEOUT_S)
        return x

    pipe = full(cg=ep.CompGraph({"hold": hold}, {"hold": ("x", "y")}))
    for event in range(1_000):
        pipe.q_in.put(event)
    pipe.listen()
    assert started.wait(TIMEOUT_S)
    stopper = threading.Thread(target=pipe.stop)
    stopper.start()
    assert pipe.loop._stop.wait(TIMEOUT_S)
    release.set()
    stopper.join(TIMEOUT_S)
    assert not pipe.loop.is_running
    assert (pipe.q_in.qsize(), pipe.q_out.qsize()) == (999, 1), "the event under way was worked off, no other"


@pytest.mark.parametrize("make", [queue.Queue, queue.SimpleQueue, ep.Mailbox], ids=lambda make: make.__name__)
def test_an_idle_pipeline_stops_on_any_queue(make):
    pipe = full(make())
    with pipe:
        assert pipe.loop.is_running
    assert not pipe.loop.is_running


def test_two_pipelines_on_one_queue_stop_apart_and_share_its_events():
    q_in = queue.SimpleQueue()
    first, second = full(q_in), full(q_in)
    with second:
        first.listen()
        first.stop()
        assert second.loop.is_running
        for event in range(100):
            q_in.put(event)
        assert [second.q_out.get(timeout=TIMEOUT_S) for _ in range(100)] == list(range(100))
        first.listen()
        for event in range(200):
            q_in.put(event)
        assert first.loop.drain(TIMEOUT_S)
    answers = [pipe.q_out.get_nowait() for pipe in (first, second) for _ in range(pipe.q_out.qsize())]
    assert sorted(answers) == list(range(200)), "each event was answered once"


@pytest.mark.parametrize("where", ["f_in", "function", "f_out", "on_error"])
def test_a_stop_from_inside_an_event_returns_and_ends_the_loop_after_it(where):
    here = {name: (lambda: None) for name in ("f_in", "function", "f_out", "on_error")}

    def call(name, value):
        here[name]()
        return value

    def function(x):
        if where == "on_error":
            raise ValueError(x)
        return call("function", x)

    pipe = ep.FullPipeline(
        "p",
        ep.CompGraph({"f": function}, {"f": ("x", "y")}),
        queue.SimpleQueue(),
        queue.SimpleQueue(),
        lambda event: {"x": call("f_in", event)},
        lambda view: call("f_out", view["y"]),
    )
    pipe.on_error = lambda failure: here["on_error"]()
    here[where] = pipe.stop
    for event in (1, 2):
        pipe.q_in.put(event)
    pipe.listen()
    pipe.loop._thread.join(TIMEOUT_S)
    assert not pipe.loop.is_running
    assert (pipe.q_in.qsize(), pipe.run_count) == (1, 1)


def test_a_pipeline_that_is_stopped_and_started_inside_an_event_goes_on():
    pipe = full(f_out=lambda view: (pipe.stop(), pipe.listen(), view["y"])[-1])
    with pipe:
        for event in range(3):
            pipe.q_in.put(event)
        assert [pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(3)] == [0, 1, 2]
    assert not pipe.loop.is_running


@pytest.mark.slow
def test_a_loop_that_was_to_drain_and_is_started_again_does_not_end_when_its_queue_is_empty():
    gate, inside = threading.Event(), threading.Event()

    def hold(x):
        inside.set()
        assert gate.wait(TIMEOUT_S)
        return x

    pipe = full(cg=ep.CompGraph({"hold": hold}, {"hold": ("x", "y")}))
    pipe.q_in.put(1)
    pipe.listen()
    assert inside.wait(TIMEOUT_S)
    assert not pipe.loop.drain(0.01), "not within that time"
    pipe.listen()
    gate.set()
    assert pipe.q_out.get(timeout=TIMEOUT_S) == 1
    pipe.loop._thread.join(0.2)
    assert pipe.loop.is_running
    pipe.stop()


def feed(q_in: queue.SimpleQueue, is_over: threading.Event) -> None:
    for event in itertools.count():
        q_in.put(event)
        if is_over.wait(0.001 * (q_in.qsize() > 100)):
            return


def storm(count: int) -> None:
    """Start and stop one pipeline from many threads while events come; then it must work as ever."""
    pipe, errors, is_over = full(), [], threading.Event()

    def start_and_stop(number):
        try:
            for index in range(count):
                pipe.listen(TIMEOUT_S) if (index + number) % 2 else pipe.stop(TIMEOUT_S)
        except BaseException as error:
            errors.append(error)

    feeder = threading.Thread(target=feed, args=(pipe.q_in, is_over))
    feeder.start()
    threads = [threading.Thread(target=start_and_stop, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    is_over.set()
    feeder.join(TIMEOUT_S)
    pipe.stop(TIMEOUT_S)
    assert errors == []
    assert not [thread for thread in threading.enumerate() if thread.name == "epypes p"]
    answers = [pipe.q_out.get_nowait() for _ in range(pipe.q_out.qsize())]
    left = [pipe.q_in.get_nowait() for _ in range(pipe.q_in.qsize())]
    assert [*answers, *left] == list(range(len(answers) + len(left))), "one after another, none lost, none twice"
    assert pipe.loop.handled == pipe.run_count == len(answers)
    with pipe:
        pipe.q_in.put(-1)
        assert pipe.q_out.get(timeout=TIMEOUT_S) == -1


def test_starts_and_stops_from_many_threads_lose_no_event_and_leave_no_thread():
    storm(8)


@pytest.mark.slow
def test_a_storm_of_five_hundred_starts_and_stops_with_events_under_way_leaves_the_pipeline_well():
    storm(125)


def test_a_pipeline_whose_function_never_returns_names_it_and_the_interpreter_still_exits():
    code = """
import queue, threading, epypes as ep
from epypes.errors import StillRunning
inside = threading.Event()
def endless(x):
    inside.set()
    threading.Event().wait()
cg = ep.CompGraph({'endless': endless}, {'endless': ('x', None)})
pipe = ep.SinkPipeline('stuck', cg, queue.Queue(), lambda event: {'x': event})
pipe.q_in.put(1); pipe.listen(); inside.wait(60)
for stop in (pipe.stop, pipe.listen):
    try:
        stop(timeout_s=0.05)
    except StillRunning as error:
        print(error)
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout.count("still in 'endless'")) == (0, 2), done.stderr


@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt, OSError], ids=lambda kind: kind.__name__)
def test_whatever_a_queue_raises_is_logged_and_the_loop_lives_on(kind, caplog):
    class Failing(queue.Queue):
        failures = 2

        def get(self, *args, **kwargs):
            if self.failures:
                self.failures -= 1
                raise kind("queue")
            return super().get(*args, **kwargs)

    pipe = full(Failing())
    with pipe:
        pipe.q_in.put(2)
        assert pipe.q_out.get(timeout=TIMEOUT_S) == 2
    assert caplog.text.count("the queue itself failed") == 2


def test_an_event_that_was_worked_off_is_not_kept_while_the_loop_waits():
    class Event:
        pass

    pipe = ep.FullPipeline(
        "p", GRAPH, queue.SimpleQueue(), queue.SimpleQueue(), lambda event: {"x": 1}, lambda view: view["y"]
    )
    with pipe:
        event = Event()
        known = weakref.ref(event)
        pipe.q_in.put(event)
        del event
        assert pipe.q_out.get(timeout=TIMEOUT_S) == 1
        deadline_s = time.monotonic() + TIMEOUT_S
        while known() is not None and time.monotonic() < deadline_s:
            gc.collect()
        assert known() is None


def test_a_stop_that_runs_out_of_time_says_so_and_may_be_repeated():
    inside, release = threading.Event(), threading.Event()

    def f_in(event):
        inside.set()
        assert release.wait(TIMEOUT_S)
        return {"x": event}

    pipe = ep.FullPipeline("p", GRAPH, queue.SimpleQueue(), queue.SimpleQueue(), f_in, lambda view: view["y"])
    pipe.listen()
    pipe.q_in.put(1)
    assert inside.wait(TIMEOUT_S)
    for _ in range(2):
        with pytest.raises(StillRunning, match="still in 'f_in'"):
            pipe.stop(0.01)
    release.set()
    pipe.stop()
    assert pipe.q_out.get_nowait() == 1


# -- what is queued, and waiting for the end --------------------------------------------------------------------------


def test_stop_leaves_queued_events_unless_it_drains():
    pipe = full()
    for event in range(50):
        pipe.q_in.put(event)
    pipe.listen()
    pipe.stop(TIMEOUT_S, drain=True)
    assert not pipe.loop.is_running
    assert [pipe.q_out.get_nowait() for _ in range(50)] == list(range(50))
    pipe.q_in.put(50)
    pipe.stop(drain=True)
    assert pipe.q_in.qsize() == 1, "a pipeline that does not listen works nothing off"


def test_a_queue_that_is_not_drained_in_time_is_named_and_the_pipeline_stops_all_the_same():
    started, release = threading.Event(), threading.Event()

    def hold(x):
        started.set()
        assert release.wait(TIMEOUT_S)
        return x

    pipe = full(cg=ep.CompGraph({"hold": hold}, {"hold": ("x", "y")}))
    for event in range(3):
        pipe.q_in.put(event)
    pipe.listen()
    assert started.wait(TIMEOUT_S)
    with pytest.raises(StillRunning, match="did not stop within 0.01 s: still in 'hold'"):
        pipe.stop(0.01, drain=True)
    release.set()
    assert pipe.join(TIMEOUT_S)
    assert (pipe.q_in.qsize(), pipe.q_out.qsize()) == (2, 1)


def test_a_drain_from_inside_an_event_ends_the_loop_when_the_queue_is_empty():
    pipe = full(f_out=lambda view: (pipe.stop(drain=True), view["y"])[1])
    for event in range(3):
        pipe.q_in.put(event)
    pipe.listen()
    assert pipe.join(TIMEOUT_S)
    assert pipe.q_out.qsize() == 3


def test_join_waits_until_another_thread_stops_the_pipeline():
    pipe = full()
    assert pipe.join(), "one that does not listen has ended"
    pipe.listen()
    assert not pipe.join(0.01)
    stopper = threading.Thread(target=pipe.stop)
    stopper.start()
    assert pipe.join(TIMEOUT_S)
    stopper.join(TIMEOUT_S)
    assert not pipe.loop.is_running


def test_wait_ends_when_all_pipelines_have_stopped():
    first, second = full(), full()
    first.listen()
    second.listen()
    assert not ep.wait(0.01)
    waiter = threading.Thread(target=ep.wait, daemon=True)
    waiter.start()
    first.stop()
    assert waiter.is_alive()
    second.stop()
    waiter.join(TIMEOUT_S)
    assert not waiter.is_alive()
    assert ep.wait()


def test_wait_inside_an_event_does_not_wait_for_its_own_loop():
    pipe = full(f_out=lambda view: ep.wait(TIMEOUT_S))
    with pipe:
        pipe.q_in.put(1)
        assert pipe.q_out.get(timeout=TIMEOUT_S) is True


def test_a_script_that_waits_answers_events_until_ctrl_c_and_ends_in_order():
    code = (
        "import queue, sys, epypes as ep\n"
        "class Camera(ep.Node):\n"
        "    def stop(self): print('camera closed', flush=True)\n"
        "cg = ep.CompGraph({'show': Camera('camera', lambda x: print('event', x, flush=True))}, {'show': ('x', None)})\n"
        "pipe = ep.SinkPipeline('p', cg, queue.Queue(), lambda e: {'x': e})\n"
        "pipe.listen(); pipe.q_in.put(1)\n"
        "print(ep.wait(), pipe.loop.is_running, flush=True)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        try:
            assert run.stdout.readline() == "event 1\n"
            run.send_signal(signal.SIGINT)
            out, err = run.communicate(timeout=TIMEOUT_S)
        finally:
            run.kill()
    assert (run.returncode, out, err) == (0, "camera closed\nTrue False\n", "")


class Closed(ep.Node):
    """A node that holds something, which it notes in a list when it is stopped."""

    def __init__(self, name, stopped, error=None):
        super().__init__(name, lambda x: x)
        self.stopped, self.error = stopped, error

    def stop(self):
        self.stopped.append(self.name)
        if self.error is not None:
            raise self.error


@pytest.mark.parametrize("kind", ["Pipeline", "FullPipeline"])
def test_a_pipeline_stops_its_nodes_the_last_one_first_even_if_one_fails(kind):
    stopped = []
    cg = ep.CompGraph(
        {"f": Closed("a", stopped), "g": Closed("b", stopped, OSError("b is stuck")), "h": Closed("c", stopped)},
        {"f": ("x", "u"), "g": ("u", "v"), "h": ("v", "y")},
    )
    pipe = ep.Pipeline("p", cg) if kind == "Pipeline" else full(cg=cg)
    with pytest.raises(OSError, match="b is stuck"):
        pipe.stop()
    assert stopped == ["c", "b", "a"]


def test_a_stop_inside_an_event_leaves_the_nodes_to_the_event():
    stopped, answered = [], threading.Event()
    cg = ep.CompGraph({"f": Closed("a", stopped)}, {"f": ("x", "y")})
    pipe = full(cg=cg, f_out=lambda view: (pipe.stop(), answered.set(), len(stopped))[-1])
    pipe.q_in.put(1)
    pipe.listen()
    assert answered.wait(TIMEOUT_S)
    assert pipe.join(TIMEOUT_S)
    assert pipe.q_out.get_nowait() == 0
    pipe.stop()
    assert stopped == ["a"]
