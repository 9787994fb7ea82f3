from __future__ import annotations

import itertools
import queue
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

import epypes as ep
from epypes.errors import MailboxOverflow, PayloadError, StillRunning

TIMEOUT_S = 60.0


def square_graph() -> ep.CompGraph:
    def square(x):
        if x == "bad":
            raise RuntimeError("bad input")
        return x * x

    return ep.CompGraph(
        {"square": square, "shift": lambda s, n: s + n}, {"square": ("x", "s"), "shift": (("s", "n"), "y")}
    )


def full_pipeline(q_in=None, q_out=None, **kwargs):
    q_in, q_out = q_in or queue.Queue(), q_out or queue.Queue()
    pipe = ep.FullPipeline(
        "squares", square_graph(), q_in, q_out, lambda event: {"x": event}, lambda view: view["y"], {"n": 1}
    )
    for name, value in kwargs.items():
        setattr(pipe, name, value)
    return pipe, q_in, q_out


def test_a_node_measures_its_time_and_counts_its_calls():
    node = ep.Node("sum", lambda a, b: a + b)
    assert node(1, 2) == 3
    assert node.run_count == 1
    assert node.time > 0
    assert node.traverse_time() == ("sum", node.time)


def test_a_node_that_fails_is_counted_and_raises_what_its_function_raised():
    node = ep.Node("fail", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        node()
    assert node.run_count == 1


def test_a_graph_of_nodes_is_checked_like_one_of_functions(edge_graph):
    network = ep.NodeBasedCompGraph(edge_graph)
    assert list(network.nodes) == ["grayscale", "blur", "canny"]
    with pytest.raises(ep.errors.GraphError, match="takes 1 input"):
        ep.CompGraph({"f": ep.Node("f", lambda x: x)}, {"f": (("a", "b"), "c")})


def test_a_pipeline_takes_its_free_source_tokens_in_order_and_returns_its_sink(edge_graph, photograph, straight_edges):
    pipe = ep.Pipeline("edges", edge_graph, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    assert np.array_equal(pipe(photograph), straight_edges)
    assert np.shares_memory(pipe["edges"], pipe.runner["edges"])
    pipe["canny_lo"] = 90
    assert pipe.run(image=photograph).hyperparameters["canny_lo"] == 90
    name, total, nodes = pipe.traverse_time()
    assert (name, [node[0] for node in nodes]) == ("edges", ["grayscale", "blur", "canny"])
    assert 0 < pipe.compute_overhead() < total
    assert pipe.run_count == 2


def test_a_pipeline_called_with_another_number_of_inputs_says_which_it_takes():
    pipe = ep.Pipeline("squares", square_graph(), {"n": 1})
    with pytest.raises(PayloadError, match=r"takes 1 input \(x\), not 2"):
        pipe(1, 2)


def test_a_pipeline_is_a_function_of_another_graph_and_times_nest():
    inner = ep.Pipeline("inner", square_graph(), {"n": 1})
    cg = ep.CompGraph({"inner": inner, "negate": lambda y: -y}, {"inner": ("a", "b"), "negate": ("b", "c")})
    outer = ep.Pipeline("outer", cg)
    assert outer(3) == -10
    _, _, (inner_times, negate_times) = outer.traverse_time()
    assert inner_times[0] == "inner"
    assert [node[0] for node in inner_times[2]] == ["square", "shift"]
    assert negate_times[0] == "negate"


def test_a_source_pipeline_puts_what_it_computes():
    q_out = queue.Queue()
    pipe = ep.SourcePipeline("source", square_graph(), q_out, lambda view: (view["y"], view.attributes), {"n": 1})
    pipe.attributes["station"] = 4
    pipe.run(x=3)
    assert q_out.get_nowait() == (10, {"station": 4})


def test_a_sink_pipeline_runs_for_every_event():
    done = threading.Event()
    seen = []

    def keep(x):
        seen.append(x)
        if len(seen) == 3:
            done.set()

    q_in = queue.SimpleQueue()
    cg = ep.CompGraph({"keep": keep}, {"keep": ("x", None)})
    with ep.SinkPipeline("sink", cg, q_in, lambda event: {"x": event}):
        for x in range(3):
            q_in.put(x)
        assert done.wait(TIMEOUT_S)
    assert seen == [0, 1, 2]


def test_a_full_pipeline_answers_every_event_in_order():
    pipe, q_in, q_out = full_pipeline()
    with pipe:
        for x in range(20):
            q_in.put(x)
        assert [q_out.get(timeout=TIMEOUT_S) for _ in range(20)] == [x * x + 1 for x in range(20)]


@pytest.mark.parametrize("event", [np.zeros((4, 4)), b"bytes", None, np.array(3), "text", object()], ids=type)
def test_any_object_can_be_an_event(event):
    q_in, q_out = queue.Queue(), queue.Queue()
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe = ep.FullPipeline("any", cg, q_in, q_out, lambda event: {"x": 1}, lambda view: view.event)
    with pipe:
        q_in.put(event)
        assert q_out.get(timeout=TIMEOUT_S) is event


def test_failures_are_reported_and_the_loop_goes_on():
    failures = queue.Queue()
    pipe, q_in, q_out = full_pipeline(on_error=failures.put)
    with pipe:
        q_in.put("bad")
        q_in.put(2)
        assert q_out.get(timeout=TIMEOUT_S) == 5
    failure = failures.get_nowait()
    assert failure.function == "square"
    assert failure.inputs == {"x": "bad"}
    assert isinstance(failure.exception, RuntimeError)
    assert pipe.failed == 1


@pytest.mark.parametrize("bad", ["f_in raises", "f_in returns a list", "f_in misses a token", "f_out raises"])
def test_failures_of_f_in_and_f_out_are_reported_too(bad):
    failures, q_in, q_out = queue.Queue(), queue.Queue(), queue.Queue()

    def f_in(event):
        if event == "f_in raises":
            raise KeyError("no")
        return {"f_in returns a list": ["x"], "f_in misses a token": {}}.get(event, {"x": 2})

    def f_out(view):
        if view.event == "f_out raises":
            raise KeyError("no")
        return view["y"]

    pipe = ep.FullPipeline("bad", square_graph(), q_in, q_out, f_in, f_out, {"n": 1})
    pipe.on_error = failures.put
    with pipe:
        q_in.put(bad)
        q_in.put("good")
        assert q_out.get(timeout=TIMEOUT_S) == 5
    assert failures.get_nowait().function == bad.split()[0]


def test_a_handler_that_raises_does_not_end_the_loop(caplog):
    def handler(failure):
        raise RuntimeError("handler")

    pipe, q_in, q_out = full_pipeline(on_error=handler)
    with pipe:
        q_in.put("bad")
        q_in.put(3)
        assert q_out.get(timeout=TIMEOUT_S) == 10
    assert "on_error itself failed" in caplog.text


def test_without_a_handler_failures_are_logged_and_nothing_is_printed(caplog, capsys):
    pipe, q_in, q_out = full_pipeline()
    with pipe:
        q_in.put("bad")
        q_in.put(3)
        q_out.get(timeout=TIMEOUT_S)
    assert "bad input" in caplog.text
    assert capsys.readouterr().out == ""


def test_each_event_has_attributes_of_its_own():
    q_in, q_out = queue.Queue(), queue.Queue()

    def f_out(view):
        view.attributes["mine"] = view.event
        return view.attributes

    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe = ep.FullPipeline("own", cg, q_in, q_out, lambda event: {"x": event}, f_out)
    with pipe:
        q_in.put(1)
        q_in.put(2)
        assert [q_out.get(timeout=TIMEOUT_S) for _ in range(2)] == [{"mine": 1}, {"mine": 2}]
    assert pipe.attributes == {}


def test_stop_works_before_listen_and_twice_and_the_pipeline_can_listen_again():
    pipe, q_in, q_out = full_pipeline()
    pipe.stop()
    pipe.listen()
    pipe.stop()
    pipe.stop()
    pipe.listen()
    q_in.put(4)
    assert q_out.get(timeout=TIMEOUT_S) == 17
    pipe.stop()


def test_stop_does_not_work_off_the_backlog():
    started, release = threading.Event(), threading.Event()

    def hold(x):
        started.set()
        release.wait(TIMEOUT_S)

    q_in = queue.Queue()
    pipe = ep.SinkPipeline(
        "hold", ep.CompGraph({"hold": hold}, {"hold": ("x", None)}), q_in, lambda event: {"x": event}
    )
    for x in range(20):
        q_in.put(x)
    pipe.listen()
    assert started.wait(TIMEOUT_S)
    pipe.loop._stop.set()
    release.set()
    pipe.stop()
    assert q_in.qsize() == 19


def test_stop_within_a_handler_returns_and_ends_the_loop():
    q_in = queue.Queue()
    stopped = threading.Event()
    pipe = ep.SinkPipeline("self", square_graph(), q_in, lambda event: {"x": event}, {"n": 1})

    def on_error(failure):
        pipe.stop()
        stopped.set()

    pipe.on_error = on_error
    pipe.listen()
    q_in.put("bad")
    assert stopped.wait(TIMEOUT_S)
    pipe.stop()
    assert not pipe.loop.is_running


def test_a_function_that_does_not_return_is_named():
    started, release = threading.Event(), threading.Event()

    def endless(x):
        started.set()
        release.wait(TIMEOUT_S)

    q_in = queue.Queue()
    pipe = ep.SinkPipeline(
        "stuck", ep.CompGraph({"endless": endless}, {"endless": ("x", None)}), q_in, lambda e: {"x": e}
    )
    pipe.listen()
    q_in.put(1)
    assert started.wait(TIMEOUT_S)
    with pytest.raises(StillRunning, match="still in 'endless'") as error:
        pipe.stop(timeout_s=0.05)
    assert error.value.functions == ("endless",)
    release.set()
    pipe.stop()


def test_a_pipeline_left_running_says_so_and_the_interpreter_exits():
    code = (
        "import queue, epypes as ep\n"
        "cg = ep.CompGraph({'f': lambda x: x}, {'f': ('x', 'y')})\n"
        "ep.SinkPipeline('left', cg, queue.Queue(), lambda e: {'x': e}).listen()\n"
        "stopped = ep.SinkPipeline('stopped', cg, queue.Queue(), lambda e: {'x': e})\n"
        "stopped.listen(); stopped.stop()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert "'left' was left running when the program ended, and has ended with it." in done.stderr
    assert "To keep the program running, let it end with ep.wait()." in done.stderr
    assert "stopped" not in done.stderr


def test_an_event_loop_serves_any_callback():
    q_in, seen = queue.Queue(), queue.Queue()
    loop = ep.EventLoop(q_in, lambda value: seen.put(value), lambda event: {"value": event + 1})
    loop.start()
    q_in.put(1)
    assert seen.get(timeout=TIMEOUT_S) == 2
    loop.stop()


def test_the_latest_mailbox_keeps_the_newest_and_counts_the_rest():
    mailbox = ep.Mailbox("latest")
    for item in range(5):
        mailbox.put(item)
    assert mailbox.get_nowait() == 4
    assert mailbox.dropped == {"superseded": 4}


def test_drop_oldest_keeps_the_last_ones_in_order():
    mailbox = ep.Mailbox("drop_oldest", 3)
    for item in range(5):
        mailbox.put_nowait(item)
    assert [mailbox.get_nowait() for _ in range(3)] == [2, 3, 4]
    assert mailbox.dropped == {"oldest": 2}


def test_block_waits_for_room_and_fault_raises():
    blocking = ep.Mailbox("block", 1)
    blocking.put(1)
    with pytest.raises(queue.Full):
        blocking.put(2, timeout=0.01)
    with pytest.raises(queue.Full):
        blocking.put_nowait(2)
    taker = threading.Thread(target=blocking.get)
    taker.start()
    blocking.put(2, timeout=TIMEOUT_S)
    taker.join()
    assert blocking.get_nowait() == 2
    fault = ep.Mailbox("fault", 1)
    fault.put(1)
    with pytest.raises(MailboxOverflow, match="full"):
        fault.put(2)


def test_an_empty_mailbox_raises_empty_in_time_and_wakes_a_waiting_taker():
    mailbox, got = ep.Mailbox("latest"), queue.Queue()
    with pytest.raises(queue.Empty):
        mailbox.get(timeout=0.01)
    taker = threading.Thread(target=lambda: got.put(mailbox.get(timeout=TIMEOUT_S)))
    taker.start()
    mailbox.put("here")
    assert got.get(timeout=TIMEOUT_S) == "here"
    taker.join()


@pytest.mark.parametrize(("policy", "size"), [("newest", 1), ("latest", 2), ("block", 0)])
def test_a_mailbox_that_makes_no_sense_is_refused(policy, size):
    with pytest.raises(ValueError, match="policy"):
        ep.Mailbox(policy, size)


@pytest.mark.parametrize("on_error", [None, "report", "raise"])
def test_an_event_loop_lives_on_whatever_its_callback_or_f_in_raise(on_error, caplog):
    q_in, seen, errors = queue.Queue(), queue.Queue(), []

    def f_in(event):
        return {"value": 10 / event}

    def callback(value):
        seen.put(5 / (value - 1))

    def report(event, exception):
        errors.append((event, type(exception)))
        if on_error == "raise":
            raise RuntimeError("on_error")

    loop = ep.EventLoop(q_in, callback, f_in, on_error=report if on_error else None)
    loop.start()
    for event in (0, 10, 5):
        q_in.put(event)
    assert seen.get(timeout=TIMEOUT_S) == 5
    loop.stop()
    assert errors == ([(0, ZeroDivisionError), (10, ZeroDivisionError)] if on_error else [])
    assert ("an event failed" in caplog.text) == (on_error is None)
    assert ("on_error itself failed" in caplog.text) == (on_error == "raise")


@pytest.mark.parametrize("where", ["f_in", "function", "f_out", "on_error"])
def test_an_exit_in_an_event_does_not_end_the_loop(where):
    failures, q_in, q_out = queue.Queue(), queue.Queue(), queue.Queue()

    def leave(here, value):
        if where == here and value == "leave":
            raise SystemExit(3)
        return value

    def on_error(failure):
        failures.put(failure)
        leave("on_error", "leave")

    cg = ep.CompGraph({"f": lambda x: leave("function", x)}, {"f": ("x", "y")})
    pipe = ep.FullPipeline(
        "exit", cg, q_in, q_out, lambda event: {"x": leave("f_in", event)}, lambda view: leave("f_out", view["y"])
    )
    pipe.on_error = on_error
    with pipe:
        q_in.put("leave")
        q_in.put("stay")
        assert "stay" in {q_out.get(timeout=TIMEOUT_S) for _ in range(2 if where == "on_error" else 1)}
    if where != "on_error":
        assert isinstance(failures.get_nowait().exception, SystemExit)


def test_a_queue_that_fails_does_not_end_the_loop(caplog):
    class Failing(queue.Queue):
        failed = False

        def get(self, *args, **kwargs):
            if not self.failed:
                self.failed = True
                raise OSError("queue")
            return super().get(*args, **kwargs)

    pipe, q_in, q_out = full_pipeline(q_in=Failing())
    with pipe:
        q_in.put(2)
        assert q_out.get(timeout=TIMEOUT_S) == 5
    assert "the queue itself failed" in caplog.text


def test_draining_works_off_what_is_in_the_queue():
    pipe, q_in, q_out = full_pipeline()
    for x in range(50):
        q_in.put(x)
    pipe.listen()
    assert pipe.loop.drain(TIMEOUT_S)
    assert q_out.qsize() == 50
    assert not pipe.loop.is_running
    pipe.listen()
    q_in.put(100)
    assert 10001 in {q_out.get(timeout=TIMEOUT_S) for _ in range(51)}
    pipe.stop()


@pytest.mark.slow
def test_a_loop_that_has_not_ended_is_not_started_beside_itself():
    started, release = threading.Event(), threading.Event()

    def hold(x):
        started.set()
        release.wait(TIMEOUT_S)

    q_in = queue.Queue()
    cg = ep.CompGraph({"hold": hold}, {"hold": ("x", None)})
    pipe = ep.SinkPipeline("hold", cg, q_in, lambda event: {"x": event})
    pipe.listen()
    q_in.put(1)
    assert started.wait(TIMEOUT_S)
    with pytest.raises(StillRunning):
        pipe.stop(timeout_s=0.01)
    with pytest.raises(StillRunning, match="still in 'hold'"):
        pipe.listen()
    release.set()
    pipe.stop()


def test_a_full_output_queue_is_named_when_it_holds_up_the_stop():
    q_in, q_out = queue.Queue(), queue.Queue(1)
    q_out.put("full")
    reached = threading.Event()
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe = ep.FullPipeline("full", cg, q_in, q_out, lambda event: {"x": event}, lambda view: reached.set())
    pipe.listen()
    q_in.put(1)
    assert reached.wait(TIMEOUT_S)
    with pytest.raises(StillRunning, match="still in 'put on q_out'"):
        pipe.stop(timeout_s=0.05)
    q_out.get()
    pipe.stop()


def test_a_mailbox_tells_what_it_dropped():
    dropped = []
    mailbox = ep.Mailbox("drop_oldest", 2, on_drop=dropped.append)
    for item in range(5):
        mailbox.put(item)
    assert dropped == [0, 1, 2]


@pytest.mark.parametrize("policy", ["latest", "drop_oldest"])
def test_an_on_drop_that_raises_is_logged_and_the_item_has_been_put(policy, caplog):
    def refuse(item):
        raise SystemExit(item)

    mailbox = ep.Mailbox(policy, on_drop=refuse)
    for item in range(3):
        mailbox.put(item)
    assert mailbox.get_nowait() == 2
    assert mailbox.dropped.total() == 2
    assert caplog.text.count("on_drop failed") == 2
    assert "SystemExit: 1" in caplog.text


def test_an_answer_whose_put_drops_an_older_one_is_no_failure_if_on_drop_raises():
    q_out = ep.Mailbox("latest", on_drop=lambda item: 1 / 0)
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe = ep.FullPipeline("p", cg, queue.Queue(), q_out, lambda event: {"x": event}, lambda view: view["y"])
    for event in range(3):
        pipe.handle(event)
    assert (pipe.failed, q_out.get_nowait()) == (0, 2)


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "size"), [("latest", 1), ("drop_oldest", 3)])
def test_a_signal_handler_that_puts_never_makes_a_mailbox_hold_more_than_its_size(policy, size):
    mailbox, by_handler, put, most = ep.Mailbox(policy, size), itertools.count(), 0, 0
    before = signal.signal(signal.SIGALRM, lambda *_: mailbox.put(next(by_handler)))
    try:
        for _ in range(2_000):
            # One signal at a time, or a slow machine would do nothing but handle them.
            signal.setitimer(signal.ITIMER_REAL, 2e-5)
            for _ in range(30):
                mailbox.put(put)
                put += 1
                most = max(most, mailbox.qsize())
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert most == mailbox.qsize() == size
    assert mailbox.dropped.total() + size == put + next(by_handler)


def test_a_token_may_be_called_self():
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("self", "y")})
    assert ep.Pipeline("p", cg).run(self=3)["y"] == 3


