"""How a graph, a run and a value look, as static SVG, HTML and text."""

from epypes.display.graphview import GraphView
from epypes.display.mime import mimebundle, to_svg
from epypes.display.raster import Picture, encode_image, is_image
from epypes.display.view import view

__all__ = ["GraphView", "Picture", "encode_image", "is_image", "mimebundle", "to_svg", "view"]
