"""Runs every benchmark, prints a table of ratios and writes ``test-output/benchmarks.json``."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks import engine, imports, picture, sockets

out = Path("test-output")
table = Table(title="Medians of one interleaved run; 'limit' is the same work by hand")
for heading in ("work", "limit", "EPypes", "ratio", "to reach"):
    table.add_column(heading)
rows = [row for module in (imports, engine, picture, sockets) for row in module.rows()]
for row in rows:
    table.add_row(*row.cells())
Console(width=140).print(table)
out.mkdir(exist_ok=True)
(out / "benchmarks.json").write_text(json.dumps([row.as_dict() for row in rows], indent=1))
