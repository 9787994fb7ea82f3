"""``epypes status``: what runs, in which state, and what became of its events."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from epypes.cli.source import Source, connected, is_url, state_of
from epypes.cli.terminal import out

_COUNTS = ("received", "answered", "failed", "dropped", "waiting")
_DIGITS = 12


def status(
    source: Source,
    as_json: Annotated[bool, typer.Option("--json", help="Print all that is known as JSON.")] = False,
) -> None:
    """Say in which state a running service is, where it listens, and how many events it has answered."""
    if not is_url(source) and not state_of(source).http:
        state = state_of(source)
        addresses = {"sub": state.sub, "pub": state.pub, "failures": state.failures}
        found: dict[str, Any] = {"bundle": source, "digest": state.digest, "pid": state.pid, "addresses": addresses}
    else:
        with connected(source, None) as service:
            found = service.info()
            values = service.parameters().entries
            found["parameters"] = {token: entry.get("value") for token, entry in values.items()}
    if as_json:
        out.print(json.dumps(found))
        return
    for line in _lines(found):
        out.print(line)


def _lines(found: dict[str, Any]) -> list[str]:
    reason = f" ({found['reason']})" if found.get("reason") else ""
    served = f"{found['bundle']} ({found['digest'][:_DIGITS]}), process {found['pid']}"
    lines = [f"{found.get('state', 'RUNNING')}{reason} {served}."]
    if "counts" in found:
        lines.append("Events: " + ", ".join(f"{found['counts'][name]} {name}" for name in _COUNTS) + ".")
    if found.get("parameters"):
        told = ", ".join(f"{token}={json.dumps(value)}" for token, value in found["parameters"].items())
        lines.append(f"Parameters, revision {found['revision']}: {told}")
    told = found["addresses"]
    return [*lines, f"Events at {told['sub']}, answers at {told['pub']}, failures at {told['failures']}."]
