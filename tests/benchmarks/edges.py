"""What does a graph cost beside real functions: the paper's edge graph?"""

from __future__ import annotations

import cv2
import numpy as np
from skimage import data

from tests.benchmarks import ours, peers
from tests.benchmarks.functions import STRAIGHT
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort
from tests.benchmarks.work import blur, canny, edge_graph, grayscale


def rows(effort: Effort) -> list[Row]:
    return [
        _row(effort, "edge graph, 64 x 64", (64, 64), rounds=2000, most=1.06),
        _row(effort, "edge graph, 1 MP", (1224, 816), rounds=200, most=1.01),
    ]


def _row(effort: Effort, name: str, size: tuple[int, int], rounds: int, most: float) -> Row:
    photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    image = np.ascontiguousarray(cv2.resize(photograph, size))
    work = edge_graph(image)
    contenders = {
        STRAIGHT: lambda: canny(blur(grayscale(image), 11), 70, 200),
        OURS: ours.run(work),
        **{name: peer.run for name, peer in peers.built(effort, work).items()},
    }
    times = effort.measure(contenders, rounds)
    return row(name, times, functions=3, goal=Goal("ratio", most), limit=STRAIGHT)
