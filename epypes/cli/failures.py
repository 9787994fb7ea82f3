"""``epypes failures``: what failed in a service, and where."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import err, out
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from epypes.service.failures.record import FailedEvent

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
    from epypes.service.failures.source import failures_of

    if follow:
        _follow(source, as_json, keys, allow)
        return
    found = failures_of(source).records(limit)
    if as_json:
        for record in found:
            out.print(json.dumps(asdict(record)))
    elif found:
        _print_table(found)
        out.print(f"Again, in a process of its own: epypes replay {found[0].id}")
        out.print(f"In a notebook: ep.load_failure({found[0].id!r})")
    else:
        out.print(f"No failures of {source} were kept." if source else "No failures were kept.")


def _follow(source: str | None, as_json: bool, keys: Path | None, allow: list[Path] | None) -> None:
    """Print a line for each failure as it happens."""
    from epypes.service.failures.source import follow_failures

    if source is None:
        raise ServiceError("", "Whose failures? Say: epypes failures --follow BUNDLE, or the http URL of its service.")
    try:
        for record in follow_failures(source, keys=keys, allow=allow):
            if record is None:
                err.print(f"Listening for failures of {source}. Ctrl+C ends it.")
            elif as_json:
                out.print(json.dumps(asdict(record)))
            else:
                dead = ", dead letter" if record.dead_letter else ""
                told = f"{record.function}: {_raised(record)} (attempt {record.attempt}{dead})"
                out.print(f"{record.id} {_when(record)} {told}")
    except KeyboardInterrupt:
        return


def _when(record: FailedEvent) -> str:
    when = datetime.fromtimestamp(record.when_ns / 1e9).astimezone()
    is_today = when.date() == datetime.now().astimezone().date()
    return f"{when:%H:%M:%S}" if is_today else f"{when:%Y-%m-%d %H:%M}"


def _raised(record: FailedEvent) -> str:
    summary = record.summary if record.kind == "raised" else f"{record.kind}: {record.text}"
    return summary[:_MOST_CHARACTERS]


def _print_table(records: Sequence[FailedEvent]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    # In one line each, whatever the width: the exception gets what the others leave.
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True, expand=True)
    table.add_column("id", no_wrap=True, min_width=14)
    table.add_column("when", no_wrap=True, min_width=8)
    table.add_column("function", no_wrap=True, min_width=8, max_width=24)
    table.add_column("exception", no_wrap=True, overflow="ellipsis", ratio=1)
    # A column that has nothing to say would only take its room.
    has_attempts, has_dead = any(each.attempt != 1 for each in records), any(each.dead_letter for each in records)
    if has_attempts:
        table.add_column("attempt", justify="right", min_width=7)
    if has_dead:
        table.add_column("dead\nletter", min_width=6)
    for record in records:
        more = [str(record.attempt)] * has_attempts + ["yes" if record.dead_letter else ""] * has_dead
        table.add_row(record.id, _when(record), record.function, _raised(record), *more)
    out.print(table)
