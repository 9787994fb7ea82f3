"""``epypes verify``: does a bundle compute what was recorded?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from epypes.cli.terminal import out


def verify(bundle: Annotated[Path, typer.Argument(help="The folder of the bundle.")]) -> None:
    """Replay a bundle's samples in a fresh isolated process; exit 0 only if every token is identical."""
    from epypes.bundle import verify as verify_bundle

    report = verify_bundle(bundle)
    out.print(f"{bundle}: {report}.")
