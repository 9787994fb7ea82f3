"""Functions of OpenCV that write into their inputs, as functions of a graph: calibration and drawing."""

import cv2
import numpy as np
from epypes.compgraph import CompGraph, CompGraphRunner

K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
grid = np.zeros((30, 3), np.float32)
grid[:, :2] = np.mgrid[:6, :5].T.reshape(-1, 2)
poses = [(np.array([0.1 * n, -0.2 + 0.1 * n, 0.05]), np.array([-2.0, -2.0, 12.0 + n])) for n in range(6)]


def project(shift):
    views = [cv2.projectPoints(grid, r, t + np.array([shift, 0, 0]), K, None)[0] for r, t in poses]
    return [view.astype(np.float32) for view in views]


outputs = ("rms", "K1", "d1", "K2", "d2", "R", "T", "E", "F")
cg = CompGraph(
    {"calibrate": cv2.stereoCalibrate, "mark": cv2.circle},
    {
        "calibrate": (("object_points", "left", "right", "K1_0", "d1_0", "K2_0", "d2_0", "size"), outputs),
        "mark": (("image", "centre", "radius", "colour"), "marked"),
    },
)
frozen = {"size": (320, 240), "centre": (8, 8), "radius": 4, "colour": 255}
runner = CompGraphRunner(cg, frozen)
K1, d1, K2, d2 = K.copy(), np.zeros(5), K.copy(), np.zeros(5)
runner.run(
    object_points=[grid] * 6, left=project(0), right=project(-0.5), K1_0=K1, d1_0=d1, K2_0=K2, d2_0=d2,
    image=np.zeros((16, 16), np.uint8),
)  # fmt: skip
assert runner["rms"] < 0.1
assert abs(runner["T"][0, 0] + 0.5) < 0.01
assert runner["marked"].any()
