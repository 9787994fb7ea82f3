"""How a graph, a run and a value look, as static SVG, HTML and text."""

from epypes.display.formatters import Figure, mimebundle, show, to_svg, to_text
from epypes.display.previews import Backdrop, Chart, Marks, Most, Picture, Preview, Scene
from epypes.display.previews.drawing import scene_picture
from epypes.display.previews.encoding import encode_image
from epypes.display.previews.images import is_image
from epypes.display.previews.preview import register_preview
from epypes.display.views.full_pictures import full_picture
from epypes.display.views.graphview import GraphView
from epypes.display.views.surroundings import reset_display_ranges, scene_of
from epypes.display.views.view import view
from epypes.rich_display import Formatters, register

register(Formatters(mimebundle, to_text))

__all__ = [
    "Backdrop",
    "Chart",
    "Figure",
    "GraphView",
    "Marks",
    "Most",
    "Picture",
    "Preview",
    "Scene",
    "encode_image",
    "full_picture",
    "is_image",
    "mimebundle",
    "register_preview",
    "reset_display_ranges",
    "scene_of",
    "scene_picture",
    "show",
    "to_svg",
    "to_text",
    "view",
]
