"""``epypes replay``: run an event again that failed in a service."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.terminal import out

if TYPE_CHECKING:
    from epypes.service.failures.record import FailedEvent
    from epypes.service.failures.reproduce import Reproduction


def replay(
    failure: Annotated[
        str, typer.Argument(metavar="ID", help="The failure: its id, how it begins or ends, its event's id, or latest.")
    ],
    source: Annotated[
        str | None,
        typer.Argument(help="The bundle, or the http URL of its service; without it all failures of this machine."),
    ] = None,
    bundle: Annotated[
        Path | None, typer.Option(help="Where the bundle is, if it was served from another place.", show_default=False)
    ] = None,
    timeout: Annotated[float, typer.Option(help="How long the event may take, in seconds.", min=0.001)] = 30.0,
    trace: Annotated[bool, typer.Option("--trace", help="Print the whole traceback.")] = False,
) -> None:
    """Run an event that failed again, in a process of its own; exit 0 only if it is fine now."""
    from epypes.service.failures.reproduce import reproduce
    from epypes.service.failures.source import bundle_of, failures_of, find_failure, path_of

    failures = failures_of(source)
    record = find_failure(failures, failure)
    event = failures.event(record.id)
    folder, changed = bundle_of(record, bundle or path_of(source))
    if changed:
        out.print(f"{changed}.")
    found = reproduce(record, event, folder, timeout_s=timeout)
    if trace:
        out.print("\n".join(found.trace))
    out.print(_sentence(record, found))
    if found.ending != "fine":
        raise typer.Exit(1)


def _sentence(record: FailedEvent, found: Reproduction) -> str:
    """Tell what became of the event, and what that was before."""
    if found.ending == "fine":
        return f"{record.id} is fine now: no function fails. It was {record.function!r}: {record.summary}."
    if found.ending == "stuck":
        return f"{record.id} is stuck: {found.message} {found.place}. The process was ended."
    if found.ending == "killed":
        return f"{record.id} kills the process ({found.exception}) {found.place}."
    is_same = (found.function, found.exception) == (record.function, record.exception)
    how = "fails again" if is_same else f"fails otherwise than in the service ({record.function!r}: {record.summary})"
    message = " ".join(found.message.split())
    return f"{record.id} {how}: {found.place}: {found.exception}{': ' * bool(message)}{message}"
