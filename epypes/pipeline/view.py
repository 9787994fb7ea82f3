"""The view of an event and its run that f_out gets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from epypes.pipeline.stamps import Stamps
from epypes.run import Run, RunReport


class EventView(Mapping[str, Any]):
    """One event's run of a pipeline: what f_out is given, never shared with another event.

    Reads like the pipeline: ``view["edges"]``, ``view.attributes``, ``view.traverse_time()``.

    Attributes
    ----------
    event
        What was taken from q_in; None for a SourcePipeline.
    run
        The event's run.
    attributes
        A shallow copy of the pipeline's attributes: the mapping is this event's own, the values are the pipeline's.
    stamps
        When the event was taken, and when f_in and f_out worked on it.
    """

    def __init__(self, name: str, event: Any, run: Run, attributes: Mapping[str, Any], stamps: Stamps) -> None:
        self.name = name
        self.event = event
        self.run = run
        self.attributes = dict(attributes)
        self.stamps = stamps

    @property
    def report(self) -> RunReport:
        """The times of the event's run."""
        return self.run.report

    @property
    def time(self) -> float:
        """How long the event's run took, in seconds."""
        return self.report.total_ns / 1e9

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds, ((function, seconds), ...))`` of the event's own run."""
        nodes = tuple((entry.function, entry.duration_ns / 1e9) for entry in self.report.functions)
        return self.name, self.time, nodes

    def compute_overhead(self) -> float:
        """Return the graph overhead of the event's run, in seconds."""
        return self.report.overhead_ns / 1e9

    def __getitem__(self, token: str) -> Any:
        return self.run[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self.run)

    def __len__(self) -> int:
        return len(self.run)

    def __repr__(self) -> str:
        return f"<EventView of {self.name!r:.40}: {len(self)} tokens>"
