"""``epypes check``: does a bundle still do on a labelled set what it must?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from epypes.cli.terminal import out
from epypes.errors import ScaleError
from epypes.wording import counted, ended

if TYPE_CHECKING:
    from epypes.batch.check import CheckOutcome, CheckResult

_NAME_CHARACTERS: Final = 24
_MOST_ROWS: Final = 100
_KEYS: Final = """A file of cases:

\b
[[case]]
name = "left"                      # without: its file's name, or its number
inputs = {image = "left.png"}      # by free source token
hyperparameters = {canny_lo = 90}  # what differs in this case, if anything

\b
[[case.check]]
token = "edges"                    # without: the one sink token
expected = "left_edges.png"        # a value, or an image, .npy or .npz
metric = "iou"                     # without: equal if anything is expected
min = 0.9                          # the least that passes
max = 1.0                          # the most that passes

A text that ends like the name of an image, of .npy or of .npz is a file; its path is relative to that of the cases.
Metrics, with their options: equal, close (atol, rtol), iou (boxes), count (of), value, mean_abs_difference,
psnr (data_range). A check may have a name. A case without a check passes if it runs.
"""


def check(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle.")],
    cases: Annotated[Path, typer.Argument(metavar="CASES.toml", help="The file of the cases.")],
    junit: Annotated[
        Path | None, typer.Option(help="Write JUnit XML there, for continuous integration.", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print every check as JSON.")] = False,
) -> None:
    """Run a bundle on a labelled set; exit 0 only if every case passes."""
    from epypes.batch.cases import cases_of
    from epypes.batch.check import check as check_runner
    from epypes.batch.check import require_writable
    from epypes.bundle import load

    if junit is not None:
        require_writable(junit)
    labelled = cases_of(cases)
    result = check_runner(load(bundle), labelled)
    if as_json:
        out.print(json.dumps({"bundle": str(bundle), "passed": result.passed, **_fields(result)}, indent=1))
    elif result.failures:
        _print_table(result.failures)
    # What has been found is told already if this can't be written.
    if junit is not None:
        result.to_junit(junit, f"epypes check {bundle.resolve().name}")
    if not result.passed:
        first = result.failures[0]
        why = f"First: {first.case}, {first.check}: {ended(first.reason)}"
        raise ScaleError(f"{bundle} does not pass {cases}: {result}. {why}")
    if not as_json:
        out.print(f"{bundle}: {result}, {counted(len(result), 'check')} in all.")


check.__doc__ = f"{check.__doc__}\n\n{_KEYS}"


def _fields(result: CheckResult) -> dict[str, Any]:
    return {"cases": result.cases, "checks": [_plain(outcome) for outcome in result.outcomes]}


def _plain(outcome: CheckOutcome) -> dict[str, Any]:
    """Return a check as JSON has it, where infinity is a text."""
    value = outcome.value
    is_finite = value is None or abs(value) != float("inf")
    return {
        "case": outcome.case,
        "check": outcome.check,
        "token": outcome.token,
        "value": value if is_finite else str(value),
        "threshold": outcome.threshold,
        "passed": outcome.passed,
        "reason": outcome.reason,
        "is_error": outcome.error_info is not None,
        "run_ms": outcome.total_ns / 1e6,
    }


def _print_table(failures: tuple[CheckOutcome, ...]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True, expand=True)
    table.add_column("case", no_wrap=True, min_width=8, max_width=_NAME_CHARACTERS)
    table.add_column("check", no_wrap=True, min_width=8, max_width=_NAME_CHARACTERS)
    table.add_column("must be", no_wrap=True, max_width=_NAME_CHARACTERS)
    table.add_column("why it has not passed", overflow="fold", ratio=1)
    for outcome in failures[:_MOST_ROWS]:
        table.add_row(outcome.case, outcome.check, outcome.threshold, outcome.reason)
    out.print(table)
    if len(failures) > _MOST_ROWS:
        out.print(f"and {counted(len(failures) - _MOST_ROWS, 'check')} more")
