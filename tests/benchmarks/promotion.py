"""Time of a promotion, beside the replays that are its proof."""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter_ns

import cv2
from skimage import data

import epypes as ep
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times
from tests.bundle.cells import cell

_ROUNDS = 5
_LIMIT = "its replays"
_CELL = """
import cv2

def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)

def blur(img, k):
    return cv2.GaussianBlur(img, (k, k), 0)
"""


def rows(effort: Effort) -> list[Row]:
    """Return a row: the whole promotion of the README's graph, and the part of it in which the replays run."""
    names = cell(_CELL)
    cg = ep.CompGraph(
        {"grayscale": names["grayscale"], "blur": names["blur"], "canny": cv2.Canny},
        {
            "grayscale": ("image", "image_gray"),
            "blur": (("image_gray", "blur_kernel"), "image_blurred"),
            "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
        },
    )
    runner = ep.CompGraphRunner(cg, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    runner.run(image=cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR))
    durations_ns: dict[str, dict[int, float]] = {_LIMIT: {}, OURS: {}}
    with tempfile.TemporaryDirectory(prefix="epypes-bench-") as folder:
        for number in range(1 if effort.quick else _ROUNDS):
            steps_ns: list[tuple[str, int]] = []
            start_ns = perf_counter_ns()
            ep.promote(
                runner,
                Path(folder) / "edges",
                on_progress=lambda text, steps_ns=steps_ns: steps_ns.append((text, perf_counter_ns())),
            )
            end_ns = perf_counter_ns()
            replays_ns = next(at_ns for text, at_ns in steps_ns if text.startswith("replaying"))
            durations_ns[_LIMIT][number], durations_ns[OURS][number] = end_ns - replays_ns, end_ns - start_ns
    goal = Goal("above", 1e9)
    return [row("promotion of the edge graph", Times(durations_ns), goal=goal, limit=_LIMIT, note="5 in one process")]
