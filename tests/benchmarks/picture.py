"""Benchmarks of looking at graphs."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from skimage import data, measure

import epypes as ep
from epypes.display import encode_image, mimebundle, to_svg
from epypes.display.layout import lay_out
from epypes.display.previews.preview import preview
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort


def rows(effort: Effort) -> list[Row]:
    photograph = cv2.resize(cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR), (1224, 816))
    runner = ep.CompGraphRunner(
        ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")}), {"lo": 70, "hi": 200}
    )
    runner.run(image=photograph)

    def thumbnails() -> None:
        encode_image(runner["image"], 128)
        encode_image(runner["edges"], 128)

    def laid_out_anew() -> None:
        lay_out.cache_clear()
        to_svg(runner)

    def picture() -> None:
        to_svg(runner)

    opencv = lambda: cv2.imencode(".jpg", photograph, [cv2.IMWRITE_JPEG_QUALITY, 80])  # noqa: E731
    return [
        *_large_graph(effort),
        *_large_images(effort, photograph),
        _row(effort, "picture with 2 thumbnails", "thumbnails alone", thumbnails, picture),
        _row(effort, "picture, laid out anew", "kept layout", picture, laid_out_anew),
        _row(effort, "1 MP photograph to JPEG", "OpenCV", opencv, lambda: encode_image(photograph)),
    ]


def _large_graph(effort: Effort) -> list[Row]:
    """Show a graph of 200 functions again after a rerun, beside making its thumbnails, which takes the same in any case."""
    image = cv2.resize(data.camera(), (640, 480))
    io = {f"f{index}": ((f"t{index}", "k"), f"t{index + 1}") for index in range(200)}
    runner = ep.CompGraphRunner(ep.CompGraph(dict.fromkeys(io, lambda x, k: x + np.uint8(k)), io), {"k": 1})
    runner.run(t0=image)
    counts = iter(range(10**9))

    def thumbnails() -> None:
        runner.rerun(k=next(counts) % 200)
        for index in range(24):
            preview(runner[f"t{200 - index}"])

    def shown() -> None:
        runner.rerun(k=next(counts) % 200)
        mimebundle(runner)

    times = effort.measure({"24 thumbnails": thumbnails, OURS: shown}, 20, same=False)
    note = "limit: rerun, and previews of 24 tokens"
    goal = Goal("above", 50e6)
    return [row("show 200 functions after a rerun", times, functions=200, goal=goal, limit="24 thumbnails", note=note)]


def _large_images(effort: Effort, photograph: np.ndarray) -> list[Row]:
    """Preview images of 12 MP beside those of 1 MP."""
    small = photograph[:816, :1224]
    blobs = measure.label(cv2.GaussianBlur(small, (0, 0), 9)[..., 0] > 110).astype(np.int32)
    kinds = {
        "gray": small[..., 0].copy(),
        "BGR": small,
        "float32": small[..., 0].astype(np.float32),
        "mask": small[..., 0] > 110,
        "labels": blobs,
    }
    found = []
    for kind, image in kinds.items():
        large = np.repeat(np.repeat(image, 4, axis=0)[: 816 * 3], 4, axis=1)[:, : 1224 * 4].copy()
        times = effort.measure(
            {"1 MP": lambda image=image: preview(image), OURS: lambda large=large: preview(large)}, 20, same=False
        )
        note = f"limit: its preview at 1 MP; here {large.shape[0] * large.shape[1] / 1e6:.0f} MP"
        found.append(row(f"preview of 12 MP, {kind}", times, goal=Goal("ratio", 1.5), limit="1 MP", note=note))
    return found


def _row(effort: Effort, name: str, limit: str, below: Callable[[], object], above: Callable[[], object]) -> Row:
    times = effort.measure({limit: below, OURS: above}, 50, same=False)
    return row(name, times, limit=limit, note=f"limit: {limit}")
