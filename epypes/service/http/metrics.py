"""Metrics for Prometheus, read from the service whenever they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import accumulate
from typing import TYPE_CHECKING, Final, get_args

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, InfoMetricFamily
from prometheus_client.exposition import choose_encoder

from epypes.service.lifecycle import State

if TYPE_CHECKING:
    from prometheus_client.core import Metric

    from epypes.service import Service

_NS_PER_S: Final = 1e9
_STATES: Final = get_args(State)
_EVENT_OUTCOMES: Final = ("answered", "failed", "dropped", "dead_letters")
_ROW_OUTCOMES: Final = ("written", "skipped")
# By name in `Service.counts`: name of the metric, and its description.
_COUNTERS: Final = {
    "received": ("epypes_events_received", "Events that were accepted."),
    "retried": ("epypes_events_retried", "Further tries of events whose worker was killed."),
    "rejected": ("epypes_messages_rejected", "Messages that were no events."),
    "slow_subscribers": ("epypes_slow_subscribers", "How often answers were lost to a subscriber that is too slow."),
    "lost": ("epypes_events_lost", "Events that were sent and never came, by gaps in their numbers; without a broker."),
}
_BROKER_COUNTERS: Final = {
    "redelivered": ("epypes_events_redelivered", "Events that the broker had delivered before."),
    "duplicates": ("epypes_events_duplicate", "Events that came again while they were in flight, or done."),
    "given_back": ("epypes_events_given_back", "Events that were left to the broker, which delivers them again."),
    "reconnects": ("epypes_broker_reconnects", "Reconnections to the broker."),
}
_GAUGES: Final = {
    "waiting": ("epypes_events_waiting", "Events in the mailbox."),
    "in_flight": ("epypes_events_in_flight", "Events that are being computed."),
}


class ServiceCollector:
    """Reads a service at every scrape; keeps nothing."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        service = self._service
        info = service.info()
        identity = {"name": info["name"], "digest": info["digest"], **info["versions"]}
        labels = {key: str(value) for key, value in identity.items()}
        yield InfoMetricFamily("epypes_service", "What is served.", labels)
        yield CounterMetricFamily("epypes_worker_restarts", "Restarts of workers.", info["restarts"])
        yield GaugeMetricFamily("epypes_parameters_revision", "Revision of the parameters.", info["revision"])
        started_s = info["started_ns"] / _NS_PER_S
        yield GaugeMetricFamily("epypes_start_time_seconds", "When the service was started, in Unix time.", started_s)
        yield _labelled(
            GaugeMetricFamily("epypes_state", "1 for the state that the service is in.", labels=["state"]),
            {state: float(state == service.state) for state in _STATES},
        )
        if states := info.get("states"):
            yield GaugeMetricFamily("epypes_states", "States between events, of all sources.", states["count"])
            yield GaugeMetricFamily("epypes_states_bytes", "Their size.", states["bytes"])
            about = "States that were forgotten, since there were too many."
            yield CounterMetricFamily("epypes_states_forgotten", about, states["forgotten"])
        yield from self._events()
        yield from self._times()
        yield from self._event_log()
        yield from self._group()

    def _events(self) -> Iterator[Metric]:
        counts = self._service.counts()
        of_broker = {name: metric for name, metric in _BROKER_COUNTERS.items() if name in counts}
        for name, (metric, about) in {**_COUNTERS, **of_broker}.items():
            yield CounterMetricFamily(metric, about, counts.get(name, 0))
        outcomes = {outcome.removesuffix("s"): counts.get(outcome, 0) for outcome in _EVENT_OUTCOMES}
        yield _labelled(
            CounterMetricFamily("epypes_events_resolved", "Events by outcome.", labels=["outcome"]), outcomes
        )
        for name, (metric, about) in _GAUGES.items():
            yield GaugeMetricFamily(metric, about, counts.get(name, 0))

    def _times(self) -> Iterator[Metric]:
        latency = self._service.latency()
        about = "From the acceptance of an event to its answer."
        histogram = HistogramMetricFamily("epypes_event_latency_seconds", about)
        ends = [*map(str, latency.bounds_s), "+Inf"]
        histogram.add_metric([], list(zip(ends, accumulate(latency.counts), strict=True)), latency.total_s)
        yield histogram
        yield CounterMetricFamily("epypes_computing_seconds", "Time that the graph took.", latency.computing_s)
        about = "Time that a function took."
        yield _labelled(CounterMetricFamily("epypes_function_seconds", about, labels=["function"]), latency.functions_s)

    def _event_log(self) -> Iterator[Metric]:
        counts = self._service.event_log.counts()
        if counts:
            outcomes = {outcome: counts[outcome] for outcome in _ROW_OUTCOMES}
            yield _labelled(
                CounterMetricFamily("epypes_event_rows", "Rows of events by outcome.", labels=["outcome"]), outcomes
            )
            yield GaugeMetricFamily("epypes_event_rows_waiting", "Rows that wait for the database.", counts["waiting"])

    def _group(self) -> Iterator[Metric]:
        group = self._service.group()
        if group["is_shared"]:
            yield GaugeMetricFamily("epypes_group_replicas", "Replicas that share the events.", group["replicas"])
            yield GaugeMetricFamily("epypes_group_ready", "Replicas that are ready.", group["ready"])
            about = "Replicas that went away without stopping in the last ten minutes, and are not back."
            yield GaugeMetricFamily("epypes_group_lost", about, len(group["lost"]))
            about = "1 if all of them have the same bundle and revision of the parameters."
            yield GaugeMetricFamily("epypes_group_agrees", about, float(group["agree"]))


def _labelled(metric: CounterMetricFamily | GaugeMetricFamily, values: Mapping[str, float]) -> Metric:
    for label, value in values.items():
        metric.add_metric([label], value)
    return metric


def registry_of(service: Service) -> CollectorRegistry:
    """Return a registry with the metrics of one service."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(ServiceCollector(service))
    return registry


def exposed(registry: CollectorRegistry, accept: str) -> tuple[str, bytes]:
    """Return media type and text of a registry's metrics in the format that an Accept header asks for."""
    encode, media_type = choose_encoder(accept)
    return media_type, encode(registry)
