"""The stages of an event before and after the graph of a pipeline, and their progress."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from epypes.pipeline.loop import EventLoop
from epypes.pipeline.mailbox import Mailbox
from epypes.wording import counted

StageKind = Literal["queue", "loop", "function"]
StageState = Literal["static", "running", "stopped", "failed"]


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a reactive pipeline, outside its graph, at one moment.

    Attributes
    ----------
    kind
        What it is: a queue, an event loop, or a function such as f_in.
    name
        Such as ``"q_in"``.
    state
        ``"running"``: of a loop that it listens, of a function that an event is in it, of a queue that somebody waits
        to put something on it; ``"failed"``: of a function that the last event failed in it.
    notes
        Short lines: what it is, its counts.
    """

    kind: StageKind
    name: str
    state: StageState = "static"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Stages:
    """The stages that an event passes before and after the graph, in that order."""

    before: tuple[Stage, ...] = ()
    after: tuple[Stage, ...] = ()


def queue_stage(name: str, queue: Any, *, is_waited_for: bool = False) -> Stage:
    """Look at a queue, which may be any object.

    Parameters
    ----------
    is_waited_for
        Whether somebody waits to put something on it.
    """
    size, limit = _qsize(queue), _limit(queue)
    notes = [f"{type(queue).__name__} {queue.policy}" if isinstance(queue, Mailbox) else type(queue).__name__]
    if size is not None:
        notes.append(f"{size} of {limit} waiting" if limit else f"{size} waiting")
    if isinstance(queue, Mailbox):
        notes += _dropped(queue.dropped)
    return Stage("queue", name, "running" if is_waited_for else "static", tuple(notes))


def loop_stage(loop: EventLoop, failed: int) -> Stage:
    """Look at an event loop, ``failed`` of whose events failed."""
    events = counted(loop.handled, "event")
    return Stage("loop", "EventLoop", "running" if loop.is_running else "stopped", (f"{events}, {failed} failed",))


def function_stage(name: str, function: Any, *, is_under_way: bool = False, failure: str = "") -> Stage:
    """Look at f_in or f_out; ``failure`` is what it raised for the last event, if it did."""
    state: StageState = "running" if is_under_way else "failed" if failure else "static"
    its_own = _function_name(function)
    return Stage("function", name, state, tuple(note for note in (its_own, failure) if note and note != name))


def _function_name(function: Any) -> str:
    with contextlib.suppress(Exception):  # any object can be called, whatever its attributes do
        name = function.__name__
        if isinstance(name, str):
            return name
    return type(function).__name__


def _qsize(queue: Any) -> int | None:
    """Return what a queue says of itself, if it can and that is a number."""
    with contextlib.suppress(Exception):  # a multiprocessing queue has a qsize that raises on some systems
        count = queue.qsize()
        return count if type(count) is int else None
    return None


def _limit(queue: Any) -> int:
    """Return how many items a queue holds; 0 if there is no limit, or none is known."""
    with contextlib.suppress(Exception):
        limit = queue.size if isinstance(queue, Mailbox) else queue.maxsize
        return limit if type(limit) is int and limit > 0 else 0
    return 0


def _dropped(dropped: Mapping[str, int]) -> list[str]:
    # A copy, since a producer may drop for another reason meanwhile.
    return [f"{count} dropped: {reason}" for reason, count in dict(dropped).items()]
