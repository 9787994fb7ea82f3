"""Rows in a database: one for each event that a service has resolved."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from time import perf_counter_ns, time_ns
from typing import TYPE_CHECKING, Any, Final

from epypes.service.result_publisher import Provenance, Result
from epypes.store.later import SeriesWriter

if TYPE_CHECKING:
    from epypes.service.dispatcher import AcceptedEvent
    from epypes.service.failures.record import FailedEvent
    from epypes.service.options import Options

_log = logging.getLogger("epypes.service")

KIND: Final = "events"


class EventLog:
    """A row of each event, in the series ``events`` of the bundle's name; nobody waits for the database.

    Parameters
    ----------
    options
        Of the service: the store, which is a path or a URL or None, and the name of the replica.
    name
        Of the bundle.
    provenance
        Returns what events are worked on with.

    Raises
    ------
    StoreError
        There can be no such database. One that is away is reported in the log.
    """

    def __init__(self, options: Options, name: str, provenance: Callable[[], Provenance]) -> None:
        self._options, self._provenance, self._began_ns = options, provenance, time_ns()
        self._writer = None if options.store is None else SeriesWriter(options.store, KIND, name)

    def keep(self, entry: AcceptedEvent, result: Result, failure: FailedEvent | None) -> None:
        """Have a row of an event written; returns at once and raises nothing."""
        if self._writer is not None:
            row = _row(entry, result, failure, self._provenance().digest)
            if self._options.has_broker:
                row |= {"deliveries": entry.delivery.attempt, "replica": self._options.replica}
            self._writer.append(f"{self._began_ns}-{entry.seq}", row)

    def counts(self) -> Mapping[str, int]:
        """Return how many rows were written, skipped and so on, as `SeriesWriter.counts`; none without a store."""
        return {} if self._writer is None else self._writer.counts()

    def close(self, timeout_s: float) -> None:
        """Write all rows that wait; those that are not written in time are reported in the log. More may follow."""
        if self._writer is not None and not self._writer.close(timeout_s):
            _log.warning("%d rows of events could not be stored in time", self._writer.counts()["waiting"])


def _row(entry: AcceptedEvent, result: Result, failure: FailedEvent | None, digest: str) -> dict[str, Any]:
    now_ns = time_ns()
    row = {
        "seq": entry.seq,
        "event_id": entry.id,
        "outcome": "answered",
        "received_ns": now_ns - (perf_counter_ns() - entry.accepted_ns),
        "answered_ns": now_ns,
        "total_ns": result.total_ns,
        "times_ns": dict(result.durations_ns),
        "attempts": entry.attempts,
        "revision": result.revision,
        "digest": digest,
    }
    return row if failure is None else {**row, **_of_failure(failure, result)}


def _of_failure(failure: FailedEvent, result: Result) -> dict[str, Any]:
    """Return what a row has besides if the event failed; ``failure`` is the id to open it by."""
    dropped = failure.kind == "dropped"
    return {
        "outcome": "dropped" if dropped else result.outcome.removesuffix("s"),
        "failure": failure.id,
        "function": failure.function,
        "exception": failure.exception,
        "message": failure.message,
        "digest": failure.digest,
    }
