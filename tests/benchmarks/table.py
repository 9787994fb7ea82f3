"""How is what was measured shown and kept?"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path

from rich.table import Table

from tests.benchmarks import peers
from tests.benchmarks.functions import TIMED
from tests.benchmarks.row import Row, amount_text

_VERDICTS = {True: "yes", False: "[bold]no[/]", None: ""}


def as_table(rows: Sequence[Row]) -> Table:
    """Return a table of all rows: a contender's cell has its ratio to the limit and, below it, us per function."""
    others = [name for name in (TIMED, *(peer.name for peer in peers.ALL)) if _takes_part(name, rows)]
    table = Table(
        title="Medians, interleaved; limit: the same by hand; contenders: times the limit, us per function above it"
    )
    for heading in ("work", "limit", "EPypes", "ratio", "goal", "reached", *others):
        table.add_column(heading, justify="left" if heading == "work" else "right")
    for row in rows:
        table.add_row(*_cells(row), *(_beside(row, name) for name in others))
    return table


def _takes_part(name: str, rows: Sequence[Row]) -> bool:
    return any(name in row.medians_ns for row in rows)


def _cells(row: Row) -> tuple[str, ...]:
    work = f"{row.work}\n[dim]{row.note}[/]" if row.note else row.work
    goal = str(row.goal or "")
    amounts = amount_text(row.limit_ns, row.unit), amount_text(row.ours_ns, row.unit)
    return work, *amounts, _beside(row, row.ours), goal, _VERDICTS[row.reached]


def _beside(row: Row, name: str) -> str:
    ratio = row.ratio(name) if name in row.medians_ns and name != row.limit else None
    if ratio is None:
        return ""
    text = f"{ratio:.3f}" if ratio < 10 else f"{ratio:,.0f}"
    return f"{text}\n[dim]{row.us_per_function(name):.2f} us[/]" if row.functions > 1 else text


def write_json(rows: Sequence[Row], absent: Collection[str], file: Path) -> None:
    """Write every row, and the peers that were not installed."""
    file.parent.mkdir(parents=True, exist_ok=True)
    contents = {"absent_peers": sorted(absent), "rows": [row.as_dict() for row in rows]}
    file.write_text(json.dumps(contents, indent=1) + "\n")
