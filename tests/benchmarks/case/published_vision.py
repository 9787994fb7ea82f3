"""What would the case system's vision cost with the package that was published in 2019?

Run as a process of its own, as ``hand_vision``: ``python -m tests.benchmarks.case.published_vision FOLDER``. The folder
holds the published package, which has the name of this one: its classes are taken first, then it makes room. The same
functions run in its FullPipeline; one poller carries the messages, since its own threads never sleep.
"""

from __future__ import annotations

import json
import queue
import sys
from time import perf_counter, time
from typing import Any

import zmq


def _published(folder: str) -> tuple[Any, Any]:
    """Return CompGraph and FullPipeline of the published package."""
    sys.path.insert(0, folder)
    from epypes import compgraph, pipeline

    sys.path.remove(folder)
    for name in [name for name in sys.modules if name.partition(".")[0] == "epypes"]:
        del sys.modules[name]
    return compgraph.CompGraph, pipeline.FullPipeline


class _Answers:
    """A q_out that notes when each answer is put."""

    def __init__(self) -> None:
        self.queue: queue.SimpleQueue[tuple[Any, float]] = queue.SimpleQueue()

    def put(self, answer: Any) -> None:
        self.queue.put((answer, perf_counter()))


def main(folder: str) -> None:
    graph_class, pipeline_class = _published(folder)
    from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
    from epypes.wire import Event, JustBytes, add_attribute
    from tests.benchmarks.case.hand_vision import SHOWN_ROWS, bound

    own, pair = orb_graph(), stereo_pair()
    requests: queue.Queue[Any] = queue.Queue()
    answers = _Answers()

    def f_out(pipe: Any) -> Any:
        start = perf_counter()
        contents = pipe["keypoints_paired"][:SHOWN_ROWS].astype("<f4", copy=False).tobytes()
        message = JustBytes(contents=contents, id=pipe["event_id"])
        return message, start, perf_counter()

    # The event's id goes along as a token, which no function of the paper's graph takes.
    functions = {**own.functions, "name": str}
    io = {**own.func_io, "name": ("event_id", "named")}
    pipe = pipeline_class(
        "vision",
        graph_class(functions, io),
        requests,
        answers,
        lambda event: {"image_1": event[1][0], "image_2": event[1][1], "event_id": event[0].id},
        f_out,
        orb_hyperparameters(),
    )
    pipe.loop.daemon = True
    pipe.listen()
    context = zmq.Context()
    incoming, outgoing, addresses = bound(context)
    print(json.dumps(addresses), flush=True)
    poller = zmq.Poller()
    poller.register(incoming, zmq.POLLIN)
    poller.register(sys.stdin.fileno(), zmq.POLLIN)
    while sys.stdin.fileno() not in dict(poller.poll()):
        event, acquired = Event.FromString(incoming.recv()), time()
        requests.put((event, pair))
        (message, start, end), published = answers.queue.get()
        times, offset = pipe.attributes, time() - perf_counter()
        stamps = {
            "t_react": times["time_react"],
            "t_fin_start": times["time_dispatch_0"],
            "t_fin_end": times["time_dispatch_1"],
            "t_fout_start": start,
            "t_fout_end": end,
            "t_pub": published,
        }
        add_attribute(message, "t_vreq", event.attributes.entries[0].double_val)
        for name in stamps:
            add_attribute(message, f"acquisition.{name}", acquired)
            add_attribute(message, f"vision.{name}", stamps[name] + offset)
        for name, value in (("t_p", pipe.time), ("o_cg", pipe.compute_overhead())):
            add_attribute(message, f"acquisition.{name}", 0.0)
            add_attribute(message, f"vision.{name}", value)
        outgoing.send(message.SerializeToString())
    context.destroy(linger=0)


if __name__ == "__main__":
    main(sys.argv[1])
