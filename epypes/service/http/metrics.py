"""What does Prometheus read of a running service?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry
    from prometheus_client.core import Metric

    from epypes.service.result_publisher import Latency
    from epypes.service.service import Service

_STATES: Final = ("LOADING", "READY", "PAUSED", "DEGRADED", "DRAINING", "FAULTED", "STOPPED")
_NS_PER_S: Final = 1e9
# How an event may end, as it is counted.
_OUTCOMES: Final = ("answered", "failed", "dropped", "dead_letters")
# Skipped: there was no room for more to wait.
_ROWS: Final = ("written", "skipped", "unwritten")
_COUNTED: Final = {
    "received": ("epypes_events_received", "Events that were accepted."),
    "retried": ("epypes_events_retried", "Further tries of events whose worker was killed."),
    "rejected": ("epypes_messages_rejected", "Messages that were no events."),
    "slow_subscribers": ("epypes_slow_subscribers", "How often answers were lost to a subscriber that is too slow."),
    "lost": ("epypes_events_lost", "Events that were sent and never came, by gaps in their numbers; without a broker."),
}
# Where a broker delivers the events.
_COUNTED_OF_BROKER: Final = {
    "redelivered": ("epypes_events_redelivered", "Events that the broker had delivered before."),
    "duplicates": ("epypes_events_duplicate", "Events that came again while they were in hand, or done."),
    "given_back": ("epypes_events_given_back", "Events that were left to the broker, which delivers them again."),
    "reconnects": ("epypes_broker_reconnects", "How often the broker was there again."),
    "overtaken": ("epypes_events_overtaken", "Answers that went on before that of an earlier event."),
}
_HELD: Final = {
    "waiting": ("epypes_events_waiting", "Events in the mailbox."),
    "in_flight": ("epypes_events_in_flight", "Events that are being computed."),
}


@dataclass(frozen=True, slots=True)
class Collector:
    """Reads a service whenever it is asked; nothing is kept here."""

    service: Service

    def collect(self) -> Iterator[Metric]:
        """Give all metrics."""
        info = self.service.info()
        yield from _identity(info)
        yield from _events(self.service.counts())
        yield _state(self.service.state)
        yield from _times(self.service.latency())
        yield from _stored(self.service.event_log.counts())
        yield from _group(self.service.group())


def registry_of(service: Service) -> CollectorRegistry:
    """Return a registry with this service's metrics alone."""
    from prometheus_client import CollectorRegistry

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Collector(service))
    return registry


def exposed(registry: CollectorRegistry, accept: str) -> tuple[str, bytes]:
    """Return media type and text of a registry's metrics in the format that an Accept header asks for."""
    from prometheus_client.exposition import choose_encoder

    encode, media_type = choose_encoder(accept)
    return media_type, encode(registry)


def _identity(info: Mapping[str, Any]) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

    named = {"name": info["name"], "digest": info["digest"], **info["versions"]}
    yield InfoMetricFamily("epypes_service", "What is served.", {key: str(value) for key, value in named.items()})
    yield CounterMetricFamily("epypes_worker_restarts", "Workers that were started anew.", info["restarts"])
    yield GaugeMetricFamily("epypes_parameters_revision", "Revision of the parameters.", info["revision"])
    started = info["started_ns"] / _NS_PER_S
    yield GaugeMetricFamily("epypes_start_time_seconds", "When the service was started, in Unix time.", started)


def _events(counts: Mapping[str, int]) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    of_broker = {count: told for count, told in _COUNTED_OF_BROKER.items() if count in counts}
    for count, (name, about) in {**_COUNTED, **of_broker}.items():
        yield CounterMetricFamily(name, about, counts.get(count, 0))
    resolved = CounterMetricFamily("epypes_events_resolved", "Events by how they ended.", labels=["outcome"])
    for outcome in _OUTCOMES:
        resolved.add_metric([outcome.removesuffix("s")], counts.get(outcome, 0))
    yield resolved
    for count, (name, about) in _HELD.items():
        yield GaugeMetricFamily(name, about, counts.get(count, 0))


def _stored(counts: Mapping[str, int]) -> Iterator[Metric]:
    """Give what became of the rows of events; nothing if none are stored."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    if counts:
        rows = CounterMetricFamily("epypes_event_rows", "Rows of events by what became of them.", labels=["outcome"])
        for outcome in _ROWS:
            rows.add_metric([outcome], counts[outcome])
        yield rows
        yield GaugeMetricFamily("epypes_event_rows_waiting", "Rows that wait for the database.", counts["waiting"])


def _group(group: Mapping[str, Any]) -> Iterator[Metric]:
    """Give how many replicas share the events; nothing where nobody could."""
    from prometheus_client.core import GaugeMetricFamily

    if group["is_shared"]:
        yield GaugeMetricFamily("epypes_group_replicas", "Replicas that share the events.", group["replicas"])
        yield GaugeMetricFamily("epypes_group_ready", "Those of them that are ready.", group["ready"])
        lost = "Those that have gone without a word in the last ten minutes, and are not back."
        yield GaugeMetricFamily("epypes_group_lost", lost, len(group["lost"]))
        agree = "1 if all of them have the same bundle and revision of the parameters."
        yield GaugeMetricFamily("epypes_group_agrees", agree, float(group["agree"]))


def _state(state: str) -> Metric:
    from prometheus_client.core import GaugeMetricFamily

    metric = GaugeMetricFamily("epypes_state", "1 for the state that the service is in.", labels=["state"])
    for each in _STATES:
        metric.add_metric([each], float(each == state))
    return metric


def _times(latency: Latency) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, HistogramMetricFamily

    histogram = HistogramMetricFamily("epypes_event_latency_seconds", "From the acceptance of an event to its answer.")
    ends = [*map(str, latency.bounds_s), "+Inf"]
    histogram.add_metric([], list(zip(ends, accumulate(latency.counts), strict=True)), latency.total_s)
    yield histogram
    yield CounterMetricFamily("epypes_computing_seconds", "Time that the graph took.", latency.computing_s)
    spent = CounterMetricFamily("epypes_function_seconds", "Time that a function took.", labels=["function"])
    for function, spent_s in latency.functions_s.items():
        spent.add_metric([function], spent_s)
    yield spent
