"""Results on standard output, as tables and as JSON.

Lines are printed by `click.echo`, progress by `click.progressbar` on standard error, so that a result can be piped.
rich is imported where a table is drawn, since its import takes as long as all else.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

_MOST_JSON_NUMBERS: Final = 1_000


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


def json_of(value: Any) -> Any:
    """Return a value as JSON has it: a large array as its dtype and shape, NaN and infinity as text."""
    import numpy as np

    if isinstance(value, np.ndarray | np.generic):
        if value.dtype.kind not in "biuf" or value.size > _MOST_JSON_NUMBERS:
            return {"dtype": str(value.dtype), "shape": value.shape}
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): json_of(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_of(item) for item in value]
    is_json = value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))
    return value if is_json else str(value)
