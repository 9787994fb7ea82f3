"""A reactive vision system of a subscriber, a grabber, a pipeline and a publisher."""

import numpy as np
from epypes.compgraph import CompGraph
from epypes.pipeline import FullPipeline
from epypes.reactivevision import ReactiveVisionSystem, create_queues, dispatch_images

q_in, q_images, q_out = create_queues()
calls = []


class Part:
    """What stands for a socket, or for cameras that put a pair of images for each event."""

    def __init__(self, name):
        self.name = name

    def start(self, show_video=False):
        calls.append(("start", self.name))
        if self.name == "grabber":
            q_images.put((np.full((2, 2), 1), np.full((2, 2), 3)))

    def stop(self):
        calls.append(("stop", self.name))


cg = CompGraph({"difference": lambda a, b: b - a}, {"difference": (("image_1", "image_2"), "d")})
pipe = FullPipeline("pair", cg, q_images, q_out, dispatch_images, lambda pipe: int(pipe["d"].sum()))
system = ReactiveVisionSystem(Part("subscriber"), Part("grabber"), pipe, Part("publisher"))
system.start()
assert q_out.get(timeout=60) == 8
system.stop()
assert [name for _, name in calls] == ["publisher", "grabber", "subscriber", "subscriber", "grabber", "publisher"]
assert set(dispatch_images([1])) == {"image"}
