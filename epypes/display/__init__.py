"""How a graph, a run and a value look, as static SVG, HTML and text."""

from epypes.display.mime import mimebundle, to_svg
from epypes.display.previews.raster import Picture, encode_image, is_image
from epypes.display.printed import to_text
from epypes.display.show import Figure, show
from epypes.display.views.graphview import GraphView
from epypes.display.views.view import view

__all__ = [
    "Figure",
    "GraphView",
    "Picture",
    "encode_image",
    "is_image",
    "mimebundle",
    "show",
    "to_svg",
    "to_text",
    "view",
]
