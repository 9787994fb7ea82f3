"""``epypes experiment``: the paper's experiment, in one command."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import err, out, progress
from epypes.errors import ExperimentError

if TYPE_CHECKING:
    from epypes.experiment import Results

# Drawing takes the processor from what is measured: so it is done between requests, and not often.
_DRAW_EVERY_S = 0.5
_MOST_DIGITS = 100


def experiment(
    layout: Annotated[
        str,
        typer.Option(
            help="paper: acquisition and vision share a process; one: all in this process; three: a process each."
        ),
    ] = "paper",
    requests: Annotated[int, typer.Option(help="Requests in each experiment, one after another.")] = 500,
    experiments: Annotated[int, typer.Option(help="How often it is repeated, with everything started anew.")] = 5,
    workers: Annotated[int, typer.Option(help="How many functions of the graph may run at once.")] = 1,
    fps: Annotated[float, typer.Option(help="Frames per second of cameras that are files.")] = 5.0,
    camera: Annotated[
        list[str] | None,
        typer.Option(help="An image, folder or video, or the number of a device; twice. Without: scikit-image's pair."),
    ] = None,
    timeout: Annotated[float, typer.Option(help="Longest wait for one answer, in seconds.")] = 5.0,
    unsafe_pickle: Annotated[
        bool, typer.Option("--unsafe-pickle", help="Send and read pickled contents, as in 2019.")
    ] = False,
    keys: Keys = None,
    allow: Allow = None,
    to: Annotated[
        Path | None, typer.Option("--out", help="A folder for requests.csv and Figures 14, 15 and 16 as SVG.")
    ] = None,
) -> None:
    """Run the paper's experiment: a robot asks, acquisition finds the images, vision finds the keypoints."""
    from epypes.experiment import run_experiment

    if to is not None:
        _make_folder(to)
    with _shown_progress(f"layout {layout}") as on_request:
        results = run_experiment(
            layout,
            requests=requests,
            experiments=experiments,
            workers=workers,
            fps=fps,
            unsafe_pickle=unsafe_pickle,
            progress=on_request,
            cameras=[_source(text) for text in camera or ()],
            timeout_s=timeout,
            keys=keys,
            allow=allow,
        )
    _print_table(results)
    _print_problems(results)
    if to is not None:
        written = _write(results, to, side_by_side=workers > 1)
        out.print(f"Left in {to}: {', '.join(path.name for path in written)}.")


def _source(text: str) -> str | int:
    # More digits than these are no number that Python reads.
    return int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else text


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExperimentError("out", f"{folder} can't be made: {error.strerror}.") from error


@contextmanager
def _shown_progress(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress display while the block runs; yield what tells it how many requests are done."""
    with progress(auto_refresh=False, disable=not err.is_terminal) as shown:
        task = shown.add_task(f"{description}: starting", total=None)
        shown.refresh()
        last_s = 0.0

        def on_request(done: int, total: int) -> None:
            nonlocal last_s
            if monotonic() - last_s > _DRAW_EVERY_S or done == total:
                last_s = monotonic()
                shown.update(task, completed=done, total=total, description=description, refresh=True)

        try:
            yield on_request
        except BaseException:
            # What went wrong is said alone.
            shown.live.transient = True
            raise


def _print_table(results: Results) -> None:
    from rich.table import Table

    from epypes.experiment.fits import summary

    table = Table(title=f"Layout {results.layout}, in milliseconds", title_justify="left")
    table.add_column("time")
    for name in ("median", "mode", "least", "most", "paper's mode"):
        table.add_column(name, justify="right")
    for time, row in summary(results.table).iterrows():
        values = (row[f"{column}_ms"] for column in ("median", "mode", "least", "most", "paper_mode"))
        table.add_row(str(time), *map(_number, values))
    out.print(table)


def _number(value: Any) -> str:
    return "" if value != value else f"{value:.3f}"


def _print_problems(results: Results) -> None:
    """Print which requests failed and why, if any did."""
    failures = results.table["failure"]
    for text, count in failures[failures != ""].value_counts().items():
        err.print(f"{count} of {len(failures)} requests failed: {text}")
    for text, count in results.counts.items():
        err.print(f"{count} x {text}")


def _write(results: Results, folder: Path, *, side_by_side: bool) -> list[Path]:
    from epypes.experiment.figures import figure_14, figure_15, figure_16

    table, csv = results.table, folder / "requests.csv"
    drawn = {
        "figure_14": figure_14(table),
        "figure_15": figure_15(table, side_by_side=side_by_side),
        "figure_16": figure_16(table),
    }
    files = {folder / f"{name}.svg": figure for name, figure in drawn.items()}
    try:
        results.to_csv(csv)
        for path, figure in files.items():
            figure.savefig(path, metadata={"Date": None})
    except OSError as error:
        raise ExperimentError("out", f"{folder} can't be written to: {error.strerror}.") from error
    return [csv, *files]
