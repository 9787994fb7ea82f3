"""The command demo: promote, verify, serve, call and compare, on a notebook."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.bundles import run_promotion
from epypes.cli.call import print_answer
from epypes.cli.options import PATH
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from epypes.service import Answer

_START_TIMEOUT_S: Final = 60.0
_STOP_TIMEOUT_S: Final = 20.0
_CALLS: Final = 5
_EPYPES: Final = (sys.executable, "-m", "epypes.cli")


@click.command()
@click.argument("notebook", type=PATH, help="Notebook with a runner.")
@click.option("--to", type=PATH, default="demo-output", help="Folder for the results.")
@click.option("--name", default="runner", help="Variable that holds the runner.")
@click.option("--output", default="edges", help="Image token of the service's answers.")
def demo(notebook: Path, to: Path, name: str, output: str) -> None:
    """Promote, verify, serve, call and compare a notebook's graph.

    The service runs in a second process and is called from a third; its answer must be what the notebook computed.
    """
    from epypes.acquisition import read_image, write_image
    from epypes.bundle import verify
    from epypes.bundle.compare import first_difference
    from epypes.bundle.load import SAMPLES, SETTINGS
    from epypes.bundle.settings import read_settings
    from epypes.wire.samples import load_sample

    to.mkdir(parents=True, exist_ok=True)
    bundle, answer_file = to / "bundle", to / f"{output}.png"
    _print_step(1, f"Execute {notebook} in a fresh kernel and promote its {name!r}")
    run_promotion(notebook, bundle, name, [output])
    _print_step(2, "Verify: replay the recorded sample in a fresh isolated process")
    click.echo(f"   {verify(bundle)}")
    settings = read_settings(bundle / SETTINGS)
    inputs, outputs = load_sample(bundle / SAMPLES / "000.npz")
    images = {token: to / f"{token}.png" for token in inputs}
    for token, file in images.items():
        write_image(file, inputs[token], settings.order(token))
    _draw(bundle, inputs, to / "graph.svg")
    _print_step(3, "Serve the bundle in a second process")
    with _serve(bundle) as ready:
        click.echo(f"   {ready}")
        _print_step(4, f"Call it from a third process, {_CALLS} times, with {', '.join(map(str, images.values()))}")
        answer = _call(bundle, images, output, answer_file)
    difference = first_difference(outputs[output], read_image(answer_file, settings.order(output)))
    _print_step(5, f"Compare {answer_file} with what the notebook computed")
    if difference:
        raise ServiceError(answer_file, f"The service's {output!r} differs from the notebook's: {difference}")
    click.echo(f"   identical: {outputs[output].size} values of {outputs[output].dtype}")
    print_answer(f"The fastest of {_CALLS} calls", answer)
    click.echo(f"Left in {to}: graph.svg, {answer_file.name}, the bundle. Next: make lab, and move the sliders.")


def _print_step(number: int, text: str) -> None:
    click.echo(f"{click.style(f'{number}/5', bold=True)} {text}")


def _draw(bundle: Path, inputs: dict[str, Any], file: Path) -> None:
    """Draw the graph with its values; without Graphviz, print what is missing."""
    from epypes.bundle import load
    from epypes.display import to_svg
    from epypes.errors import LayoutUnavailable

    try:
        file.write_text(to_svg(load(bundle).run(**inputs)), encoding="utf-8")
    except LayoutUnavailable as error:
        click.echo(f"   {error}", err=True)


@contextmanager
def _serve(bundle: Path) -> Iterator[str]:
    """Serve a bundle in a process of its own while the block runs; yield its READY line."""
    command = [*_EPYPES, "serve", str(bundle)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own command
        # Without it, a service that prints nothing would block readline for ever.
        watchdog = threading.Timer(_START_TIMEOUT_S, process.kill)
        watchdog.start()
        try:
            ready = process.stdout.readline().strip() if process.stdout else ""
            watchdog.cancel()
            if not ready.startswith("READY"):
                raise ServiceError(bundle, f"The service did not start: {ready or 'see its message above'}")
            yield ready
        finally:
            watchdog.cancel()
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _call(bundle: Path, images: dict[str, Path], output: str, file: Path) -> Answer:
    from epypes.service import Answer

    inputs = [f"{token}={path}" for token, path in images.items()]
    options = ["--out", f"{output}={file}", "--count", str(_CALLS), "--json"]
    command = [*_EPYPES, "call", str(bundle), *inputs, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own command
    if done.returncode:
        raise ServiceError(bundle, f"The call failed: {done.stderr.strip()}")
    return Answer(**json.loads(done.stdout))
