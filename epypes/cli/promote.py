"""``epypes promote``: from a notebook file to a bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from epypes.cli.terminal import out, progress


def promote(
    notebook: Annotated[Path, typer.Argument(help="The notebook; it is executed in a new kernel and not changed.")],
    to: Annotated[Path, typer.Option(help="The folder of the bundle; a bundle that is there is replaced.")],
    name: Annotated[str, typer.Option(help="The variable that holds the runner or pipeline.")] = "runner",
    output: Annotated[
        list[str] | None, typer.Option(help="A token that the service answers with; may be repeated.")
    ] = None,
    sample: Annotated[
        list[str] | None,
        typer.Option(help="A variable that holds a further payload to record, or a list of them; may be repeated."),
    ] = None,
) -> None:
    """Execute a notebook, write its graph as a bundle, and prove that the bundle computes the same."""
    run_promotion(notebook, to, name, output, sample)
    out.print(f"Promoted {name!r} of {notebook} to {to}: replayed identical in a fresh process.")


def run_promotion(
    notebook: Path, to: Path, name: str, outputs: list[str] | None, samples: list[str] | None = None
) -> None:
    """Promote with a progress display."""
    from epypes.bundle.notebook import promote_notebook

    with progress() as shown:
        task = shown.add_task("executing the notebook", total=None)

        def on_cell(done: int, total: int) -> None:
            shown.update(task, completed=done, total=total, description="executing the notebook")

        def told(text: str) -> None:
            shown.update(task, description=text)

        promote_notebook(notebook, name, to, outputs, on_cell, told, samples or [])
        shown.update(task, description="promoted")
