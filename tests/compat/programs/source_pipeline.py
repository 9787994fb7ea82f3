"""A SourcePipeline that feeds a SinkPipeline over a queue."""

from epypes.compgraph import CompGraph
from epypes.pipeline import SinkPipeline, SourcePipeline
from epypes.queue import Queue

between, found = Queue(), Queue()
source = SourcePipeline(
    "source",
    comp_graph=CompGraph({"square": lambda x: x * x}, {"square": ("x", "y")}),
    q_out=between,
    out_prep_func=lambda pipe: {"value": pipe["y"], "source": pipe.name},
)
sink = SinkPipeline(
    "sink",
    CompGraph({"collect": lambda a, b: found.put((a, b))}, {"collect": (("y", "name"), "nothing")}),
    between,
    event_dispatcher=lambda event: {"y": event["value"], "name": event["source"]},
)
sink.listen()
for x in range(3):
    source.run(x=x)
assert [found.get(timeout=60) for _ in range(3)] == [(0, "source"), (1, "source"), (4, "source")]
sink.stop()
