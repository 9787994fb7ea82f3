"""What does a look at a graph cost?"""

from __future__ import annotations

import cv2
from skimage import data

import epypes as ep
from epypes.display import encode_image, to_svg
from epypes.display.layout import lay_out
from tests.benchmarks.timing import Row, interleaved


def rows() -> list[Row]:
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

    opencv = lambda: cv2.imencode(".jpg", photograph, [cv2.IMWRITE_JPEG_QUALITY, 80])  # noqa: E731
    return [
        Row("picture with 2 thumbnails: thumbnails, all", *interleaved(thumbnails, lambda: to_svg(runner))),
        Row("the same: kept layout, new layout", *interleaved(lambda: to_svg(runner), laid_out_anew)),
        Row("1 MP photograph to JPEG: OpenCV, ours", *interleaved(opencv, lambda: encode_image(photograph))),
    ]
