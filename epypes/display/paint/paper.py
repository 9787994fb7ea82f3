"""A painted graph on paper: the SVG of ``svg`` as PNG or PDF, drawn by Matplotlib.

Viewers of SVG are many, converters few, and those that are wheels know neither all of CSS nor PDF. What the painters
write is a small part of SVG, with the colours of paper in one table: Matplotlib draws that, with the fonts it brings.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.etree import ElementTree

from epypes.display.paint.style import paper_declarations
from epypes.optional import LazyModule, optional_import

if TYPE_CHECKING:
    from matplotlib import axes, figure, font_manager, patches, path, textpath
    from PIL import Image
else:
    figure, font_manager, patches, path, textpath = (
        LazyModule(f"matplotlib.{name}") for name in ("figure", "font_manager", "patches", "path", "textpath")
    )
    Image = LazyModule("PIL.Image")

# Pixels of SVG per inch of paper; then a line of 1 px is a line of 1 pt.
_PX_PER_INCH: Final = 72
# A PNG has two pixels for one of the SVG, unless it would be larger than this on a side.
_PNG_SCALE: Final = 2.0
_MOST_PNG_PX: Final = 20_000
# What the layout gives a character, and a line beside its characters.
_CHARACTER_PX: Final = 6.9
_BESIDE_PX: Final = 12.0
_COMMAND: Final = re.compile("([MLHVCZlhvcz])([^A-Za-z]*)")
_NUMBER: Final = re.compile(r"-?[\d.]+")
# Whatever a user has set for plots.
_PLAIN: Final[Any] = {"text.usetex": False, "path.sketch": None, "path.effects": [], "pdf.fonttype": 42}

Point = tuple[float, float]
Style = Mapping[str, str]


def save_on_paper(svg: str, file: Path) -> None:
    """Write a painted graph as PNG or PDF, by the ending of the path, on white.

    Raises
    ------
    MissingPackage
        Matplotlib or Pillow is not installed.
    """
    with optional_import():
        import matplotlib as mpl

    root = ElementTree.fromstring(svg)  # noqa: S314 - our own text
    left, top, width, height = map(float, root.attrib["viewBox"].split())
    kind = file.suffix[1:]
    scale = min(_PNG_SCALE, _MOST_PNG_PX / max(width, height)) if kind == "png" else 1.0
    # Without times and versions, so that the same picture is the same file.
    metadata = {"Software": None} if kind == "png" else {"CreationDate": None, "Producer": None}
    with mpl.rc_context(_PLAIN), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        page = figure.Figure(figsize=(width / _PX_PER_INCH, height / _PX_PER_INCH), facecolor="white")
        drawn = page.add_axes((0, 0, 1, 1))
        drawn.set_axis_off()
        drawn.set_xlim(left, left + width)
        drawn.set_ylim(top + height, top)
        _Painter(drawn).paint(root)
        page.savefig(file, format=kind, dpi=_PX_PER_INCH * scale, metadata=metadata)


class _Painter:
    """Draws the elements of an SVG into axes, one above the other."""

    def __init__(self, drawn: axes.Axes) -> None:
        self._axes = drawn
        self._above = 0
        self._draw = {
            "rect": self._rectangle,
            "ellipse": self._ellipse,
            "circle": self._ellipse,
            "polygon": self._polygon,
            "polyline": self._polygon,
            "path": self._path,
            "text": self._text,
            "image": self._image,
        }

    def paint(self, element: ElementTree.Element, around: tuple[set[str], ...] = ()) -> None:
        """Draw an element and all in it; ``around`` are tag and classes of those that it is in."""
        tag = element.tag.rpartition("}")[2]
        own = {tag, *(f".{name}" for name in element.get("class", "").split())}
        draw = self._draw.get(tag)
        if draw is not None:
            written = dict(part.split(":", 1) for part in element.get("style", "").split(";") if part)
            dashes = {name: element.attrib[name] for name in element.attrib.keys() & {"stroke-dasharray"}}
            draw(element, {**dashes, **paper_declarations((*around, own)), **written})
        for inner in element:
            self.paint(inner, (*around, own) if tag != "svg" else around)

    def _next(self) -> int:
        self._above += 1
        return self._above

    def _add(self, patch: Any, style: Style) -> None:
        """Add a shape with its fill, its line and its dashes."""
        fill, stroke, width = (
            style.get("fill", "#000"),
            style.get("stroke", "none"),
            float(style.get("stroke-width", 1)),
        )
        dashes = [float(part) / width for part in style.get("stroke-dasharray", "").split()]
        patch.set(
            facecolor=fill,
            edgecolor=stroke,
            linewidth=width if stroke != "none" else 0,
            linestyle=(0, dashes) if dashes else "-",
            capstyle=style.get("stroke-linecap", "butt"),
            alpha=float(style["opacity"]) if "opacity" in style else None,
            zorder=self._next(),
        )
        self._axes.add_artist(patch)

    def _rectangle(self, element: ElementTree.Element, style: Style) -> None:
        x, y, width, height = (_number(element, name) for name in ("x", "y", "width", "height"))
        radius = min(_number(element, "rx"), width / 2, height / 2)
        corners = f"round,pad=0,rounding_size={radius:.3f}" if radius else "square,pad=0"
        self._add(patches.FancyBboxPatch((x, y), width, height, boxstyle=corners), style)

    def _ellipse(self, element: ElementTree.Element, style: Style) -> None:
        across, down = (_number(element, name) or _number(element, "r") for name in ("rx", "ry"))
        self._add(patches.Ellipse((_number(element, "cx"), _number(element, "cy")), 2 * across, 2 * down), style)

    def _polygon(self, element: ElementTree.Element, style: Style) -> None:
        end = "Z" if element.tag.endswith("polygon") else ""
        self._add_path(f"M{element.attrib['points'].replace(' ', 'L')}{end}", style)

    def _path(self, element: ElementTree.Element, style: Style) -> None:
        self._add_path(element.attrib["d"], style)

    def _add_path(self, written: str, style: Style) -> None:
        steps = [*_steps(written)]
        if steps:
            points, codes = zip(*steps, strict=True)
            self._add(patches.PathPatch(path.Path(points, codes)), style)

    def _text(self, element: ElementTree.Element, style: Style) -> None:
        text = "".join(element.itertext())
        if not text.strip():
            return
        is_row = "monospace" in style.get("font", "")
        size = float(style.get("font-size", "10px" if is_row else "12px").removesuffix("px"))
        font = font_manager.FontProperties(
            family="DejaVu Sans Mono" if is_row else "DejaVu Sans",
            weight="bold" if int(style.get("font-weight", 400)) >= 600 else "normal",
        )
        # These letters are wider than those of most screens.
        written = textpath.TextPath((0, 0), text.replace("$", "S"), size, prop=font).get_extents().width or 1.0
        room = len(text) * _CHARACTER_PX * size / 12 + _BESIDE_PX
        self._axes.text(
            _number(element, "x"),
            _number(element, "y"),
            text,
            fontproperties=font,
            fontsize=size * min(1.0, room / written),
            color=style["fill"],
            horizontalalignment="left" if style.get("text-anchor") == "start" else "center",
            verticalalignment="baseline",
            parse_math=False,
            zorder=self._next(),
        )

    def _image(self, element: ElementTree.Element, style: Style) -> None:
        x, y, width, height = (_number(element, name) for name in ("x", "y", "width", "height"))
        data = base64.b64decode(element.attrib["href"].partition(",")[2])
        try:
            with Image.open(io.BytesIO(data)) as picture:
                pixels = picture.convert("RGBA")
        except OSError:
            # What a preview of a user's own gives may be a drawing.
            self._add(patches.Rectangle((x, y), width, height), {"fill": "#e6e8eb"})
            return
        opacity = float(style.get("opacity", 1))
        shown = self._axes.imshow(
            pixels, extent=(x, x + width, y + height, y), aspect="auto", alpha=opacity, zorder=self._next()
        )
        shown.set_clip_on(False)
        # Fitting an image moves the limits.
        self._axes.set_autoscale_on(False)


def _number(element: ElementTree.Element, name: str) -> float:
    return float(element.get(name, 0))


def _steps(written: str) -> Iterator[tuple[Point, int]]:
    """Give the points of a path with Matplotlib's code for each: 1 moves, 2 is a line, 4 a curve, 79 closes."""
    at = start = (0.0, 0.0)
    for name, text in _COMMAND.findall(written):
        kind, numbers = name.lower(), [float(number) for number in _NUMBER.findall(text)]
        x, y = at if name.islower() else (0.0, 0.0)
        if kind == "z":
            at = start
            yield at, 79
            continue
        if kind == "h":
            points = [(x + numbers[0], at[1])]
        elif kind == "v":
            points = [(at[0], y + numbers[0])]
        else:
            points = [(x + dx, y + dy) for dx, dy in zip(numbers[::2], numbers[1::2], strict=True)]
        for point in points:
            yield point, {"m": 1, "c": 4}.get(kind, 2)
        at = points[-1]
        start = at if kind == "m" else start
