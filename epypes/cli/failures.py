"""``epypes failures``: what failed in a service, and where."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.terminal import out

if TYPE_CHECKING:
    from epypes.service.failurerecord import FailureRecord


def failures(
    source: Annotated[
        str | None,
        typer.Argument(help="The bundle, or the http URL of its service; without it all failures of this machine."),
    ] = None,
    limit: Annotated[int, typer.Option(help="How many, the newest first.", min=1)] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print each failure as a line of JSON.")] = False,
) -> None:
    """List the failures that were kept; epypes replay ID runs one again."""
    from epypes.service.failuresource import failures_of

    found = failures_of(source).records(limit)
    if as_json:
        for record in found:
            out.print(json.dumps(asdict(record)), markup=False)
    elif found:
        _print_table(found)
        out.print(f"Again, in a process of its own: epypes replay {found[0].id}", markup=False)
        out.print(f"In a notebook: ep.load_failure({found[0].id!r})", markup=False)
    else:
        out.print(f"No failures of {source} were kept." if source else "No failures were kept.", markup=False)


def _print_table(records: Iterable[FailureRecord]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for column in ("id", "when", "function", "exception", "attempt", "dead letter"):
        table.add_column(column, overflow="fold", no_wrap=column == "id")
    for record in records:
        when = datetime.fromtimestamp(record.when_ns / 1e9).astimezone()
        raised = record.summary if record.kind == "raised" else f"{record.kind}: {record.summary}"
        cells = (record.id, f"{when:%Y-%m-%d %H:%M:%S}", record.function, raised[:200])
        no_event = "" if record.has_event else " (event not kept)"
        dead = ("yes" if record.dead_letter else "") + no_event
        table.add_row(*map(escape, cells), str(record.attempt), dead)
    out.print(table)
