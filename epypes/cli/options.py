"""Options that several commands have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Keys = Annotated[
    Path | None,
    typer.Option("--keys", help="The .key_secret file of this side, which epypes keys makes.", show_default=False),
]
Allow = Annotated[
    list[Path] | None,
    typer.Option(
        "--allow", help="The .key file of who may talk to this side, or a folder of them; may be repeated.",
        show_default=False,
    ),
]  # fmt: skip
