"""``epypes verify``: does a bundle compute what was recorded?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.cli.terminal import err, out
from epypes.errors import BundleError, ReplayDiffers
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.bundle.replay import ReplayReport


def verify(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle.")],
    fresh_env: Annotated[
        bool, typer.Option("--fresh-env", help="Replay in a new environment, made from requirements.txt alone.")
    ] = False,
    run_anyway: Annotated[
        bool,
        typer.Option(
            "--run-anyway",
            help="Replay it even if its files were changed, which runs the changed code. It still exits non-zero.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole report as JSON.")] = False,
) -> None:
    """Replay a bundle's samples in a fresh isolated process; exit 0 only if every token is as it was recorded.

    A bundle is code: trust it like code. The manifest shows changes, and is no signature.

    If a file is not what the manifest says, nothing of the bundle is run.
    """
    from epypes.bundle import verify as verify_bundle

    try:
        report = verify_bundle(bundle, fresh_env=fresh_env, run_anyway=run_anyway)
    except BundleError as error:
        found = error.report if isinstance(error, ReplayDiffers) else None
        if as_json:
            fields = found.to_dict() if found else {"identical": False}
            out.print(json.dumps({**fields, "bundle": str(bundle), "error": str(error)}, indent=1))
        elif found:
            out.print(str(found))
        raise BundleError(bundle, _in_one_line(bundle, found) if found else str(error)) from error
    if as_json:
        out.print(json.dumps({**report.to_dict(), "bundle": str(bundle)}, indent=1))
        return
    where = " in a new environment" if fresh_env else ""
    out.print(f"{bundle}: {report}{where}.")
    for note in report.notes:
        err.print(f"Note: {note}")


def _in_one_line(bundle: Path, report: ReplayReport) -> str:
    """Return what differs, and what to look at first."""
    tokens = ", ".join(dict.fromkeys(repr(difference.token) for difference in report.differences))
    found = f"in {counted(len(report.differences), 'place')}, token {tokens}" if tokens else "it has no samples"
    cause = f" Likely: {report.causes[0]}" if report.causes else ""
    return f"{bundle} does not compute what was recorded: {found}.{cause}"
