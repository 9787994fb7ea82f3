"""A run becomes an answer on q_out."""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from epypes.pipeline.stages import Stage, function_stage, queue_stage
from epypes.pipeline.stamps import Stamps
from epypes.pipeline.view import EventView
from epypes.run import Run
from epypes.run.underway import locals_under_way

FOut = Callable[[EventView], Any]


class OfThread(threading.local):
    """The stamps of the event that a thread works on, its loop's f_in, and the event that was settled last."""

    def __init__(self) -> None:
        self.stamps = Stamps()
        self.f_in: Any = None
        self.settled: Any = None


class Answering:
    """What SourcePipeline and FullPipeline have in common: they put ``f_out(view)`` on ``q_out``."""

    name: str
    attributes: dict[str, Any]
    q_out: Any
    f_out: FOut
    _own: OfThread

    def emit(self, event: Any, run: Run) -> None:
        """Put what f_out makes of the event's run on q_out. The hook for subclasses."""
        stamps = self._own.stamps
        view = EventView(self.name, event, run, self.attributes, stamps)
        stamps.f_out_start = perf_counter_ns()
        answer = self.f_out(view)
        stamps.f_out_end = perf_counter_ns()
        self.put(answer, view)

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer on q_out, when f_out has made it of the view; the hook for subclasses."""
        self.q_out.put(answer)

    def _is_putting(self) -> bool:
        """Whether an answer that f_out has made is on its way into q_out."""
        return any("answer" in found for found in self._emitting())

    def _emitting(self) -> list[dict[str, Any]]:
        return [found for found in locals_under_way({Answering.emit.__code__}) if found["self"] is self]

    def _stages_after(self, failure: str) -> tuple[Stage, Stage]:
        """Return f_out and q_out as they are at this moment; ``failure`` is what f_out raised for the last event."""
        calls = self._emitting()
        is_in_f_out = any("view" in found and "answer" not in found for found in calls)
        return (
            function_stage("f_out", self.f_out, is_under_way=is_in_f_out, failure=failure),
            queue_stage("q_out", self.q_out, is_waited_for=any("answer" in found for found in calls)),
        )
