"""``epypes serve``: a bundle as a running service."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.terminal import out

if TYPE_CHECKING:
    from epypes.service.state import ServiceState

_ANY_PORT = "tcp://127.0.0.1:*"


def serve(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle.")],
    sub: Annotated[str, typer.Option(help="Where events come from; connect:ADDRESS connects.")] = _ANY_PORT,
    pub: Annotated[str, typer.Option(help="Where answers go; connect:ADDRESS connects.")] = _ANY_PORT,
    insecure: Annotated[bool, typer.Option(help="Bind addresses that other machines can reach.")] = False,
) -> None:
    """Serve a bundle between a SUB and a PUB socket, until SIGTERM or Ctrl+C."""
    from epypes.service import serve as serve_bundle

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")

    def on_ready(state: ServiceState) -> None:
        out.print(f"READY {bundle}: events at {state.sub}, answers at {state.pub}, process {state.pid}.")

    counts = serve_bundle(bundle, sub, pub, insecure=insecure, on_ready=on_ready)
    out.print("STOPPED " + ", ".join(f"{name} {count}" for name, count in counts.items()))
