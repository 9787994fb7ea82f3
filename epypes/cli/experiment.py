"""The command experiment: the paper's experiment, its table and its figures."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.options import PATH, command, seconds_option

if TYPE_CHECKING:
    from epypes.experiment import Results

_MAX_DRAWINGS: Final = 200


@command("epypes experiment --layout one --requests 100 --experiments 2 --out figures")
@click.option("--layout", default="paper", help="Processes of the nodes: paper, one or three.")
@click.option(
    "--transport",
    "transports",
    multiple=True,
    default=["zeromq"],
    help="Carrier of the messages: zeromq, dds or zenoh. Give several to compare them.",
)
@click.option("--requests", default=500, help="Number of requests in each experiment.")
@click.option("--experiments", default=5, help="Number of experiments. Each starts new processes.")
@click.option("--workers", default=1, help="Number of functions that may run at the same time.")
@click.option("--fps", default=5.0, help="Frames per second of a camera that is a file.")
@click.option(
    "--camera",
    multiple=True,
    help="Camera: image, folder, video, device number, or an address of epypes cameras. Give two.",
)
@seconds_option("--timeout", 5.0, "Seconds to wait for one answer.")
@click.option("--unsafe-pickle", is_flag=True, help="Pickle the answers, as in 2019. A pickle can run any code.")
@click.option("--out", "to", type=PATH, help="Folder for requests.csv and the Figures 14 to 16 (SVG).")
def experiment(
    layout: str,
    transports: Sequence[str],
    experiments: int,
    workers: int,
    camera: Sequence[str],
    to: Path | None,
    **options: Any,
) -> None:
    """Run the experiment of the paper, and print its times.

    The robot node sends a request, the acquisition node finds the pair of images that is closest in time, and the
    vision node matches keypoints. With --layout paper, acquisition and vision share a process; with one, all nodes run
    in this process; with three, each has its own. Without --camera the images are a stereo pair of scikit-image.

    Several transports take turns, experiment by experiment. A table then compares their trips, from a request to its
    answer, and the CPU time of all processes per request.
    """
    from epypes.experiment import run_experiment

    if to is not None:
        to.mkdir(parents=True, exist_ok=True)
    total = options["requests"] * experiments * len(transports)
    # Drawing takes the processor from what is measured: it is done between requests, and not often.
    often = {"update_min_steps": max(1, total // _MAX_DRAWINGS), "hidden": not sys.stderr.isatty()}
    results: dict[str, Results] = {}
    with click.progressbar(length=total, label=f"layout {layout}", file=sys.stderr, **often) as bar:
        options |= {"workers": workers, "cameras": [int(text) if text.isdecimal() else text for text in camera]}
        options |= {"experiments": min(experiments, 1), "progress": lambda *_: bar.update(1)}
        for transport in [*transports] * max(experiments, 1):
            found = run_experiment(layout, transport=transport, **options)
            results[transport] = results[transport] + found if transport in results else found
    if len(results) > 1:
        _print_comparison(results.values())
    for each in results.values():
        if len(results) == 1:
            _print_times(each)
        _print_failures(each)
    for transport, each in results.items():
        if to is None:
            break
        folder = to / transport if len(results) > 1 else to
        written = _write(each, folder, side_by_side=workers > 1)
        click.echo(f"Left in {folder}: {', '.join(path.name for path in written)}.")


def _print_comparison(results: Iterable[Results]) -> None:
    """Print the table that compares transports."""
    from epypes.experiment.results import comparison

    table = comparison(results)
    table.columns = table.columns.str.removesuffix("_ms").str.replace("_", " ").str.replace("cpu", "CPU per request")
    click.echo(f"Transports, in milliseconds, CPU of all processes\n{table.to_string(float_format='{:.2f}'.format)}")


def _print_times(results: Results) -> None:
    """Print the summary of the times."""
    from epypes.experiment.results import summary

    times = summary(results.table).drop(columns=["requests", "not_positive"])
    times.columns = times.columns.str.removesuffix("_ms").str.replace("paper_mode", "paper's mode")
    shown = times.to_string(float_format="{:.3f}".format, na_rep="")
    click.echo(f"Layout {results.layout} over {results.transport}, in milliseconds\n{shown}")
    click.echo(f"CPU time of all processes: {1e3 * results.cpu_s / len(results.table):.1f} ms per request")


def _print_failures(results: Results) -> None:
    """Print the requests that failed with their reasons, and what else came."""
    failures = results.table["failure"]
    for text, count in failures[failures != ""].value_counts().items():
        click.echo(f"{count} of {len(failures)} requests failed: {text}", err=True)
    for text, count in results.counts.items():
        click.echo(f"{count} x {text}", err=True)


def _write(results: Results, folder: Path, *, side_by_side: bool) -> list[Path]:
    from epypes.experiment.figures import figure_14, figure_15, figure_16

    folder.mkdir(parents=True, exist_ok=True)
    table, csv = results.table, folder / "requests.csv"
    drawn = {14: figure_14(table), 15: figure_15(table, side_by_side=side_by_side), 16: figure_16(table)}
    figures = {folder / f"figure_{number}.svg": figure for number, figure in drawn.items()}
    results.to_csv(csv)
    for path, figure in figures.items():
        figure.savefig(path, metadata={"Date": None})
    return [csv, *figures]
