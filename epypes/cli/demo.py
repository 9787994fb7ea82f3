"""``epypes demo``: the main job from end to end, on a notebook."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from epypes.cli.promote import run_promotion
from epypes.cli.terminal import err, out, print_answer
from epypes.errors import ServiceError

if TYPE_CHECKING:
    from epypes.service import Answer

_START_TIMEOUT_S: Final = 60.0
_STOP_TIMEOUT_S: Final = 20.0
_CALLS: Final = 5


def demo(
    notebook: Annotated[Path, typer.Argument(help="The notebook.")],
    to: Annotated[Path, typer.Option(help="The folder for the results.")] = Path("demo-output"),
    name: Annotated[str, typer.Option(help="The variable that holds the runner.")] = "runner",
    output: Annotated[str, typer.Option(help="The image token that the service answers with.")] = "edges",
) -> None:
    """Promote a notebook's graph, verify it, serve it in a second process, call it from a third, and compare."""
    from epypes.acquisition import read_image, write_image
    from epypes.bundle import verify
    from epypes.bundle.compare import first_difference
    from epypes.bundle.load import SAMPLES, SETTINGS
    from epypes.bundle.settings import read_settings
    from epypes.wire.samples import load_sample

    to.mkdir(parents=True, exist_ok=True)
    bundle, answer_file = to / "bundle", to / f"{output}.png"
    _step(1, f"Execute {notebook} in a fresh kernel and promote its {name!r}")
    run_promotion(notebook, bundle, name, [output])
    _step(2, "Verify: replay the recorded sample in a fresh isolated process")
    report = verify(bundle)
    out.print(f"   {report}")
    settings = read_settings(bundle / SETTINGS)
    inputs, outputs = load_sample(bundle / SAMPLES / "000.npz")
    images = {token: to / f"{token}.png" for token in inputs}
    for token, file in images.items():
        write_image(file, inputs[token], settings.order(token))
    _draw(bundle, inputs, to / "graph.svg")
    _step(3, "Serve the bundle in a second process")
    with _service(bundle) as ready:
        out.print(f"   {ready}")
        _step(4, f"Call it from a third process, {_CALLS} times, with {', '.join(map(str, images.values()))}")
        answer = _call(bundle, images, output, answer_file)
    difference = first_difference(outputs[output], read_image(answer_file, settings.order(output)))
    _step(5, f"Compare {answer_file} with what the notebook computed")
    if difference:
        raise ServiceError(answer_file, f"The service's {output!r} differs from the notebook's: {difference}")
    out.print(f"   identical: {outputs[output].size} values of {outputs[output].dtype}")
    print_answer(f"The fastest of {_CALLS} calls", answer)
    out.print(f"Left in {to}: graph.svg, {answer_file.name}, the bundle. Next: make lab, and move the sliders.")


def _step(number: int, text: str) -> None:
    out.print(f"{number}/5", end=" ", style="bold")
    out.print(text)


def _draw(bundle: Path, inputs: dict[str, Any], file: Path) -> None:
    """Draw the graph with its values; without Graphviz, say so and go on."""
    from epypes.bundle import load
    from epypes.display import to_svg
    from epypes.errors import LayoutUnavailable

    try:
        file.write_text(to_svg(load(bundle).run(**inputs)), encoding="utf-8")
    except LayoutUnavailable as error:
        err.print(f"   {error}")


@contextmanager
def _service(bundle: Path) -> Iterator[str]:
    """Serve a bundle in a process of its own while the block runs."""
    command = [sys.executable, "-m", "epypes.cli", "serve", str(bundle)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own command
        # A service that says nothing would hold readline for ever.
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

    arguments = [f"{token}={path}" for token, path in images.items()]
    command = [sys.executable, "-m", "epypes.cli", "call", str(bundle), *arguments]
    options = ["--out", f"{output}={file}", "--count", str(_CALLS), "--json"]
    done = subprocess.run(  # noqa: S603 - our own command
        [*command, *options], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ServiceError(bundle, f"The call failed: {done.stderr.strip()}")
    return Answer(**json.loads(done.stdout))
