"""Every failing event is counted and reported, whatever its id, its exception and its run do."""

from __future__ import annotations

import queue
import threading
from types import SimpleNamespace

import pytest

import epypes as ep
from epypes.wire import decode, encode, failure_event

TIMEOUT_S = 60.0


class Unhashable(str):
    def __hash__(self):
        raise ZeroDivisionError("hash")


class Unequal(str):
    __slots__ = ()
    __hash__ = str.__hash__

    def __eq__(self, other):
        raise ZeroDivisionError("eq")


class Unsayable(Exception):
    def __str__(self):
        raise KeyboardInterrupt

    def __repr__(self):
        raise SystemExit


class Text(str):
    __slots__ = ()

    def strip(self, characters=None):
        raise SystemExit

    def __format__(self, spec):
        raise SystemExit


class SaysTexts(Exception):
    def __str__(self):
        return Text("said")

    def __repr__(self):
        return Text("shown")


class HasNoNotes(Exception):
    @property
    def __notes__(self):
        raise SystemExit


class Nameless(type):
    @property
    def __name__(cls):
        raise SystemExit


class OfNamelessClass(Exception, metaclass=Nameless):
    pass


class HasNoTraceback(Exception):
    @property
    def __traceback__(self):
        raise SystemExit


class HasNoAttribute(Exception):
    def __getattribute__(self, name):
        raise SystemExit


EXCEPTIONS = [
    Unsayable, SaysTexts, HasNoNotes, OfNamelessClass, HasNoTraceback, HasNoAttribute, StopIteration, GeneratorExit,
]  # fmt: skip


def sink(raised=ValueError) -> ep.SinkPipeline:
    """Return a pipeline whose function raises."""

    def fail(x):
        raise raised

    cg = ep.CompGraph({"fail": fail}, {"fail": ("x", "y")})
    return ep.SinkPipeline("p", cg, queue.SimpleQueue(), lambda event: {"x": event})


@pytest.mark.parametrize("kind", [Unhashable, Unequal])
def test_a_failure_is_told_and_counted_by_its_id_whatever_string_that_is(kind):
    pipe, failures = sink(), []
    pipe.on_error = failures.append
    for _ in range(2):
        pipe.handle(SimpleNamespace(id=kind("a")))
    assert [(failure.event_id, failure.attempt) for failure in failures] == [("a", 1), ("a", 2)]
    assert pipe.failed == 2


@pytest.mark.parametrize("kind", EXCEPTIONS, ids=lambda kind: type.__repr__(kind))
def test_a_failure_is_told_shown_and_sent_whatever_its_exception_does(kind):
    pipe, failures = sink(kind), []
    pipe.on_error = failures.append
    pipe.handle(1)
    assert (pipe.failed, len(failures)) == (1, 1)
    assert str(failures[0])
    assert repr(failures[0]).startswith("Failure(function=")
    told = decode([bytes(frame) for frame in encode(failure_event(failures[0]))])
    assert told.failure.function == failures[0].function


@pytest.mark.parametrize("kind", EXCEPTIONS, ids=lambda kind: type.__repr__(kind))
def test_a_loop_whose_failures_are_logged_lives_on_whatever_the_exception_does(kind, caplog):
    pipe, is_through = sink(kind), threading.Event()
    with pipe:
        pipe.q_in.put(1)
        pipe.f_in = lambda event: is_through.set() or {"x": event}
        pipe.q_in.put(2)
        assert is_through.wait(TIMEOUT_S)
        assert pipe.loop.drain(TIMEOUT_S)
    assert pipe.failed == pipe.loop.handled == 2
    assert caplog.text.count("an event failed") == 2


def test_a_name_is_that_of_the_class_and_a_text_that_is_said():
    pipe, failures = sink(OfNamelessClass("why")), []
    pipe.on_error = failures.append
    pipe.handle(1)
    assert str(failures[0]) == "fail: OfNamelessClass: why"
    assert failures[0].kind == "OfNamelessClass"


def test_a_run_that_cannot_be_read_does_not_keep_a_failure_of_f_out_from_being_told():
    class Unreadable(dict):
        def keys(self):
            raise SystemExit

    class Own(ep.FullPipeline):
        def compute(self, tokens):
            return Unreadable()

    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe, failures = Own("p", cg, queue.Queue(), queue.Queue(), lambda event: {"x": event}, lambda view: view["y"]), []
    pipe.on_error = failures.append
    pipe.handle(1)
    assert [(failure.function, failure.source) for failure in failures] == [("f_out", "p")]
