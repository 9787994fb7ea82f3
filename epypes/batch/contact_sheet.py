"""The contact sheet of a sweep or a map: the outcomes laid out by their settings, and how that looks on a page.

Rows and columns are the values of two hyperparameters; what else varies, a third one or the image, gives further
blocks. Settings that fill no such table, as random ones, stand one after another. The page is a table whose cells hold
pictures, so that a screen reader reads it as one, and it stays one where a page strips styles. It is no larger than
other pictures of a notebook: pictures become smaller first, then those at the end are left out, which the page states.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from epypes.batch.grid import identity
from epypes.batch.results import Outcome, ShownAsPage, short_text
from epypes.batch.thumbnails import Thumbnail, picture_element, smaller
from epypes.display.previews.short import float_text
from epypes.display.text import CHARACTERS, THUMBNAIL_CHARACTERS, content, fitted, size
from epypes.errors import ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Tile:
    """One outcome on a sheet.

    Attributes
    ----------
    place
        Of the outcome in the result.
    label
        The setting, as far as row, column and block do not state it.
    text
        The error, or the value where there is no picture.
    has_failed
        Whether the setting failed.
    thumbnail
        None if there is none.
    numbers
        What stands below the picture, line by line: sink tokens that are numbers or truth values, as ``"n_coins 24"``.
    """

    place: int
    label: str
    text: str
    has_failed: bool
    thumbnail: Thumbnail | None
    numbers: tuple[str, ...] = ()


Cell = tuple[Tile, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """One table of tiles: by row, by column, those of a cell. Tiles one after another are one row."""

    title: str
    rows: tuple[tuple[Cell, ...], ...]


@dataclass(frozen=True, slots=True, repr=False)
class Sheet(ShownAsPage):
    """The outcomes of a sweep or a map as pictures side by side; shows itself.

    Attributes
    ----------
    token
        Which one is shown; None if none has a picture.
    rows, columns
        The hyperparameters by which they are laid out; None for none.
    row_labels, column_labels
        Their values; without any, tiles have labels of their own.
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
        kept = {tile.place for tile in self.tiles[:most]}
        blocks = []
        for block in self.blocks:
            rows = (tuple(tuple(tile for tile in cell if tile.place in kept) for cell in row) for row in block.rows)
            blocks.append(Block(block.title, tuple(filter(any, rows))))
        return replace(self, blocks=tuple(block for block in blocks if block.rows))

    def __repr__(self) -> str:
        tiles = self.tiles
        failed = sum(tile.has_failed for tile in tiles)
        return f"<Sheet of {str(self.token)!r:.30}: {counted(len(tiles), 'outcome')}, {failed} failed>"

    def _page(self) -> str:
        return sheet_page(self)


# -- the layout -------------------------------------------------------------------------------------------------

# By hyperparameter, the label of each of its values.
_Axes = Mapping[str, Mapping[Hashable, str]]


