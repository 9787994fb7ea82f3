"""Prometheus reads the counts and times of a service."""

from __future__ import annotations

import re

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as read_openmetrics
from prometheus_client.parser import text_string_to_metric_families as read_text

OPENMETRICS = "application/openmetrics-text; version=1.0.0"
UNITS = re.compile(r"epypes_[a-z0-9_]*(_total|_seconds|_seconds_bucket|_seconds_sum|_seconds_count|_info|[a-z])")


@pytest.fixture
def families(client):
    return {family.name: family for family in read_text(client.get("/metrics").text)}


def value(families, name, **labels):
    (found,) = (
        sample.value
        for family in families.values()
        for sample in family.samples
        if sample.name == name and sample.labels == labels
    )
    return found


@pytest.mark.slow
def test_every_metric_is_ours_described_and_has_its_unit_in_its_name(families):
    for family in families.values():
        assert family.documentation.endswith(".")
        for sample in family.samples:
            assert UNITS.fullmatch(sample.name)
            assert family.type != "counter" or sample.name.endswith("_total")
            assert not re.search("_(ns|ms|milliseconds|nanoseconds)", sample.name)
            assert all(re.fullmatch("[a-z_]+", label) for label in sample.labels)


def test_both_formats_say_the_same(client):
    text = {family.name for family in read_text(client.get("/metrics").text)}
    answer = client.get("/metrics", headers={"Accept": OPENMETRICS})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    opened = list(read_openmetrics(answer.text))
    names = {sample.name for family in opened for sample in family.samples}
    assert text <= names | {name.removesuffix("_total") for name in names} | {family.name for family in opened}


def test_the_latency_is_a_whole_histogram(families):
    buckets = [s for s in families["epypes_event_latency_seconds"].samples if s.name.endswith("_bucket")]
    bounds = [float(sample.labels["le"]) for sample in buckets]
    assert bounds == sorted(bounds)
    assert bounds[-1] == float("inf")
    counts = [sample.value for sample in buckets]
    assert counts == sorted(counts)
    assert counts[-1] == value(families, "epypes_event_latency_seconds_count")


def test_the_time_of_each_function_is_counted(families):
    spent = {sample.labels["function"]: sample.value for sample in families["epypes_function_seconds"].samples}
    assert spent.keys() == {"smooth", "canny"}
    assert 0 < sum(spent.values()) <= value(families, "epypes_computing_seconds_total")


def test_the_service_is_in_one_state(families):
    states = {sample.labels["state"]: sample.value for sample in families["epypes_state"].samples}
    assert states == {state: float(state == "READY") for state in states}
    assert len(states) == 7


def test_counts_are_those_of_the_service(families, service):
    counts = service.counts()
    assert value(families, "epypes_events_received_total") == counts["received"]
    assert value(families, "epypes_events_resolved_total", outcome="answered") == counts["answered"]
    assert value(families, "epypes_events_resolved_total", outcome="dead_letter") == counts["dead_letters"]
    assert value(families, "epypes_parameters_revision") == service.parameters().revision
