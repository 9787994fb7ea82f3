"""Tables of results, on standard output.

Lines are printed by `click.echo`, progress by `click.progressbar` on standard error, so that a result can be piped.
rich is imported where a table is drawn, since its import takes as long as all else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def print_table(columns: Mapping[str, Mapping[str, Any]], rows: Iterable[Sequence[str]], title: str = "") -> None:
    """Print a table.

    Parameters
    ----------
    columns
        For each name the options of `rich.table.Column`.
    rows
        The cells of each row; an empty row draws a line.
    title
        Printed above. A table without a title is as wide as the terminal and has no frame.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    plain: dict[str, Any] = {"box": SIMPLE_HEAD, "pad_edge": False, "collapse_padding": True, "expand": True}
    table = Table(title=title, title_justify="left") if title else Table(**plain)
    for name, options in columns.items():
        table.add_column(name, **options)
    for row in rows:
        if row:
            table.add_row(*row)
        else:
            table.add_section()
    # Printed text may hold anything: a [name] or :name: in it is no markup.
    Console(highlight=False, soft_wrap=True, markup=False, emoji=False).print(table)
