"""``epypes doctor``: is this machine ready, and if not, what helps?"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from epypes.cli.terminal import out
from epypes.errors import ServiceError

_STYLES = {"ok": "green", "warning": "yellow", "failed": "red"}


def doctor(
    bundle: Annotated[Path | None, typer.Argument(help="A bundle that is to be served, or is.")] = None,
    address: Annotated[
        list[str] | None,
        typer.Option(help="Where a service is to bind: is it free? Or a broker's: is it there? May be repeated."),
    ] = None,
    keys: Annotated[list[Path] | None, typer.Option(help="A file of keys that is to be used; may be repeated.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Look at versions, ports, Graphviz, browser, keys and round-trip time; exit 1 if something failed."""
    from epypes.service.ops.doctor import examine

    checks = []
    for check in examine(bundle, addresses=address or (), keys=keys or ()):
        checks.append(check)
        if not as_json:
            style = _STYLES[check.outcome]
            out.print(f"{check.outcome:>7}", end="  ", style=style)
            out.print(f"{check.name}: {check.found}")
            if check.way_out:
                out.print(f"{'':9}{check.way_out}", style=style)
    if as_json:
        out.print(json.dumps([asdict(check) for check in checks], indent=1))
    failed = [check.name for check in checks if check.outcome == "failed"]
    if failed:
        text = f"Not ready: {', '.join(failed)}. What helps stands above, beside each."
        raise ServiceError(bundle or "this machine", text)