def sheet_of(
    cg: CompGraph,
    outcomes: Sequence[Outcome],
    token: str | None = None,
    rows: str | None = None,
    columns: str | None = None,
) -> Sheet:
    """Lay out the outcomes of a sweep, or of a map, which have no settings.

    Parameters
    ----------
    cg
        The graph that was run.
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
    keys = [{name: identity(outcome.setting.get(name)) for name in axes} for outcome in outcomes]
    is_full = math.prod(map(len, axes.values())) == len({tuple(key.values()) for key in keys})
    rows, columns = _rows_and_columns(axes, is_full, rows, columns)
    is_table = (rows, columns) != (None, None)
    rest = [name for name in axes if name not in (rows, columns)]
    by_block, by_tile = (rest, []) if is_full and is_table else ([], rest)
    has_images = len({outcome.number for outcome in outcomes}) > 1

    def labels(place: int, names: Iterable[str]) -> list[str]:
        return [f"{name} {axes[name][keys[place][name]]}" for name in names]

    grouped: dict[tuple[Hashable, ...], list[int]] = {}
    for place, outcome in enumerate(outcomes):
        number = outcome.number if axes else None
        grouped.setdefault((number, *(keys[place][name] for name in by_block)), []).append(place)
    if not axes:
        grouped = {
            key: sorted(places, key=lambda place: not outcomes[place].has_failed) for key, places in grouped.items()
        }
    blocks = []
    for places in grouped.values():
        cells: dict[tuple[Hashable, ...], list[Tile]] = {}
        for place in places:
            at = (keys[place].get(rows or ""), keys[place].get(columns or "")) if is_table else (None, place)
            label = ", ".join(labels(place, by_tile)) if axes else outcomes[place].name
            cells.setdefault(at, []).append(_tile(place, outcomes[place], label, shown))
        across: Iterable[Hashable] = axes.get(columns or "", [None]) if is_table else places
        table = tuple(
            tuple(tuple(cells.get((row, column), ())) for column in across) for row in axes.get(rows or "", [None])
        )
        title = [outcomes[places[0]].name] * (has_images and bool(axes)) + labels(places[0], by_block)
        blocks.append(Block(", ".join(title), table))
    row_labels, column_labels = (tuple(axes[name].values()) if name else () for name in (rows, columns))
    return Sheet(shown, rows, columns, row_labels, column_labels, tuple(blocks))


def _axes(outcomes: Sequence[Outcome]) -> _Axes:
    """Return the hyperparameters that have more than one value; all if none has."""
    found: dict[str, dict[Hashable, str]] = {}
    for outcome in outcomes:
        for name, value in outcome.setting.items():
            of_name, key = found.setdefault(name, {}), identity(value)
            if key not in of_name:
                of_name[key] = short_text(value)
    return {name: values for name, values in found.items() if len(values) > 1} or found


def _rows_and_columns(
    axes: _Axes, is_full: bool, rows: str | None, columns: str | None
) -> tuple[str | None, str | None]:
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


def _tile(place: int, outcome: Outcome, label: str, shown: str | None) -> Tile:
    thumbnail = None if shown is None else outcome.thumbnails.get(shown)
    if outcome.error_info is not None:
        return Tile(place, label, str(outcome.error_info), True, thumbnail)
    numbers = tuple(
        f"{token} {float_text(value) if isinstance(value, float) else value}"
        for token, value in outcome.values.items()
        if token != shown and type(value) in (bool, int, float)
    )
    if thumbnail is not None:
        return Tile(place, label, thumbnail.caption, False, thumbnail, numbers)
    if shown is not None and shown in outcome.texts:
        text = outcome.texts[shown]
    elif shown is not None and shown in outcome.values:
        text = short_text(outcome.values[shown])
    else:
        text = ", ".join(f"{token} {short_text(value)}" for token, value in outcome.values.items())
    return Tile(place, label, text, False, thumbnail)


def _pictured(cg: CompGraph, outcomes: Sequence[Outcome]) -> str | None:
    """Return the last sink token that has a picture, else the last token that has one; None without any."""
    pictured = frozenset[str]().union(*(outcome.thumbnails for outcome in outcomes))
    in_order = (*cg.tokens, *cg.sink_tokens)
    return next((token for token in reversed(in_order) if token in pictured), None)


def shown_tokens(cg: CompGraph, outcomes: Iterable[Outcome]) -> tuple[str, ...]:
    """Return the tokens of which a sheet can be made, in the order of the graph: with pictures, texts or numbers."""
    found: set[str] = set()
    for outcome in outcomes:
        # A text among the values may stand for an image of which no picture was asked for.
        numbers = (token for token, value in outcome.values.items() if not isinstance(value, str))
        found.update(outcome.thumbnails, outcome.texts, numbers)
    return tuple(token for token in cg.tokens if token in found)


def _require_shown(cg: CompGraph, outcomes: Sequence[Outcome], token: str) -> str:
    cg.require_token(token)
    if token in shown_tokens(cg, outcomes) or all(outcome.has_failed for outcome in outcomes):
        return token
    pictured = dict.fromkeys(name for outcome in outcomes for name in outcome.thumbnails)
    there_are = f"There are pictures of {', '.join(pictured)}." if pictured else "There are none of any token."
    raise ScaleError(f"No pictures of {token!r} were kept. {there_are} Run it again with show=({token!r},).")


# -- the page ---------------------------------------------------------------------------------------------------

# The number of tiles at most; fewer if their texts are long.
_MOST_TILES: Final = (120, 80, 50, 25, 10, 3)
_ELEMENT_CHARACTERS: Final = 60
_LABEL_ROOM: Final = 64
_MESSAGE_ROOM: Final = 96
_TITLE_ROOM: Final = 160
_SIDE_PX: Final = 128
# Of more pictures than this each is smaller, so that they are compared at a glance, and their smaller files as sharp.
_MANY: Final = 40
_SMALL_PX: Final = 80


@functools.cache
def _style() -> str:
    rules = (Path(__file__).parent / "contact_sheet.css").read_text(encoding="utf-8")
    return f"<style>{' '.join(rules.split())}</style>"


def sheet_page(sheet: Sheet, chosen: int | None = None) -> str:
    """Return a contact sheet as HTML, within the size of other pictures; ``chosen`` is the place that is marked."""
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
    failed = sum(tile.has_failed for tile in sheet.tiles)
    token = f"{content(fitted(sheet.token, _LABEL_ROOM))}: " if sheet.token else ""
    failures = f", <b>{failed:,} failed</b>" if failed else ""
    parts = [f"<p>{token}{counted(total, 'outcome')}{failures}</p>"]
    parts += [_paint_block(shown, block, most_bytes, chosen) for block in shown.blocks]
    if len(tiles) < total:
        parts.append(
            f"<p>and {total - len(tiles):,} more, for which there is no room here: to_frame() lists all; of a sweep, "
            "sheet(rows=..., columns=...) lays them out otherwise, and pick(result) of epypes_widgets shows more.</p>"
        )
    side_px = _SIDE_PX if pictures <= _MANY else _SMALL_PX
    # Tiles without pictures are no higher than their texts.
    sizes = f"--side:{side_px}px;--tall:{side_px + 8 if pictures else 0}px"
    return f'<div class="epypes-contact" style="{sizes}">{"".join(parts)}{_style()}</div>'


def _paint_block(sheet: Sheet, block: Block, most_bytes: int, chosen: int | None) -> str:
    title = content(fitted(block.title, _TITLE_ROOM))

    def cells(tag: str, row: Iterable[Cell]) -> str:
        return "".join(_paint_cell(tag, cell, most_bytes, chosen) for cell in row)

    def heads(labels: Iterable[str], scope: str) -> str:
        return "".join(f'<th scope="{scope}">{content(fitted(label, _LABEL_ROOM))}</th>' for label in labels)

    if sheet.rows is sheet.columns is None:
        return (f"<h4>{title}</h4>" if title else "") + "".join(cells("div", row) for row in block.rows)
    # The name of the columns stands above their labels, that of the rows beside these.
    row_name, lines = heads([sheet.rows] if sheet.rows else [], "col"), []
    if sheet.columns:
        name = content(fitted(sheet.columns, _LABEL_ROOM))
        above = f'<th colspan="{len(sheet.column_labels)}" scope="colgroup">{name}</th>'
        lines.append(f"{'<td></td>' if sheet.rows else ''}{above}")
        lines.append(row_name + heads(sheet.column_labels, "col"))
    else:
        lines.append(f"{row_name}<td></td>")
    for number, row in enumerate(block.rows):
        lines.append(heads(sheet.row_labels[number : number + 1], "row") + cells("td", row))
    caption = f"<caption>{title}</caption>" if title else ""
    return f"<table>{caption}{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _paint_cell(tag: str, tiles: Cell, most_bytes: int, chosen: int | None) -> str:
    state = " failed" * any(tile.has_failed for tile in tiles) + " chosen" * any(tile.place == chosen for tile in tiles)
    painted = ""
    for tile in tiles:
        above = "✓ chosen " * (tile.place == chosen) + tile.label
        label = f"<span>{content(fitted(above, _LABEL_ROOM))}</span>" if above else ""
        picture = None if tile.thumbnail is None or tile.has_failed else smaller(tile.thumbnail, most_bytes)
        if picture is None:
            mark = "<b>failed</b> " * tile.has_failed
            painted += f"{label}<span>{mark}{content(fitted(tile.text, _MESSAGE_ROOM))}</span>"
        else:
            numbers = "".join(f"<span>{content(fitted(number, _LABEL_ROOM))}</span>" for number in tile.numbers)
            painted += f"{picture_element(picture, tile.text, _LABEL_ROOM)}{label}{numbers}"
    return f'<{tag} class="cell{state}">{painted}</{tag}>'
