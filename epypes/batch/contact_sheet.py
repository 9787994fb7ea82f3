"""Where does each outcome of a sweep stand on its contact sheet?

Rows and columns are the values of two hyperparameters; what else varies, a third one or the image, gives further
blocks. Settings that fill no such table, as those drawn by chance, stand one after another.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Final

from epypes.batch.grid import identity
from epypes.batch.results import Outcome, Thumbnail
from epypes.display.limits import CHARACTERS, THUMBNAIL_CHARACTERS
from epypes.display.markup import content, escape, fitted, size
from epypes.display.previews.preview import sketch
from epypes.display.previews.raster import encode_small
from epypes.display.previews.short import reason
from epypes.display.previews.shown import Look
from epypes.errors import ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.optional import optional_import
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Tile:
    """What is shown of one outcome.

    Attributes
    ----------
    place
        Of the outcome in the result.
    label
        The setting, as far as row, column and block do not say it.
    text
        What failed, or the value where there is no picture.
    has_failed
        Whether the setting failed.
    thumbnail
        None if there is none.
    """

    place: int
    label: str
    text: str
    has_failed: bool
    thumbnail: Thumbnail | None


Cell = tuple[Tile, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """One table of tiles: by row, by column, those of a cell. What stands one after another is one row."""

    title: str
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True, slots=True)
class Sheet:
    """The outcomes of a sweep as pictures side by side; shows itself.

    Attributes
    ----------
    token
        Which one is shown; None if none has a picture.
    rows, columns
        The hyperparameters by which they are laid out; None for none.
    row_labels, column_labels
        Their values; without any, what stands one after another is labelled itself.
    blocks
        The tables.
    """

    token: str | None
    rows: str | None
    columns: str | None
    row_labels: tuple[str, ...]
    column_labels: tuple[str, ...]
    blocks: tuple[Block, ...]

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """All tiles, in reading order."""
        return tuple(tile for block in self.blocks for row in block.rows for cell in row for tile in cell)

    def first(self, most: int) -> Sheet:
        """Return the sheet with its first tiles only; rows and blocks that have none are left out."""
        return replace(self, blocks=tuple(_first_of(self.blocks, most)))

    def __repr__(self) -> str:
        tiles = self.tiles
        failed = sum(tile.has_failed for tile in tiles)
        return f"<Sheet of {str(self.token)!r:.30}: {counted(len(tiles), 'outcome')}, {failed} failed>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:

        try:
            return {"text/plain": repr(self), "text/html": page_of(self)}
        except Exception as error:  # a notebook shows the result whatever is wrong with its pictures
            return {"text/plain": f"{self!r}\n(no picture: {reason(error)})"}


def _first_of(blocks: Iterable[Block], most: int) -> Iterator[Block]:
    for block in blocks:
        rows: list[tuple[Cell, ...]] = []
        for row in block.rows:
            kept = tuple(cell if count <= most else () for count, cell in zip(_counts(row), row, strict=True))
            most -= sum(map(len, kept))
            rows += [kept] * any(kept)
        if rows:
            yield Block(block.title, tuple(rows))


def _counts(row: Iterable[Cell]) -> Iterator[int]:
    """Yield how many tiles stand in the cells up to the end of each."""
    return accumulate(len(cell) for cell in row)


def sheet_of(
    cg: CompGraph,
    outcomes: Sequence[Outcome],
    token: str | None = None,
    rows: str | None = None,
    columns: str | None = None,
) -> Sheet:
    """Lay out the outcomes of a sweep.

    Parameters
    ----------
    cg
        The graph that was swept.
    outcomes
        In the order of the grid.
    token
        Which one is shown; None: the last sink token that has a picture, else the last token that has one.
    rows, columns
        Hyperparameters that vary; None: the first two, if there is a setting for each pair of their values.

    Raises
    ------
    UnknownName
        A name is none of a token, or of a hyperparameter that was varied.
    ScaleError
        Neither pictures nor texts of the token were kept; or rows and columns are the same.
    """
    shown = _pictured(cg, outcomes) if token is None else _require_shown(cg, outcomes, token)
    axes = _axes(outcomes)
    is_full = math.prod(map(len, axes.values())) == len({_key(outcome, axes) for outcome in outcomes})
    laid = _laid_out(axes, is_full, rows, columns)
    rest = tuple(name for name in axes if name not in laid)
    has_blocks = is_full and laid != (None, None)
    plan = _Plan(axes, laid, rest if has_blocks else (), () if has_blocks else rest, shown)
    row_labels, column_labels = (tuple(axes[name].values()) if name else () for name in laid)
    return Sheet(shown, *laid, row_labels, column_labels, _blocks(outcomes, plan))


# By hyperparameter, what each of its values is called.
_Axes = Mapping[str, Mapping[Hashable, str]]


@dataclass(frozen=True, slots=True)
class _Plan:
    """What row and column say, what blocks say, and what each tile says of its setting."""

    axes: _Axes
    laid: tuple[str | None, str | None]
    by_block: tuple[str, ...]
    by_tile: tuple[str, ...]
    token: str | None


def said(value: Any) -> str:
    """Return a value in at most 30 characters."""
    return sketch(value, Look()).shown.text


def _axes(outcomes: Sequence[Outcome]) -> _Axes:
    """Return the hyperparameters that have more than one value; all if none has."""
    found: dict[str, dict[Hashable, str]] = {}
    for outcome in outcomes:
        for name, value in outcome.setting.items():
            of_name, key = found.setdefault(name, {}), identity(value)
            if key not in of_name:
                of_name[key] = said(value)
    return {name: values for name, values in found.items() if len(values) > 1} or found


def _key(outcome: Outcome, names: Sequence[str] | _Axes) -> tuple[Hashable, ...]:
    return tuple(identity(outcome.setting.get(name)) for name in names)


def _laid_out(axes: _Axes, is_full: bool, rows: str | None, columns: str | None) -> tuple[str | None, str | None]:
    for name in (rows, columns):
        if name is not None and name not in axes:
            raise UnknownName("hyperparameter", name, axes, "that this sweep has varied")
    if rows is not None and rows == columns:
        raise ScaleError(f"Rows and columns are both {rows!r}. Give two hyperparameters, or one of them.")
    left = [name for name in axes if name not in (rows, columns)] if is_full else []
    if rows is columns is None:
        return (left[0], left[1]) if len(left) > 1 else (None, None)
    other = left[0] if left else None
    return (other if rows is None else rows), (other if columns is None else columns)


def _blocks(outcomes: Sequence[Outcome], plan: _Plan) -> tuple[Block, ...]:
    has_images = len({outcome.number for outcome in outcomes}) > 1
    places: dict[tuple[Hashable, ...], list[int]] = {}
    for place, outcome in enumerate(outcomes):
        places.setdefault((outcome.number, *_key(outcome, plan.by_block)), []).append(place)
    return tuple(_block(outcomes, found, plan, has_images) for found in places.values())


def _block(outcomes: Sequence[Outcome], places: Sequence[int], plan: _Plan, has_images: bool) -> Block:
    first = outcomes[places[0]]
    title = ", ".join([first.name] * has_images + [_named(first, name, plan) for name in plan.by_block])
    if plan.laid == (None, None):
        return Block(title, (tuple((_tile(place, outcomes[place], plan),) for place in places),))
    lines = [list(plan.axes[name]) if name else [None] for name in plan.laid]
    cells: dict[tuple[Hashable, ...], list[Tile]] = {}
    for place in places:
        at = tuple(identity(outcomes[place].setting[name]) if name else None for name in plan.laid)
        cells.setdefault(at, []).append(_tile(place, outcomes[place], plan))
    rows, columns = lines
    return Block(title, tuple(tuple(tuple(cells.get((row, column), ())) for column in columns) for row in rows))


def _named(outcome: Outcome, name: str, plan: _Plan) -> str:
    return f"{name} {plan.axes[name][identity(outcome.setting[name])]}"


def _tile(place: int, outcome: Outcome, plan: _Plan) -> Tile:
    label = ", ".join(_named(outcome, name, plan) for name in plan.by_tile)
    thumbnail = None if plan.token is None else outcome.thumbnails.get(plan.token)
    if outcome.error_info is not None:
        return Tile(place, label, str(outcome.error_info), True, thumbnail)
    return Tile(place, label, thumbnail.caption if thumbnail else _told(outcome, plan.token), False, thumbnail)


def _told(outcome: Outcome, shown: str | None) -> str:
    """Return what is said of the token that is shown; if there is none of it, the values of all sink tokens."""
    if shown is not None and shown in outcome.texts:
        return outcome.texts[shown]
    if shown is not None and shown in outcome.values:
        return said(outcome.values[shown])
    return ", ".join(f"{token} {said(value)}" for token, value in outcome.values.items())


# -- which token ----------------------------------------------------------------------------------------------------


def _pictured(cg: CompGraph, outcomes: Sequence[Outcome]) -> str | None:
    """Return the last sink token that has a picture, else the last token that has one; None without any."""
    pictured = frozenset[str]().union(*(outcome.thumbnails for outcome in outcomes))
    in_order = (*cg.tokens, *cg.sink_tokens)
    return next((token for token in reversed(in_order) if token in pictured), None)


def shown_tokens(cg: CompGraph, outcomes: Iterable[Outcome]) -> tuple[str, ...]:
    """Return the tokens of which a sheet can be made, in the order of the graph: with pictures, texts or numbers."""
    found = frozenset[str]().union(*(_shown_tokens(outcome) for outcome in outcomes))
    return tuple(token for token in cg.tokens if token in found)


def _shown_tokens(outcome: Outcome) -> frozenset[str]:
    # A text among the values may stand for an image of which no picture was asked for.
    numbers = (token for token, value in outcome.values.items() if not isinstance(value, str))
    return frozenset((*outcome.thumbnails, *outcome.texts, *numbers))


def _require_shown(cg: CompGraph, outcomes: Sequence[Outcome], token: str) -> str:
    cg.require_token(token)
    complete = [outcome for outcome in outcomes if outcome.error_info is None]
    if token in shown_tokens(cg, outcomes) or not complete:
        return token
    pictured = dict.fromkeys(name for outcome in outcomes for name in outcome.thumbnails)
    there_are = f"There are pictures of {', '.join(pictured)}." if pictured else "There are none of any token."
    raise ScaleError(f"No pictures of {token!r} were kept. {there_are} Sweep again with show=({token!r},).")


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
    blocks = "".join(_paint_block(shown, block, look) for block in shown.blocks)
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


def _paint_block(sheet: Sheet, block: Block, look: _Look) -> str:
    title = content(fitted(block.title, _TITLE_ROOM))
    if sheet.rows is sheet.columns is None:
        tiles = "".join(_paint_cell("div", cell, look) for row in block.rows for cell in row)
        return (f"<h4>{title}</h4>" if title else "") + tiles
    rows = "".join(
        f"<tr>{_head(label, 'row') if sheet.rows else ''}{''.join(_paint_cell('td', cell, look) for cell in row)}</tr>"
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


def _paint_cell(tag: str, tiles: tuple[Tile, ...], look: _Look) -> str:
    state = " failed" if any(tile.has_failed for tile in tiles) else ""
    state += " chosen" if any(tile.place == look.chosen for tile in tiles) else ""
    return f'<{tag} class="cell{state}">{"".join(_paint_tile(tile, look) for tile in tiles)}</{tag}>'


def _paint_tile(tile: Tile, look: _Look) -> str:
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
