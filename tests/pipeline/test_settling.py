"""Events that a broker keeps are acknowledged or rejected."""

from __future__ import annotations

import queue
import threading

import pytest

import epypes as ep
from epypes.errors import BrokerError

WAIT_S = 60.0


class Kept:
    """An event that takes down what it is told."""

    def __init__(self, value=1):
        self.value, self.told, self.is_told = value, [], threading.Event()

    def ack(self):
        self._tell("ack")

    def reject(self, reason):
        self._tell(reason)

    def nack(self):
        self._tell("given back")

    def _tell(self, word):
        self.told.append(word)
        self.is_told.set()


class Refuses(Kept):
    def ack(self):
        super().ack()
        raise SystemExit


def double(x):
    if x == 0:
        raise ValueError("zero\nis not allowed")
    if x < 0:
        raise BrokerError("b", "the broker is away")
    return 2 * x


GRAPH = ep.CompGraph.from_functions(double)


def pipeline(q_in, q_out, **changes):
    given = {"f_in": lambda event: {"x": event.value}, "f_out": lambda view: view["double"]} | changes
    return ep.FullPipeline("doubling", GRAPH, q_in, q_out, given["f_in"], given["f_out"])


def handled(pipe, *events):
    """Return what the events were told by the time that one after them has been answered."""
    last = Kept(100)
    with pipe:
        for event in (*events, last):
            pipe.q_in.put(event)
        assert last.is_told.wait(WAIT_S)
    return [event.told for event in events]


def test_an_event_is_acknowledged_when_its_answer_has_been_put():
    answers = []

    class Out:
        def put(self, answer):
            answers.append((answer, list(event.told)))

    event = Kept(4)
    told = handled(pipeline(queue.Queue(), Out()), event)
    assert told == [["ack"]]
    assert answers[0] == (8, [])


def test_an_event_that_fails_is_rejected_with_the_function_and_what_it_raised():
    assert handled(pipeline(queue.Queue(), queue.Queue()), Kept(0)) == [["double: ValueError: zero\nis not allowed"]]


def test_an_event_that_fails_is_reported_before_it_is_rejected():
    event, reported = Kept(0), []
    pipe = pipeline(queue.Queue(), queue.Queue())
    pipe.on_error = lambda failure: reported.append((failure.function, list(event.told)))
    handled(pipe, event)
    assert reported == [("double", [])]
    assert event.told[0].startswith("double: ValueError")


@pytest.mark.parametrize(("where", "function"), [("f_in", lambda event: {"x": event.value.nothing}), ("f_out", None)])
def test_what_fails_before_or_after_the_graph_is_rejected_as_well(where, function):
    def f_out(view):
        raise KeyError("lost") if view.event.value == 4 else ZeroDivisionError

    chosen = function or f_out
    event, later = Kept(4), Kept(5)
    pipe = pipeline(queue.Queue(), queue.Queue(), **{where: chosen})
    with pipe:
        pipe.q_in.put(event)
        pipe.q_in.put(later)
        assert later.is_told.wait(WAIT_S)
    assert event.told[0].startswith(f"{where}: ")


def test_an_event_whose_answer_may_have_been_lost_is_left_to_be_delivered_again():
    assert handled(pipeline(queue.Queue(), queue.Queue()), Kept(-1)) == [["given back"]]


def test_an_event_loop_tells_what_became_of_an_event():
    events, last = [Kept(4), Kept(0), Kept(-1)], Kept(1)
    q_in = queue.Queue()
    loop = ep.EventLoop(q_in, double, lambda event: {"x": event.value}, on_error=lambda event, error: None)
    loop.start()
    for event in (*events, last):
        q_in.put(event)
    assert last.is_told.wait(WAIT_S)
    loop.stop()
    assert [event.told for event in events] == [["ack"], ["ValueError: zero\nis not allowed"], ["given back"]]


def test_a_handle_of_ones_own_that_returns_has_answered_and_one_that_raises_has_not():
    class Own(ep.SinkPipeline):
        def handle(self, event):
            double(event.value)

    pipe = Own("own", GRAPH, queue.Queue(), lambda event: {})
    pipe.loop.on_error = lambda event, error: None
    assert handled(pipe, Kept(4), Kept(0)) == [["ack"], ["ValueError: zero\nis not allowed"]]


def test_an_event_that_can_not_be_told_does_not_end_the_loop(caplog):
    refusing = Refuses(4)
    q_out = queue.Queue()
    handled(pipeline(queue.Queue(), q_out), refusing)
    assert [q_out.get(timeout=WAIT_S) for _ in range(2)] == [8, 200]
    assert "could not be settled" in caplog.text


def test_what_only_an_instance_has_is_no_word_for_a_broker():
    class Plain:
        value = 4

    event, last = Plain(), Kept(1)
    event.ack = lambda: pytest.fail("nobody keeps it")
    q_in = queue.Queue()
    with pipeline(q_in, queue.Queue()):
        q_in.put(event)
        q_in.put(last)
        assert last.is_told.wait(WAIT_S)


@pytest.mark.parametrize(("policy", "reason"), [("latest", "superseded"), ("drop_oldest", "oldest")])
def test_an_event_that_a_mailbox_drops_is_rejected(policy, reason):
    mailbox, dropped = ep.Mailbox(policy, 1, on_drop=lambda item: dropped_items.append(item)), Kept()
    dropped_items = []
    mailbox.put(dropped)
    mailbox.put(Kept())
    assert (dropped.told, dropped_items) == ([reason], [dropped])
