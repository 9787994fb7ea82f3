"""What does a graph cost above straight-line code?"""

from __future__ import annotations

import cv2
import numpy as np
from skimage import data

import epypes as ep
from tests.benchmarks.timing import Row, interleaved


def _chain_rows() -> list[Row]:
    count = 100

    def add(x: int) -> int:
        return x + 1

    cg = ep.CompGraph(
        {f"f{index}": add for index in range(count)},
        {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)},
    )
    runner = ep.CompGraphRunner(cg)

    def straight() -> int:
        x = 0
        for _ in range(count):
            x = add(x)
        return x

    last = ep.CompGraphRunner(
        ep.CompGraph({**cg.functions, "last": lambda x, k: x + k}, {**cg.func_io, "last": ((f"t{count}", "k"), "y")}),
        {"k": 0},
    )
    last.run(t0=0)
    values = iter(range(1, 10**6))
    return [
        Row("chain of 100 trivial functions", *interleaved(straight, lambda: runner.run(t0=0), 300)),
        Row("rerun of the last of 101", *interleaved(lambda: add(1), lambda: last.rerun(k=next(values)), 300)),
    ]


def _edge_rows() -> list[Row]:
    photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    functions = {
        "grayscale": lambda im: cv2.cvtColor(im, cv2.COLOR_BGR2GRAY),
        "blur": lambda im, k: cv2.GaussianBlur(im, (k, k), 0),
        "canny": cv2.Canny,
    }
    io = {
        "grayscale": ("image", "image_gray"),
        "blur": (("image_gray", "blur_kernel"), "image_blurred"),
        "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
    }
    runner = ep.CompGraphRunner(ep.CompGraph(functions, io), {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    rows = []
    for name, size in (("64 x 64", (64, 64)), ("1 MP", (1224, 816))):
        image = np.ascontiguousarray(cv2.resize(photograph, size))

        def straight(image: np.ndarray = image) -> np.ndarray:
            gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            return cv2.Canny(cv2.GaussianBlur(gray, (11, 11), 0), 70, 200)

        limit, ours = interleaved(straight, lambda image=image: runner.run(image=image), 100)
        rows.append(Row(f"edge graph, {name}", limit, ours))
    return rows


def rows() -> list[Row]:
    return _chain_rows() + _edge_rows()
