"""Nodes and pipelines of one's own classes that override stop()."""

from epypes.compgraph import CompGraph, create_nodes_from_comp_graph
from epypes.node import Node
from epypes.pipeline import Pipeline, SinkPipeline
from epypes.queue import Queue


class Camera(Node):
    def __init__(self, name):
        self.is_open = True
        super().__init__(name, self.grab)

    def grab(self, exposure):
        return exposure * 2 if self.is_open else 0

    def stop(self):
        self.is_open = False
        super().stop()


class Station(Pipeline):
    def __init__(self, camera):
        cg = CompGraph({camera.name: camera}, {camera.name: ("exposure", "frame")})
        super().__init__("station", cg)
        self.was_stopped = False

    def stop(self):
        self.was_stopped = True
        super().stop()


station = Station(Camera("camera"))
station.run(exposure=5)
assert station["frame"] == 10
station.stop()
assert station.was_stopped

done, camera = Queue(), Camera("camera")
cg = CompGraph({"camera": camera, "put": done.put}, {"camera": ("exposure", "frame"), "put": ("frame", ())})
sink = SinkPipeline("sink", cg, q_in := Queue(), lambda event: {"exposure": event})
sink.listen()
q_in.put(4)
assert done.get(timeout=60) == 8
sink.stop()
camera.stop()
assert not camera.is_open
assert set(create_nodes_from_comp_graph(cg)) == {"camera", "put"}
assert set(cg.to_cg_with_nodes().nodes) == {"camera", "put"}
