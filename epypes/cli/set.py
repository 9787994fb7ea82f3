"""``epypes set``: other values for the hyperparameters of a running service."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from epypes.cli.source import Source, TokenFile, connected
from epypes.cli.terminal import out
from epypes.errors import ServiceError


def set_parameters(
    source: Source,
    values: Annotated[list[str], typer.Argument(help="NAME=VALUE, as sigma=1.4 or method=sobel; all are set or none.")],
    token_file: TokenFile = None,
    replica: Annotated[
        str,
        typer.Option(
            help="Which of several services of the bundle here is told; without, the first that has --http."
            " Those that share its queue follow it."
        ),
    ] = "",
) -> None:
    """Set hyperparameters of a running service between two events, all or none; epypes deploy forgets them."""
    wanted = dict(_read(text) for text in values)
    with connected(source, token_file, replica) as service:
        before = service.parameters().entries
        now = service.set(**wanted)
    told = (f"{name} {_text(before[name])} -> {_text(now.entries[name])}" for name in wanted)
    out.print(f"SET {', '.join(told)}: revision {now.revision}.")


def _read(text: str) -> tuple[str, Any]:
    """Return name and value: JSON if it is that, else the text itself."""
    name, sign, value = text.partition("=")
    if not sign or not name:
        raise ServiceError(text, f"{text!r} sets nothing. Write NAME=VALUE, as sigma=1.4.")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _text(entry: Any) -> str:
    return json.dumps(entry.get("value"))
