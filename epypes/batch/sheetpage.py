"""How does a contact sheet look on a page?

A table whose cells hold pictures, so that it is read out as one, and stays one where a page strips styles. It is no
larger than other pictures of a notebook: pictures become smaller first, then those at the end are left out, which is
said.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, replace
from typing import Final

from epypes.batch.results import Thumbnail
from epypes.batch.sheet import Block, Sheet, Tile
from epypes.display.limits import CHARACTERS, THUMBNAIL_CHARACTERS
from epypes.display.markup import content, escape, fitted, size
from epypes.display.previews.raster import encode_small
from epypes.optional import optional_import
from epypes.wording import counted

# So many tiles at most; fewer if their texts are long.
_MOST_TILES: Final = (120, 80, 50, 25, 10, 3)
# What a smaller picture shows is hardly seen.
_LEAST_BYTES: Final = 400
_ELEMENT_CHARACTERS: Final = 60
_LABEL_ROOM: Final = 64
_MESSAGE_ROOM: Final = 96
_TITLE_ROOM: Final = 160
_SIDE_PX: Final = 128
# Where there are many, so that they are compared at a glance; and what of their files is left is as sharp.
_SMALL_PX: Final = 80
_MANY: Final = 40

# Text has the colour of the page, lines and tints are mixed from it: readable on any ground.
_STYLE: Final = (
    "<style>.epypes-contact{--epypes-failed:var(--jp-error-color1,var(--vscode-errorForeground,#e5484d));"
    "font:12px var(--jp-ui-font-family,system-ui,sans-serif);overflow-x:auto;scrollbar-width:thin}"
    ".epypes-contact table{border-collapse:collapse;margin:0 0 10px;font-size:12px;width:auto}"
    ".epypes-contact caption,.epypes-contact h4{text-align:left;font-size:12px;font-weight:600;margin:0;padding:4px 0;"
    "color:inherit}"
    ".epypes-contact tr{background:none!important}"
    ".epypes-contact th{font-weight:600;text-align:center!important;padding:2px 6px;white-space:nowrap}"
    ".epypes-contact .cell{box-sizing:border-box;width:calc(var(--side) + 8px);min-width:calc(var(--side) + 8px);"
    "max-width:calc(var(--side) + 8px);height:var(--tall);padding:3px;text-align:center!important;"
    "vertical-align:top;border:1px solid #8885;white-space:normal}"
    ".epypes-contact div.cell{display:inline-block;height:auto;min-height:var(--tall);margin:0 4px 4px 0}"
    ".epypes-contact img{display:block;margin:0 auto;width:var(--side);height:var(--side);max-width:none;"
    "object-fit:contain}"
    ".epypes-contact span{display:-webkit-box;-webkit-box-orient:vertical;-webkit-line-clamp:7;overflow:hidden;"
    "overflow-wrap:anywhere;line-height:1.3;margin-top:2px}"
    ".epypes-contact b{color:var(--epypes-failed);color:color-mix(in srgb,var(--epypes-failed) 62%,currentColor)}"
    ".epypes-contact .failed{outline:2px solid var(--epypes-failed);outline-offset:-2px;background:#e5484d22;"
    "text-align:left!important}"
    ".epypes-contact .chosen{outline:3px solid var(--jp-brand-color1,#1976d2);outline-offset:-2px}</style>"
)


@dataclass(frozen=True, slots=True)
class _Look:
    """How many bytes a picture has at most, and which outcome is marked."""

    most_bytes: int
    chosen: int | None


def page_of(sheet: Sheet, chosen: int | None = None) -> str:
    """Return a contact sheet for a page, within the size of other pictures; ``chosen`` is the place that is marked."""
    page = ""
    for most in _MOST_TILES:
        page = _page(sheet, sheet.first(most), chosen)
        if size(page) <= CHARACTERS + THUMBNAIL_CHARACTERS:
            break
    return page


def _page(sheet: Sheet, shown: Sheet, chosen: int | None) -> str:
    tiles, total = shown.tiles, len(sheet.tiles)
    pictures = sum(tile.thumbnail is not None for tile in tiles)
    most_bytes = (THUMBNAIL_CHARACTERS // max(pictures, 1) - _ELEMENT_CHARACTERS) * 3 // 4
    look = _Look(most_bytes, chosen)
    blocks = "".join(_block(shown, block, look) for block in shown.blocks)
    more = f"<p>{_left_out(total - len(tiles))}</p>" if len(tiles) < total else ""
    side_px = _SIDE_PX if pictures <= _MANY else _SMALL_PX
    # Where there are but texts, tiles are no higher than these.
    sizes = f"--side:{side_px}px;--tall:{side_px + 8 if pictures else 0}px"
    return f'<div class="epypes-contact" style="{sizes}">{_heading(sheet)}{blocks}{more}{_STYLE}</div>'


def _left_out(number: int) -> str:
    return (
        f"and {number:,} more, for which there is no room here: to_frame() lists all, sheet(rows=..., columns=...) "
        "lays them out otherwise, pick(result) of epypes_widgets shows more."
    )


def _heading(sheet: Sheet) -> str:
    failed = sum(tile.has_failed for tile in sheet.tiles)
    token = f"{content(fitted(sheet.token, _LABEL_ROOM))}: " if sheet.token else ""
    failures = f", <b>{failed:,} failed</b>" if failed else ""
    return f"<p>{token}{counted(len(sheet.tiles), 'outcome')}{failures}</p>"


def _block(sheet: Sheet, block: Block, look: _Look) -> str:
    title = content(fitted(block.title, _TITLE_ROOM))
    if sheet.rows is sheet.columns is None:
        tiles = "".join(_cell("div", cell, look) for row in block.rows for cell in row)
        return (f"<h4>{title}</h4>" if title else "") + tiles
    rows = "".join(
        f"<tr>{_head(label, 'row') if sheet.rows else ''}{''.join(_cell('td', cell, look) for cell in row)}</tr>"
        for label, row in zip(sheet.row_labels or [""], block.rows, strict=False)
    )
    caption = f"<caption>{title}</caption>" if title else ""
    return f"<table>{caption}{_heads(sheet)}{rows}</table>"


def _heads(sheet: Sheet) -> str:
    """Paint the labels of the columns, below their name; that of the rows stands beside it."""
    if not sheet.columns:
        return f"<tr>{_head(sheet.rows or '', 'col')}<td></td></tr>"
    name = content(fitted(sheet.columns, _LABEL_ROOM))
    above = f'<th colspan="{len(sheet.column_labels)}" scope="colgroup">{name}</th>'
    labels = "".join(_head(label, "col") for label in sheet.column_labels)
    if not sheet.rows:
        return f"<tr>{above}</tr><tr>{labels}</tr>"
    return f"<tr><td></td>{above}</tr><tr>{_head(sheet.rows, 'col')}{labels}</tr>"


def _head(label: str, scope: str) -> str:
    return f'<th scope="{scope}">{content(fitted(label, _LABEL_ROOM))}</th>'


def _cell(tag: str, tiles: tuple[Tile, ...], look: _Look) -> str:
    state = " failed" if any(tile.has_failed for tile in tiles) else ""
    state += " chosen" if any(tile.place == look.chosen for tile in tiles) else ""
    return f'<{tag} class="cell{state}">{"".join(_tile(tile, look) for tile in tiles)}</{tag}>'


def _tile(tile: Tile, look: _Look) -> str:
    words = "✓ chosen " * (tile.place == look.chosen) + tile.label
    label = f"<span>{content(fitted(words, _LABEL_ROOM))}</span>" if words else ""
    if tile.has_failed:
        return f"{label}<span><b>failed</b> {content(fitted(tile.text, _MESSAGE_ROOM))}</span>"
    picture = None if tile.thumbnail is None else smaller(tile.thumbnail, look.most_bytes)
    if picture is None:
        return f"{label}<span>{content(fitted(tile.text, _MESSAGE_ROOM))}</span>"
    data = base64.b64encode(picture.data).decode()
    alt = escape(fitted(tile.text, _LABEL_ROOM))
    return f'<img src="data:{picture.media_type};base64,{data}" alt="{alt}" title="{alt}">{label}'


def smaller(thumbnail: Thumbnail, most_bytes: int) -> Thumbnail | None:
    """Return a picture within so many bytes; None if nothing would be seen on it."""
    if len(thumbnail.data) <= most_bytes:
        return thumbnail
    if most_bytes < _LEAST_BYTES or thumbnail.media_type == "image/svg+xml":
        return None
    with optional_import("scale"):
        from PIL import Image

    with Image.open(io.BytesIO(thumbnail.data)) as opened:
        opened.load()
        encoded = encode_small(opened, most_bytes)
    return replace(thumbnail, media_type=encoded.media_type, data=encoded.data)
