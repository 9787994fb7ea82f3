"""What does a sweep cost beside computing once what its settings share, and the last function for each of them?"""

from __future__ import annotations

import cv2
import numpy as np
from skimage import data

import epypes as ep
from tests.benchmarks.row import Goal, Row, row
from tests.benchmarks.timing import Effort

_SETTINGS = 50
_QUICK_SETTINGS = 3
_WIDTH, _HEIGHT = 4000, 3000
_ROUNDS = 6


def grayscale(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def blur(image_gray: np.ndarray, blur_kernel: int) -> np.ndarray:
    return cv2.GaussianBlur(image_gray, (blur_kernel, blur_kernel), 0)


def canny(image_blurred: np.ndarray, canny_lo: int) -> np.ndarray:
    return cv2.Canny(image_blurred, canny_lo, 200)


def rows(effort: Effort) -> list[Row]:
    photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    image = cv2.resize(photograph, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_CUBIC)
    cg = ep.CompGraph.from_functions(
        ep.outputs("image_gray")(grayscale), ep.outputs("image_blurred")(blur), ep.outputs("edges")(canny)
    )
    runner = ep.CompGraphRunner(cg, {"blur_kernel": 11, "canny_lo": 70})
    runner.run(image=image)
    values = list(range(20, 20 + 3 * (_QUICK_SETTINGS if effort.quick else _SETTINGS), 3))

    def by_hand() -> int:
        blurred = blur(grayscale(image), 11)
        # One at a time, as a sweep does: 50 results of 12 MB in memory cost more than to compute them.
        return sum(canny(blurred, value).shape != blurred.shape for value in values)

    def swept(show: tuple[str, ...] | None) -> int:
        result = ep.sweep(runner, {"canny_lo": values}, keep=(), show=show, progress=False)
        return len(result.failures)

    note = (
        f"{len(values)} values of the last function's parameter, 12 MP; limit: one upstream run and the last functions"
    )
    contenders = {
        "by hand": by_hand,
        "EPypes": lambda: swept(None),
        "without pictures": lambda: swept(()),
    }
    times = Effort(effort.quick, 10 * effort.budget_s).measure(contenders, _ROUNDS, same=False)
    return [row("sweep", times, goal=Goal("ratio", 1.15), note=note)]
