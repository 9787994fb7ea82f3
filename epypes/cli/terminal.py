"""Tables and progress displays.

Results go to standard output, progress to standard error, so that a result can be piped. Lines are printed by
`click.echo`; rich is imported where a table or a progress display is drawn, since its import takes as long as all else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress


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
    _console().print(table)


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a progress display while the block runs."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=_console(stderr=True)) as shown:
        yield shown


def _console(*, stderr: bool = False) -> Console:
    from rich.console import Console

    # Printed text may hold anything: a [name] or :name: in it is no markup.
    return Console(stderr=stderr, highlight=False, soft_wrap=True, markup=False, emoji=False)
