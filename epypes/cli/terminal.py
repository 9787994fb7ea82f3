"""How does the command line print?

Results go to standard output, progress to standard error, so that a result can be piped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from epypes.display.view import duration_text

if TYPE_CHECKING:
    from rich.progress import Progress

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a progress display while the block runs."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=err) as shown:
        yield shown


def print_times(title: str, functions_ns: Mapping[str, int], totals_ns: Mapping[str, int]) -> None:
    """Print a table of durations: functions first, then totals."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("where")
    table.add_column("time", justify="right")
    for name, duration_ns in functions_ns.items():
        table.add_row(f"function {name}", duration_text(duration_ns))
    table.add_section()
    for name, duration_ns in totals_ns.items():
        table.add_row(name, duration_text(duration_ns))
    out.print(table)
