"""``epypes failures``: what failed in a service, and where."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import err, out
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from epypes.service.failurerecord import FailureRecord

_MOST_CHARACTERS: Final = 200


def failures(
    source: Annotated[
        str | None,
        typer.Argument(help="The bundle, or the http URL of its service; without it all failures of this machine."),
    ] = None,
    limit: Annotated[int, typer.Option(help="How many, the newest first.", min=1)] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print each failure as a line of JSON.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="Tell of each that happens from now on, until Ctrl+C.")] = (
        False
    ),
    keys: Keys = None,
    allow: Allow = None,
) -> None:
    """List the failures that were kept; epypes replay ID runs one again."""
    from epypes.service.failuresource import failures_of

    if follow:
        _follow(source, as_json, keys, allow)
        return
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


def _follow(source: str | None, as_json: bool, keys: Path | None, allow: list[Path] | None) -> None:
    """Print a line for each failure as it happens."""
    from epypes.service.failurenews import failures_from_now_on

    if source is None:
        raise ServiceError("", "Whose failures? Say: epypes failures --follow BUNDLE, or the http URL of its service.")
    try:
        for record in failures_from_now_on(source, keys=keys, allow=allow):
            if record is None:
                err.print(f"Listening for failures of {source}. Ctrl+C ends it.", markup=False)
            elif as_json:
                out.print(json.dumps(asdict(record)), markup=False)
            else:
                dead = ", dead letter" if record.dead_letter else ""
                told = f"{record.function}: {_raised(record)} (attempt {record.attempt}{dead})"
                out.print(f"{record.id} {_when(record)} {told}", markup=False)
    except KeyboardInterrupt:
        return


def _when(record: FailureRecord) -> str:
    return f"{datetime.fromtimestamp(record.when_ns / 1e9).astimezone():%Y-%m-%d %H:%M:%S}"


def _raised(record: FailureRecord) -> str:
    raised = record.summary if record.kind == "raised" else f"{record.kind}: {record.summary}"
    return raised[:_MOST_CHARACTERS]


def _print_table(records: Iterable[FailureRecord]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    for column in ("id", "when", "function", "exception", "attempt", "dead letter"):
        table.add_column(column, overflow="fold", no_wrap=column == "id")
    for record in records:
        cells = (record.id, _when(record), record.function, _raised(record))
        no_event = "" if record.has_event else " (event not kept)"
        dead = ("yes" if record.dead_letter else "") + no_event
        table.add_row(*map(escape, cells), str(record.attempt), dead)
    out.print(table)
