"""OpenTelemetry traces: a span of each event that a service has resolved, with a child span of each function.

The spans are made of the times that a result has anyway, when its answer was published. A report has durations, so the
functions of a run lie one after the other from its start. Where no tracer provider is set, no module of OpenTelemetry
is imported, and no function here is called for an event.

A trace is continued if the attributes of the event's Envelope carry it in the fields of the W3C's trace context:
``attributes={"traceparent": ...}``, as ``opentelemetry.propagate.inject`` makes them.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from time import perf_counter_ns, time_ns
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import MessageError

if TYPE_CHECKING:
    from opentelemetry.trace import Span, Tracer, TracerProvider

    from epypes.service.dispatcher import AcceptedEvent
    from epypes.service.failures.record import FailedEvent
    from epypes.service.result_publisher import Provenance, Result

_TRACE: Final = "opentelemetry.trace"
_log: Final = logging.getLogger("epypes.service")


class EventTracer:
    """Makes the spans of resolved events.

    Parameters
    ----------
    tracer
        Of OpenTelemetry.
    """

    def __init__(self, tracer: Tracer) -> None:
        self._tracer = tracer

    @classmethod
    def configured(cls, provider: TracerProvider | None) -> Self | None:
        """Return the tracer of a provider, without one of that which is set for this process; None if none is set."""
        # A program that has set a provider has imported this module.
        api = sys.modules.get(_TRACE)
        if provider is None and api is not None:
            provider = api.get_tracer_provider()
        if provider is None or isinstance(provider, (api.ProxyTracerProvider, api.NoOpTracerProvider)):  # type: ignore[union-attr]
            return None
        return cls(provider.get_tracer("epypes"))

    def trace(self, event: AcceptedEvent, result: Result, provenance: Provenance) -> None:
        """Make the spans of an event; what a tracer raises is logged."""
        try:
            self._trace(event, result, provenance)
        except Exception:
            _log.exception("an event could not be traced")

    def _trace(self, event: AcceptedEvent, result: Result, provenance: Provenance) -> None:
        from opentelemetry.propagate import extract
        from opentelemetry.trace import SpanKind, set_span_in_context

        offset_ns = time_ns() - perf_counter_ns()
        request = event.delivery.envelope
        about: dict[str, str | int] = {
            "epypes.bundle": provenance.name,
            "epypes.bundle_digest": provenance.digest,
            "epypes.revision": result.revision,
            "epypes.event_id": event.id,
            "epypes.correlation_id": "" if request is None else request.correlation_id,
            "epypes.outcome": result.outcome,
            "epypes.attempts": event.attempts,
        }
        span = self._tracer.start_span(
            f"process {provenance.name}",
            extract(_carrier(event)),
            SpanKind.CONSUMER,
            {name: value for name, value in about.items() if value != ""},
            start_time=offset_ns + event.accepted_ns,
        )
        if result.failure is not None:
            _set_failure(span, result.failure)
        begin_ns, inside = offset_ns + event.started_ns, set_span_in_context(span)
        for name, duration_ns in result.durations_ns.items():
            child = self._tracer.start_span(name, inside, start_time=begin_ns)
            if result.failure is not None and result.failure.function == name:
                _set_failure(child, result.failure)
            begin_ns += duration_ns
            child.end(begin_ns)
        span.end(offset_ns + perf_counter_ns())


def _carrier(event: AcceptedEvent) -> Mapping[str, Any]:
    """Return what may carry a trace: the attributes of an event that are texts."""
    if event.delivery.envelope is None:
        return {}
    try:
        return event.delivery.envelope.text_attributes()
    except MessageError:  # it has failed in f_in
        return {}


def _set_failure(span: Span, failure: FailedEvent) -> None:
    from opentelemetry.trace import Status, StatusCode

    span.set_status(Status(StatusCode.ERROR, failure.summary))
    about = {
        "exception.type": failure.exception,
        "exception.message": failure.message,
        "exception.stacktrace": "\n".join(failure.trace),
    }
    span.add_event("exception", about)
