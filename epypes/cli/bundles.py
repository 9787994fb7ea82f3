"""Commands that make and test a bundle: promote, verify, check."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from epypes.cli.options import (
    PATH,
    allow_option,
    bundle_argument,
    command,
    json_option,
    keys_option,
    parse_numbers,
    seconds_option,
)
from epypes.cli.services import is_url, states_of
from epypes.cli.terminal import json_of, print_table
from epypes.errors import BundleError, ReplayDiffers, ScaleError, ServiceError
from epypes.wording import counted, ended, without_access_key

if TYPE_CHECKING:
    from epypes.batch.check import CheckOutcome
    from epypes.bundle.proof.replay import ReplayReport


@command("epypes promote 01_edge_detection.ipynb --name runner --output edges --to services/edges")
@click.argument("notebook", type=PATH, help="Notebook file. It is not changed.")
@click.option("--to", type=PATH, required=True, help="Folder to write. An existing bundle is replaced.")
@click.option("--name", default="runner", help="Variable of the notebook that holds the runner or pipeline.")
@click.option("--output", multiple=True, help="Token to answer with; default: all sink tokens. May be repeated.")
@click.option(
    "--sample", multiple=True, help="Variable with one more payload, or a list of them, to record. May be repeated."
)
def promote(notebook: Path, to: Path, name: str, output: Sequence[str], sample: Sequence[str]) -> None:
    """Write the graph of a notebook to a bundle, and verify it.

    The notebook runs in a new kernel, and its payloads are recorded as samples. The bundle then computes the samples in
    fresh processes. If any token differs from what the notebook computed, the command fails.
    """
    run_promotion(notebook, to, name, output, sample)
    click.echo(f"Promoted {name!r} of {notebook} to {to}: replayed identical in fresh processes.")


def run_promotion(notebook: Path, to: Path, name: str, outputs: Sequence[str], samples: Sequence[str] = ()) -> None:
    """Promote with a progress bar."""
    from epypes.bundle.manifest import SETTINGS
    from epypes.bundle.promote import promote_notebook
    from epypes.bundle.settings import read_settings

    with click.progressbar(length=1, label="executing the notebook", file=sys.stderr) as bar:

        def on_cell(done: int, total: int) -> None:
            bar.length = total
            bar.update(done - bar.pos)

        def on_step(text: str) -> None:
            bar.label = text
            bar.render_progress()

        promote_notebook(notebook, name, to, list(outputs) or None, on_cell, on_step, list(samples))
        on_step("promoted")
    assumptions = read_settings(to / SETTINGS).assumptions()
    if assumptions:
        click.echo(f"Note: {assumptions}", err=True)


@command(
    "epypes verify services/edges",
    "epypes verify services/edges --fresh-env",
    "epypes verify services/edges --against tcp://127.0.0.1:5555,tcp://127.0.0.1:5556 --tolerance edges=1",
)
@bundle_argument
@click.option("--fresh-env", is_flag=True, help="Replay in a new virtual environment of requirements.txt.")
@click.option(
    "--run-anyway",
    is_flag=True,
    help="Run the code although files were changed, to see which tokens differ. The exit status is still 1.",
)
@click.option(
    "--against",
    default="",
    show_default=False,
    help="Running service that computes the samples instead: its addresses EVENTS,ANSWERS, its URL, or the folder of "
    "the bundle that it was started with.",
)
@click.option(
    "--tolerance",
    multiple=True,
    callback=parse_numbers,
    help="TOKEN=NUMBER: largest difference of a number that is accepted, with --against. May be repeated.",
)
@seconds_option("--timeout", 10.0, "Seconds to wait for each answer, with --against.", least=0.001)
@keys_option
@allow_option
@json_option
def verify(
    bundle: Path,
    fresh_env: bool,
    run_anyway: bool,
    against: str,
    tolerance: Mapping[str, float],
    as_json: bool,
    **options: Any,
) -> None:
    """Check that a bundle computes what the notebook computed.

    The command computes the recorded samples in a fresh process (a replay) and compares every token. The exit status is
    0 only if all tokens are identical.

    With --against, a running service computes them, in Python or in C++, and nothing of the bundle is run here.

    A bundle is code: trust it like code. If a file has changed since promotion, nothing of the bundle is run. The
    manifest shows changes; it is no signature.
    """
    from epypes.bundle import verify as verify_bundle

    if not against and (tolerance or options["keys"] or options["allow"]):
        raise click.UsageError("--tolerance, --keys and --allow are for a running service: give --against too.")
    if against and (fresh_env or run_anyway):
        raise click.UsageError("--fresh-env and --run-anyway run the bundle here: leave --against out.")
    service = f"service at {_without_secrets(against)}" if against else ""
    try:
        if against:
            report = _verify_service(bundle, against, tolerance, **options)
        else:
            report = verify_bundle(bundle, fresh_env=fresh_env, run_anyway=run_anyway)
    except BundleError as error:
        found = error.report if isinstance(error, ReplayDiffers) else None
        if as_json:
            fields = found.to_dict() if found else {"identical": False}
            click.echo(json.dumps({**fields, "bundle": str(bundle), "error": str(error)}, indent=1))
        elif found:
            click.echo(str(found))
        subject = f"The {service}" if against else str(bundle)
        raise BundleError(bundle, _describe_difference(subject, found) if found else str(error)) from error
    if as_json:
        click.echo(json.dumps({**report.to_dict(), "bundle": str(bundle)}, indent=1))
        return
    where = " in a new environment" if fresh_env else f" by the {service}" if against else ""
    click.echo(f"{bundle}: {report}{where}.")
    for note in report.notes:
        click.echo(f"Note: {note}", err=True)


def _without_secrets(against: str) -> str:
    """Return the addresses of a service without passwords, its URL without the access key, or its folder."""
    from epypes.transport.address import parse_address

    if "://" in against and not is_url(against):
        return ",".join(str(parse_address(each)) for each in against.split(",", 1))
    return without_access_key(against)


def _verify_service(bundle: Path, against: str, tolerances: Mapping[str, float], **options: Any) -> ReplayReport:
    """Verify a running service; raise ReplayDiffers if it computes something else."""
    from epypes.service import verify_service

    sub, comma, pub = against.partition(",")
    if not comma:
        if "://" in against and not is_url(against):
            raise ServiceError(bundle, "There is one address. Give both: --against EVENTS,ANSWERS")
        state = states_of(against)[0]
        sub, pub = state.sub, state.pub
    return verify_service(bundle, sub, pub, tolerances=tolerances, **options)


def _describe_difference(subject: str, report: ReplayReport) -> str:
    """Return in one line what differs, and the likely cause."""
    tokens = list(dict.fromkeys(repr(difference.token) for difference in report.differences))
    found = "it has no samples"
    if tokens:
        found = f"in {counted(len(report.differences), 'place')}, token{'s' * (len(tokens) > 1)} {', '.join(tokens)}"
    cause = f" Likely: {report.causes[0]}" if report.causes else ""
    return f"{subject} does not compute what was recorded: {found}.{cause}"


@command("epypes check services/edges cases.toml --junit report.xml")
@bundle_argument
@click.argument("cases", type=PATH, metavar="CASES.toml", help="File with the cases.")
@click.option("--junit", type=PATH, help="File to write as JUnit XML, for continuous integration.")
@json_option
def check(bundle: Path, cases: Path, junit: Path | None, as_json: bool) -> None:
    """Test a bundle on images with known results.

    The exit status is 0 only if every case passes. The cases are in a TOML file:

    \b
    [[case]]
    name = "left"                      # default: the name of its file, or its number
    inputs = {image = "left.png"}      # by free source token
    hyperparameters = {canny_lo = 90}  # those that differ in this case

    \b
    [[case.check]]
    token = "edges"                    # default: the one sink token
    expected = "left_edges.png"        # a value, or an image, .npy or .npz
    metric = "iou"                     # default: equal, if there is an expected value
    min = 0.9                          # the lowest value that passes
    max = 1.0                          # the highest value that passes

    A value that ends like an image file, .npy or .npz is read as a file; its path is relative to the TOML file.

    The metrics are equal, close, iou, count, value, mean_abs_difference and psnr. Their options are further keys of the
    check: atol and rtol (close), boxes (iou), of (count), data_range (psnr). The key name names a check. A case
    without a check passes if all functions succeed.
    """  # noqa: D301 - click keeps the lines of a paragraph that begins with it
    from epypes.batch.cases import cases_of
    from epypes.batch.check import check as check_runner
    from epypes.batch.check import require_writable
    from epypes.bundle import load

    if junit is not None:
        require_writable(junit)
    labelled = cases_of(cases)
    result = check_runner(load(bundle), labelled)
    if as_json:
        checks = [_to_json(outcome) for outcome in result.outcomes]
        found = {"bundle": str(bundle), "passed": result.passed, "cases": result.cases, "checks": checks}
        click.echo(json.dumps(found, indent=1))
    elif result.failures:
        _print_failures(result.failures)
    # After the failures are printed, since this may fail too.
    if junit is not None:
        result.to_junit(junit, f"epypes check {bundle.resolve().name}")
    if not result.passed:
        first = result.failures[0]
        reason = f"First: {first.case}, {first.check}: {ended(first.reason)}"
        raise ScaleError(f"{bundle} does not pass {cases}: {result}. {reason}")
    if not as_json:
        click.echo(f"{bundle}: {result}, {counted(len(result), 'check')} in all.")


def _to_json(outcome: CheckOutcome) -> dict[str, Any]:
    return {
        "case": outcome.case,
        "check": outcome.check,
        "token": outcome.token,
        "value": json_of(outcome.value),
        "threshold": outcome.threshold,
        "passed": outcome.passed,
        "reason": outcome.reason,
        "is_error": outcome.error_info is not None,
        "run_ms": outcome.total_ns / 1e6,
    }


def _print_failures(failures: Sequence[CheckOutcome]) -> None:
    short: dict[str, Any] = {"no_wrap": True, "min_width": 8, "max_width": 24}
    columns = {"case": short, "check": short, "must be": short, "reason": {"overflow": "fold", "ratio": 1}}
    print_table(columns, ((each.case, each.check, each.threshold, each.reason) for each in failures))
