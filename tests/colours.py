"""Which graph with RGB tokens do many tests share?"""

from __future__ import annotations

import linecache
from typing import Annotated

import numpy as np

import epypes as ep

_CELL = """\
RGB = ep.Image("uint8", (None, None, 3), order="rgb")
Colours = Annotated[np.ndarray, RGB]

def red_part(image: Colours) -> Annotated[np.ndarray, RGB]:
    part = np.zeros_like(image)
    part[..., 0] = image[..., 0]
    return part

def as_it_is(image):
    return np.maximum(image, 0)
"""


def red_runner() -> ep.CompGraphRunner:
    """Return a runner of a notebook's graph: of an RGB image, it keeps what is red; nothing says it of ``unsaid``."""
    name = "<cell of colours>"
    linecache.cache[name] = (len(_CELL), None, _CELL.splitlines(keepends=True), name)
    names = {"__name__": "__main__", "np": np, "ep": ep, "Annotated": Annotated}
    exec(compile(_CELL, name, "exec"), names)
    functions = {"red_part": names["red_part"], "as_it_is": names["as_it_is"]}
    return ep.CompGraphRunner(ep.CompGraph(functions, {"red_part": ("image", "red"), "as_it_is": ("red", "unsaid")}))


def red_image(side_px: int = 64) -> np.ndarray:
    """Return a square of RGB (200, 20, 10)."""
    return np.full((side_px, side_px, 3), (200, 20, 10), np.uint8)
