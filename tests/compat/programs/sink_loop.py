"""A SinkPipeline that goes on after an event that fails, and reports it to a handler."""

from epypes.compgraph import CompGraph
from epypes.pipeline import SinkPipeline
from epypes.queue import Queue

seen, failed = Queue(), Queue()


def divide(a, b):
    return a / b


cg = CompGraph({"divide": divide, "show": seen.put}, {"divide": (("a", "b"), "c"), "show": ("c", ())})
pipe = SinkPipeline("sink", cg, Queue(), lambda event: {"a": event[0], "b": event[1]})
pipe.loop.set_exception_handler(lambda exception, pipeline: failed.put((type(exception), pipeline.name)))
pipe.listen()
for event in ((1, 2), (1, 0), (9, 3)):
    pipe._qin.put(event) if hasattr(pipe, "_qin") else pipe.q_in.put(event)
assert [seen.get(timeout=60), seen.get(timeout=60)] == [0.5, 3.0]
assert failed.get(timeout=60) == (ZeroDivisionError, "sink")
assert pipe.loop.is_alive()
pipe.stop()
assert not pipe.loop.is_alive()
