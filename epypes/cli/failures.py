"""Commands on events that failed in a service: failures, replay."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.options import PATH, allow_option, any_source_argument, command, keys_option, seconds_option
from epypes.cli.terminal import print_table
from epypes.errors import ServiceError
from epypes.wording import without_access_key

if TYPE_CHECKING:
    from epypes.service.failures.record import FailedEvent
    from epypes.service.failures.reproduce import Reproduction

_MAX_CHARACTERS: Final = 200


@command("epypes failures services/edges", "epypes failures services/edges --follow")
@any_source_argument
@click.option("--limit", type=click.IntRange(1), default=20, help="Number of failures to list, newest first.")
@click.option("--json", "as_json", is_flag=True, help="Print each failure as one line of JSON.")
@click.option("--follow", is_flag=True, help="Print new failures when they happen, until Ctrl+C.")
@keys_option
@allow_option
def failures(
    source: str | None, limit: int, as_json: bool, follow: bool, keys: Path | None, allow: Sequence[Path] | None
) -> None:
    """List the events that failed in a service.

    epypes replay ID runs one of them again; ep.load_failure(ID) opens it in a notebook.
    """
    from epypes.service.failures.source import failures_of

    if follow:
        _follow(source, as_json, keys, allow)
        return
    found = failures_of(source).records(limit)
    if as_json:
        for record in found:
            click.echo(json.dumps(asdict(record)))
    elif found:
        _print_failures(found)
        click.echo(f"To run it again in a separate process: epypes replay {found[0].id}")
        click.echo(f"In a notebook: ep.load_failure({found[0].id!r})")
    else:
        click.echo(f"No failures of {without_access_key(source)} are stored." if source else "No failures are stored.")


def _follow(source: str | None, as_json: bool, keys: Path | None, allow: Sequence[Path] | None) -> None:
    from epypes.service.failures.source import follow_failures

    if source is None:
        raise ServiceError("", "Name the service: epypes failures --follow BUNDLE, or the http URL of the service.")
    try:
        for record in follow_failures(source, keys=keys, allow=allow):
            if record is None:
                click.echo(f"Listening for failures of {without_access_key(source)}. Ctrl+C ends it.", err=True)
            elif as_json:
                click.echo(json.dumps(asdict(record)))
            else:
                dead = ", dead letter" if record.dead_letter else ""
                what = f"{record.function}: {_describe(record)} (attempt {record.attempt}{dead})"
                click.echo(f"{record.id} {_format_time(record)} {what}")
    except KeyboardInterrupt:
        return


def _format_time(record: FailedEvent) -> str:
    when = datetime.fromtimestamp(record.when_ns / 1e9).astimezone()
    is_today = when.date() == datetime.now().astimezone().date()
    return f"{when:%H:%M:%S}" if is_today else f"{when:%Y-%m-%d %H:%M}"


def _describe(record: FailedEvent) -> str:
    summary = record.summary if record.kind == "raised" else f"{record.kind}: {record.text}"
    return summary[:_MAX_CHARACTERS]


def _print_failures(records: Sequence[FailedEvent]) -> None:
    # One line each at any width: the exception has the room that the others leave.
    columns: dict[str, dict[str, Any]] = {
        "id": {"no_wrap": True, "min_width": 14},
        "when": {"no_wrap": True, "min_width": 8},
        "function": {"no_wrap": True, "min_width": 8, "max_width": 24},
        "exception": {"no_wrap": True, "overflow": "ellipsis", "ratio": 1},
    }
    rows = [[each.id, _format_time(each), each.function, _describe(each)] for each in records]
    # Only where they tell something.
    if any(each.attempt != 1 for each in records):
        columns["attempt"] = {"justify": "right", "min_width": 7}
        rows = [[*row, str(each.attempt)] for row, each in zip(rows, records, strict=True)]
    if any(each.dead_letter for each in records):
        columns["dead\nletter"] = {"min_width": 6}
        rows = [[*row, "yes" if each.dead_letter else ""] for row, each in zip(rows, records, strict=True)]
    print_table(columns, rows)


@command("epypes replay latest services/edges --trace")
@click.argument("failure", metavar="ID", help="Id of the failure, its beginning or end, id of the event, or latest.")
@any_source_argument
@click.option("--bundle", type=PATH, help="Folder of the bundle, if it has moved.")
@seconds_option("--timeout", 30.0, "Seconds that the event may take.", least=0.001)
@click.option("--trace", is_flag=True, help="Print the full traceback.")
def replay(failure: str, source: str | None, bundle: Path | None, timeout_s: float, trace: bool) -> None:
    """Run a failed event again, in a separate process.

    The exit status is 0 only if every function succeeds now.
    """
    from epypes.service.failures.reproduce import reproduce
    from epypes.service.failures.source import bundle_of, failures_of, find_failure, path_of

    store = failures_of(source)
    record = find_failure(store, failure)
    event = store.event(record.id)
    folder, changed = bundle_of(record, bundle or path_of(source))
    if changed:
        click.echo(f"{changed}.")
    found = reproduce(record, event, folder, store.state(record.id), timeout_s=timeout_s)
    if trace:
        click.echo("\n".join(found.trace))
    click.echo(f"{record.id} {_describe_replay(record, found)}")
    if found.ending != "fine":
        sys.exit(1)


def _describe_replay(record: FailedEvent, found: Reproduction) -> str:
    if found.ending == "fine":
        return f"is fine now: no function fails. It was {record.function!r}: {record.summary}."
    if found.ending == "stuck":
        return f"is stuck: {found.message} {found.place}. The process was ended."
    if found.ending == "killed":
        return f"kills the process ({found.exception}) {found.place}."
    is_same = (found.function, found.exception) == (record.function, record.exception)
    how = "fails again" if is_same else f"fails otherwise than in the service ({record.function!r}: {record.summary})"
    message = " ".join(found.message.split())
    return f"{how}: {found.place}: {found.exception}{': ' * bool(message)}{message}"
