"""A span of each event, with a child of each function, in a trace that the sender may have begun."""

from __future__ import annotations

import sys
import threading
from time import time_ns

import pytest
from opentelemetry.sdk.trace import SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SimpleSpanProcessor, SpanExporter, SpanExportResult
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

from epypes.service.tracing import EventTracer
from epypes.wire import Envelope
from tests.service.bundles import written_bundle
from tests.service.served import serving

pytestmark = pytest.mark.slow

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"

SOURCE = '''
    """Two functions, of which the second may fail."""


    def double(number):
        return 2 * number


    def divide(doubled, k):
        return doubled // k


    func_dict = {"double": double, "divide": divide}
    func_io = {"double": ("number", "doubled"), "divide": (("doubled", "k"), "out")}
'''


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "dividing"
    sample = {"number": 3}, {"out": 6}
    return written_bundle(folder, SOURCE, ["number"], ["out"], hyperparameters={"k": 1}, sample=sample)


def test_where_no_provider_is_set_nothing_is_traced_or_imported(monkeypatch):
    assert EventTracer.configured(None) is None, "the API alone has one that does nothing"
    for name in [name for name in sys.modules if name.startswith("opentelemetry")]:
        monkeypatch.delitem(sys.modules, name)
    assert EventTracer.configured(None) is None
    assert not [name for name in sys.modules if name.startswith("opentelemetry")]


def test_each_event_is_a_span_with_its_functions_and_its_failure(bundle):
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    began_ns = time_ns()
    with serving(bundle, tracer_provider=provider) as (service, peer):
        carrier = {"traceparent": f"00-{TRACE}-{PARENT}-01", "n": 1}
        request = Envelope("x", {"number": 4}, attributes=carrier, correlation_id="asked")
        peer.requests.put(request)
        peer.take()
        service.set_parameters({"k": 0})
        peer.requests.put(Envelope("x", {"number": 4}))
        assert peer.take()[0].failure.function == "divide"
        peer.requests.put(b"no envelope")
        peer.take()
        digest, name = service.service_state.digest, "dividing"
    spans = exporter.get_finished_spans()
    first, second, third = [span for span in spans if span.kind is SpanKind.CONSUMER]

    def children(event):
        return [span for span in spans if span.parent and span.parent.span_id == event.context.span_id]

    assert first.name == f"process {name}"
    assert dict(first.attributes) == {
        "epypes.bundle": name,
        "epypes.bundle_digest": digest,
        "epypes.revision": 0,
        "epypes.event_id": request.id,
        "epypes.correlation_id": "asked",
        "epypes.outcome": "answered",
        "epypes.attempts": 1,
    }
    assert (f"{first.context.trace_id:032x}", f"{first.parent.span_id:016x}") == (TRACE, PARENT)
    assert first.status.status_code is StatusCode.UNSET
    double, divide = children(first)
    assert [double.name, divide.name] == ["double", "divide"]
    assert began_ns < first.start_time <= double.start_time < double.end_time == divide.start_time
    assert divide.start_time < divide.end_time <= first.end_time < time_ns()

    assert (second.attributes["epypes.revision"], second.attributes["epypes.outcome"]) == (1, "failed")
    assert f"{second.context.trace_id:032x}" != TRACE
    double, divide = children(second)
    for span in (second, divide):
        assert span.status.status_code is StatusCode.ERROR
        (raised,) = span.events
        assert (raised.name, raised.attributes["exception.type"]) == ("exception", "ZeroDivisionError")
        assert "in divide" in raised.attributes["exception.stacktrace"]
    assert double.status.status_code is StatusCode.UNSET

    assert third.status.status_code is StatusCode.ERROR
    assert children(third) == []


class RaisingProcessor(SpanProcessor):
    def on_start(self, span, parent_context=None):
        raise ValueError("no span")


class BlockingExporter(SpanExporter):
    def __init__(self):
        self.entered, self.released = threading.Event(), threading.Event()

    def export(self, spans):
        self.entered.set()
        self.released.wait()
        return SpanExportResult.SUCCESS


def test_a_processor_that_raises_and_an_exporter_that_blocks_hold_no_event_up(bundle):
    exporter = BlockingExporter()
    blocked, raising = TracerProvider(shutdown_on_exit=False), TracerProvider()
    blocked.add_span_processor(BatchSpanProcessor(exporter, max_queue_size=4, max_export_batch_size=2))
    raising.add_span_processor(RaisingProcessor())
    try:
        for provider in (raising, blocked):
            with serving(bundle, tracer_provider=provider) as (_, peer):
                for number in range(8):
                    peer.requests.put(Envelope("x", {"number": number}))
                    assert peer.take()[0].parts["out"] == 2 * number
        assert exporter.entered.wait(60)
    finally:
        exporter.released.set()
        blocked.shutdown()
