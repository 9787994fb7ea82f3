"""What does a look at a graph cost?"""

from __future__ import annotations

from collections.abc import Callable

import cv2
from skimage import data

import epypes as ep
from epypes.display import encode_image, to_svg
from epypes.display.layout.place import lay_out
from tests.benchmarks.row import OURS, Row, row
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
        _row(effort, "picture with 2 thumbnails", "thumbnails alone", thumbnails, picture),
        _row(effort, "picture, laid out anew", "kept layout", picture, laid_out_anew),
        _row(effort, "1 MP photograph to JPEG", "OpenCV", opencv, lambda: encode_image(photograph)),
    ]


def _row(effort: Effort, name: str, limit: str, below: Callable[[], object], above: Callable[[], object]) -> Row:
    times = effort.measure({limit: below, OURS: above}, 50, same=False)
    return row(name, times, limit=limit, note=f"limit: {limit}")
