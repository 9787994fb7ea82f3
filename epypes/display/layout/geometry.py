"""What a layout is made from and consists of."""

from __future__ import annotations

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


class Layout(NamedTuple):
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
