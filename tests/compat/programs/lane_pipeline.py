"""A pipeline of one's own class, with attributes, times and hyperparameters that are modified."""

import cv2
import numpy as np
from epypes.compgraph import CompGraph
from epypes.pipeline import Pipeline

frame = np.zeros((90, 120, 3), np.uint8)
cv2.line(frame, (20, 89), (55, 30), (255, 255, 255), 3)


def gray(im):
    return cv2.cvtColor(im, cv2.COLOR_RGB2GRAY)


def region(edges, top):
    kept = edges.copy()
    kept[:top] = 0
    return kept


def hough(edges, threshold):
    return cv2.HoughLinesP(edges, 1, np.pi / 180, threshold, minLineLength=10, maxLineGap=5)


class LanePipeline(Pipeline):
    def __init__(self, **frozen):
        functions = {"gray": gray, "canny": cv2.Canny, "region": region, "hough": hough}
        io = {
            "gray": ("frame", "frame_gray"),
            "canny": (("frame_gray", "lo", "hi"), "edges"),
            "region": (("edges", "top"), "edges_below"),
            "hough": (("edges_below", "threshold"), "lines"),
        }
        super().__init__("lanes", comp_graph=CompGraph(functions, io), frozen_tokens=frozen)

    def lines(self, frame):
        self.run(frame=frame)
        return self.token_value("lines")


pipe = LanePipeline(lo=50, hi=150, top=40, threshold=15)
expected = hough(region(cv2.Canny(gray(frame), 50, 150), 40), 15)
assert np.array_equal(pipe.lines(frame), expected)
pipe.modify_frozen_token("top", 85)
assert pipe.lines(frame) is None
pipe["top"] = 40
assert np.array_equal(pipe.lines(frame), expected)

pipe.set_attr("camera", "left")
assert pipe.get_attr("camera") == pipe.attributes["camera"] == "left"
assert pipe.get_attr("lens") is None
name, total, nodes = pipe.traverse_time()
assert name == "lanes"
assert {node for node, _ in nodes} == set(pipe.cgraph.functions)
assert total >= sum(time for _, time in nodes)
assert pipe.compute_overhead() >= 0
