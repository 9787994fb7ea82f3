"""Commands that call a service: call, and demo, which makes and serves the bundle before."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.bundles import run_promotion
from epypes.cli.options import PATH, allow_option, bundle_argument, command, keys_option, seconds_option
from epypes.cli.terminal import json_of, print_table
from epypes.errors import ServiceError, UnknownName

if TYPE_CHECKING:
    from epypes.bundle.settings import Settings
    from epypes.images import Order
    from epypes.service import Answer

_CALLS: Final = 5
# What is read in a line: a homography, a line per lane, the bins of a small histogram.
_MOST_NUMBERS: Final = 24
_MOST_AXES: Final = 3
_EPYPES: Final = (sys.executable, "-m", "epypes.cli")

_address_option: Final = functools.partial(
    click.option,
    default="",
    show_default=False,
    help="Same address as for epypes serve, with the password of a broker. With --sub and --pub the service may run "
    "anywhere, also in C++.",
)


@command(
    "epypes call services/edges photo.png --out edges.png",
    "epypes call services/stereo left=l.png right=r.png --out disparity=d.npy",
)
@bundle_argument
@click.argument(
    "images",
    nargs=-1,
    required=True,
    help="Image file or number. With several inputs: TOKEN=FILE or TOKEN=NUMBER for each.",
)
@click.option(
    "--out",
    multiple=True,
    help="File to write the answer to: an image or .npy. With several outputs: TOKEN=FILE. May be repeated.",
)
@seconds_option("--timeout", 10.0, "Seconds to wait for the answer.", least=0.001)
@click.option("--count", type=click.IntRange(1), default=1, help="Number of calls; prints the times of the fastest.")
@click.option("--json", "as_json", is_flag=True, help="Print the answer as JSON, with times in nanoseconds.")
@keys_option
@allow_option
@_address_option("--sub")
@_address_option("--pub")
def call(bundle: Path, images: Sequence[str], out: Sequence[str], count: int, as_json: bool, **options: Any) -> None:
    """Send an image to a running service, and save its answer.

    Without --out the answer is printed. The service is found by the folder of its bundle.
    """
    from epypes.bundle.manifest import SETTINGS, check_manifest
    from epypes.bundle.settings import read_settings
    from epypes.images import has_colours
    from epypes.nothing import Nothing
    from epypes.service import Client

    check_manifest(bundle)
    settings = read_settings(bundle / SETTINGS)
    inputs = _by_token(images, settings.inputs, "input")
    files = _by_token(out, settings.outputs, "output")
    payload = {token: _read(text, settings.order(token)) for token, text in inputs.items()}
    coloured = [token for token, text in inputs.items() if has_colours(payload[token]) and Path(text).exists()]
    with Client(bundle, **options) as client:
        answer = min((client.call(payload) for _ in range(count)), key=lambda answer: answer.round_trip_ns)
    absent = [token for token in files if token not in answer.tokens]
    if absent:  # an f_out of the bundle's own may answer anything
        raise ServiceError(bundle, f"The answer has no {absent[0]!r}; it has: {', '.join(answer.tokens) or 'nothing'}.")
    written = {token: file for token, file in files.items() if answer.tokens[token] is not Nothing}
    for token, file in written.items():
        _write(file, answer.tokens[token], settings.order(token))
    pictures = (token for token, file in written.items() if Path(file).suffix != ".npy")
    _warn_of_assumed(settings, [*coloured, *(token for token in pictures if has_colours(answer.tokens[token]))])
    if as_json:
        shown = {token: value for token, value in answer.tokens.items() if value is not Nothing}
        tokens = {token: {"file": files[token]} if token in files else json_of(value) for token, value in shown.items()}
        click.echo(json.dumps({**asdict(replace(answer, tokens={})), "tokens": tokens}))
        return
    for token in coloured:
        click.echo(f"{token} = {inputs[token]}, read as {settings.colour(token)}")
    for token, value in answer.tokens.items():
        if value is Nothing:
            unwritten = f": {files[token]} is not written" if token in files else ""
            click.echo(f"{token} = Nothing{unwritten}")
        elif token not in files:
            click.echo(f"{token} = {_text_of(value, settings.order(token))}")
    _print_times(": ".join([str(bundle), *filter(None, [" ".join(written.values())])]), answer)


def _text_of(value: Any, order: Order, level: int = 3) -> str:
    """Return an answer as text: vectors and small matrices as their numbers, also in lists and dicts."""
    import numpy as np

    from epypes.display.previews.preview import preview

    if isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        is_short = value.ndim == 1 or (0 < value.size <= _MOST_NUMBERS and 0 < value.ndim <= _MOST_AXES)
        return _items_text(value, order, _MOST_AXES) if is_short else preview(value, order).text
    if type(value) in (list, tuple) and level:
        return _items_text(value, order, level - 1)
    if type(value) is dict and 0 < len(value) <= _MOST_NUMBERS and level:
        items = (f"{preview(key).text}: {_text_of(item, order, level - 1)}" for key, item in value.items())
        return f"{{{', '.join(items)}}}"
    return str(value) if isinstance(value, np.generic | float) else preview(value, order).text


def _items_text(values: Any, order: Order, level: int) -> str:
    """Return items in brackets, of many the first and the last ones."""
    count, half = len(values), _MOST_NUMBERS // 4
    if count <= _MOST_NUMBERS:
        return f"[{', '.join(_text_of(item, order, level) for item in values)}]"
    first, last = (", ".join(_text_of(item, order, level) for item in part) for part in (values[:half], values[-half:]))
    return f"[{first}, ..., {last}] ({count} in all)"


def _warn_of_assumed(settings: Settings, tokens: Sequence[str]) -> None:
    """Print one line if the order of the colours in a file is assumed."""
    assumed = [token for token in tokens if settings.colour(token).is_assumed]
    if assumed:
        names = ", ".join(map(repr, assumed))
        text = f"Warning: no function says the order of the colours of {names}; the file is read or written as bgr."
        click.echo(f'{text} If it is rgb, mark it in the notebook with ep.Image(order="rgb"), and promote.', err=True)


def _print_times(title: str, answer: Answer) -> None:
    """Print the times of a service's answer as a table; an f_out of the bundle's own may leave some out."""
    from epypes.display.text import duration_text

    totals = {"graph overhead": answer.overhead_ns, "run in all": answer.total_ns, "round trip": answer.round_trip_ns}
    functions = [(f"function {name}", duration_text(time)) for name, time in answer.timings_ns.items()]
    rows = [*functions, (), *((name, duration_text(time)) for name, time in totals.items() if time is not None)]
    print_table({"where": {}, "time": {"justify": "right"}}, rows, title)


def _by_token(given: Sequence[str], tokens: Sequence[str], kind: str) -> dict[str, str]:
    """Parse ``FILE`` or ``TOKEN=FILE`` arguments; ``FILE`` alone is for the one token.

    Raises
    ------
    UnknownName
        There is no such token.
    ServiceError
        An input token is missing, or has two values, or a file is not for one certain token.
    """
    found: dict[str, str] = {}
    for text in given:
        name, equals, file = text.partition("=")
        if not equals or name not in tokens:
            if equals and name.isidentifier() and not Path(text).exists():
                raise UnknownName(f"{kind} token", name, tokens, "in this bundle")
            if len(tokens) != 1:
                choices = ", ".join(f"{token}=FILE" for token in tokens)
                raise ServiceError(text, f"Which {kind} is {text!r}? Write one of: {choices}")
            name, file = tokens[0], text
        if name in found:
            many = " Many images: ep.map(ep.load(bundle), files)." if kind == "input" else ""
            raise ServiceError(
                text, f"Two values for the {kind} {name!r}: {found[name]!r} and {file!r}. Give one.{many}"
            )
        found[name] = file
    missing = [token for token in tokens if token not in found] if kind == "input" else []
    if missing:
        raise ServiceError(missing, f"Missing {kind}: {', '.join(f'{token}=FILE' for token in missing)}")
    return found


def _read(text: str, order: Order) -> Any:
    """Return the image of a file; or the value of JSON: a number, true, false, null, a list or a quoted text."""
    from epypes.acquisition import read_image

    if not Path(text).exists():
        with suppress(ValueError):
            return json.loads(text)
    return read_image(text, order)


def _write(file: str, value: Any, order: Order) -> None:
    import numpy as np

    from epypes.acquisition import write_image

    if Path(file).suffix == ".npy":
        try:
            np.save(file, value, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise ServiceError(file, f"{file} can't be written: {error}.") from error
    elif isinstance(value, np.ndarray):
        write_image(file, value, order)
    else:
        kind = type(value).__name__
        raise ServiceError(file, f"The answer is of type {kind}, not an image. Leave out --out to print it.")


@command("epypes demo 01_edge_detection.ipynb --output edges")
@click.argument("notebook", type=PATH, help="Notebook file. It is not changed.")
@click.option("--to", type=PATH, default="demo-output", help="Folder to write the results to.")
@click.option("--name", default="runner", help="Variable of the notebook that holds the runner.")
@click.option("--output", default="edges", help="Token to answer with; its value is an image.")
def demo(notebook: Path, to: Path, name: str, output: str) -> None:
    """Go the whole way once: promote, verify, serve and call.

    The service runs in a second process and is called from a third. If its answer differs from what the notebook
    computed, the command fails.
    """
    from epypes.acquisition import read_image, write_image
    from epypes.bundle import verify
    from epypes.bundle.manifest import SAMPLES, SETTINGS
    from epypes.bundle.proof.compare import first_difference
    from epypes.bundle.settings import read_settings
    from epypes.wire.samples import load_sample

    to.mkdir(parents=True, exist_ok=True)
    bundle, answer_file = to / "bundle", to / f"{output}.png"
    _print_step(1, f"Execute {notebook} in a fresh kernel and promote its {name!r}")
    run_promotion(notebook, bundle, name, [output])
    _print_step(2, "Verify: replay the recorded sample in a fresh isolated process")
    click.echo(f"   {verify(bundle)}")
    settings = read_settings(bundle / SETTINGS)
    recorded, outputs = load_sample(bundle / SAMPLES / "000.npz")
    images = {token: to / f"{token}.png" for token in recorded}
    for token, file in images.items():
        write_image(file, recorded[token], settings.order(token))
    _draw(bundle, recorded, to / "graph.svg")
    _print_step(3, "Serve the bundle in a second process")
    with _serve(bundle) as ready:
        click.echo(f"   {ready}")
        _print_step(4, f"Call it from a third process, {_CALLS} times, with {', '.join(map(str, images.values()))}")
        inputs = [f"{token}={path}" for token, path in images.items()]
        command = [*_EPYPES, "call", str(bundle), *inputs, "--out", f"{output}={answer_file}", "--count", str(_CALLS)]
        if subprocess.run(command, check=False).returncode:  # noqa: S603 - our own command
            raise ServiceError(bundle, "The call failed: see its message above.")
    difference = first_difference(outputs[output], read_image(answer_file, settings.order(output)))
    _print_step(5, f"Compare {answer_file} with what the notebook computed")
    if difference:
        raise ServiceError(answer_file, f"The service's {output!r} differs from the notebook's: {difference}")
    click.echo(f"   identical: {outputs[output].size} values of {outputs[output].dtype}")
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
    with subprocess.Popen([*_EPYPES, "serve", str(bundle)], stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own command
        try:
            ready = process.stdout.readline().strip() if process.stdout else ""
            if not ready.startswith("READY"):
                raise ServiceError(bundle, f"The service did not start: {ready or 'see its message above'}")
            yield ready
        finally:
            # It drains in bounded time.
            process.terminate()