def test_f_out_gets_nothing_where_nothing_was_found():
    cg = ep.CompGraph(
        {"find": lambda x: x if x > 2 else ep.Nothing, "double": lambda y: 2 * y, "count": lambda x: x + 1},
        {"find": ("x", "y"), "double": ("y", "z"), "count": ("x", "n")},
    )
    q_in, q_out = queue.Queue(), queue.Queue()
    seen = []

    def f_out(view):
        seen.append((view["y"], "z" in view, view.report.skipped))
        return "lost" if view["z"] is ep.Nothing else view["z"]

    with ep.FullPipeline("search", cg, q_in, q_out, lambda event: {"x": event}, f_out) as pipe:
        for event in (3, 1, ep.Nothing, 4):
            q_in.put(event)
        assert [q_out.get(timeout=TIMEOUT_S) for _ in range(4)] == [6, "lost", "lost", 8]
    assert seen[1] == (ep.Nothing, True, ("double",))
    assert seen[2] == (ep.Nothing, True, ("find", "double", "count"))
    assert [pipe.network.nodes[name].run_count for name in ("find", "double", "count")] == [3, 2, 3]


def test_nodes_that_were_skipped_count_in_no_time():
    cg = ep.CompGraph(
        {"find": lambda x: x if x > 2 else ep.Nothing, "double": lambda y: 2 * y},
        {"find": ("x", "y"), "double": ("y", "z")},
    )
    pipe = ep.Pipeline("search", cg)
    assert pipe(3) == 6
    assert pipe(1) is ep.Nothing
    name, total, (found, doubled) = pipe.traverse_time()
    assert (name, found[0], doubled) == ("search", "find", ("double", 0.0))
    assert pipe.compute_overhead() == pytest.approx(total - found[1])
