"""What a layout is made from and consists of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

Direction = Literal["down", "right"]
Shape = Literal["box", "ellipse", "hexagon"]
Point = tuple[float, float]
Edge = tuple[int, int]


class Box(NamedTuple):
    """A vertex to be placed: its shape and size, in pixels."""

    shape: Shape
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Layout:
    """A laid-out graph; all lengths in pixels, y downwards.

    Attributes
    ----------
    width, height
        Of the whole picture.
    centres
        By vertex.
    splines
        By edge: the control points of a cubic Bézier spline, then the tip of the arrow; none in a dense graph.
    """

    width: float
    height: float
    centres: tuple[Point, ...]
    splines: tuple[tuple[Point, ...], ...]

    def __hash__(self) -> int:
        # Of a kept layout. To hash thousands of numbers takes longer than to paint them.
        return id(self)
