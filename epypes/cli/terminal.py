"""Output of the command line.

Results go to standard output, progress to standard error, so that a result can be piped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console

if TYPE_CHECKING:
    from rich.progress import Progress

    from epypes.service import Answer

# What is printed may hold anything: a [word] or :word: in it is no markup.
_PLAIN: Final[dict[str, Any]] = {"highlight": False, "soft_wrap": True, "markup": False, "emoji": False}
out = Console(**_PLAIN)
err = Console(stderr=True, **_PLAIN)


@contextmanager
def progress(*, auto_refresh: bool = True, disable: bool = False) -> Iterator[Progress]:
    """Show a progress display while the block runs; without ``auto_refresh`` it is drawn when it is told to."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=err, auto_refresh=auto_refresh, disable=disable) as shown:
        yield shown


def failures_at(address: str, is_shown: bool) -> str:
    """Return what is said after other addresses of where failures are published; nothing where nobody asks for it."""
    return f", failures at {address}" if is_shown else ""


def print_answer(title: str, answer: Answer) -> None:
    """Print the times of a service's answer as a table."""
    from rich.table import Table

    from epypes.display.durations import duration_text

    table = Table(title=title, title_justify="left")
    table.add_column("where")
    table.add_column("time", justify="right")
    for name, duration_ns in answer.timings_ns.items():
        table.add_row(f"function {name}", duration_text(duration_ns))
    table.add_section()
    table.add_row("graph overhead", duration_text(answer.overhead_ns))
    table.add_row("run in all", duration_text(answer.total_ns))
    table.add_row("round trip", duration_text(answer.round_trip_ns))
    out.print(table)
