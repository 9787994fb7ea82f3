"""The command call: one event to a running service, and its answer to files or the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from epypes.cli.options import allow_option, bundle_argument, keys_option, seconds_option
from epypes.cli.terminal import print_table
from epypes.errors import ServiceError, UnknownName

if TYPE_CHECKING:
    from epypes.images import Order
    from epypes.service import Answer


@click.command()
@bundle_argument
@click.argument(
    "images", nargs=-1, required=True, help="Image file or number; or TOKEN=FILE, TOKEN=NUMBER for each input token."
)
@click.option(
    "--out", multiple=True, help="File for the output token: an image or .npy; or TOKEN=FILE; may be repeated."
)
@seconds_option("--timeout", 10.0, "Longest wait for the answer", least=0.001)
@click.option("--count", type=click.IntRange(1), default=1, help="Number of calls; the times are those of the fastest.")
@click.option("--json", "as_json", is_flag=True, help="Print the times as JSON, in nanoseconds.")
@keys_option
@allow_option
@click.option(
    "--sub",
    default="",
    show_default=False,
    help="The address given to epypes serve; if a broker wants a password.",
)
@click.option(
    "--pub",
    default="",
    show_default=False,
    help="The address given to epypes serve; if a broker wants a password.",
)
def call(bundle: Path, images: Sequence[str], out: Sequence[str], count: int, as_json: bool, **options: Any) -> None:
    """Send an image to a service, and write its answer to a file.

    Or other values: one for each input token. An answer without a file is printed.
    """
    from epypes.bundle.load import SETTINGS
    from epypes.bundle.manifest import check_manifest
    from epypes.bundle.settings import read_settings
    from epypes.display.previews.preview import preview
    from epypes.service import Client

    check_manifest(bundle)
    settings = read_settings(bundle / SETTINGS)
    inputs = _by_token(images, settings.inputs, "input")
    files = _by_token(out, settings.outputs, "output")
    payload = {token: _read(text, settings.order(token)) for token, text in inputs.items()}
    with Client(bundle, **options) as client:
        answers = [client.call(payload) for _ in range(count)]
    answer = min(answers, key=lambda answer: answer.round_trip_ns)
    for token, file in files.items():
        _write(file, answer.tokens[token], settings.order(token))
    if as_json:
        click.echo(json.dumps(asdict(replace(answer, tokens={}))))
        return
    for token, value in answer.tokens.items():
        if token not in files:
            click.echo(f"{token} = {preview(value).text}")
    print_answer(" ".join([f"{bundle}:", *files.values()]), answer)


def print_answer(title: str, answer: Answer) -> None:
    """Print the times of a service's answer as a table."""
    from epypes.display.durations import duration_text

    totals = {
        "graph overhead": answer.overhead_ns,
        "run in all": answer.total_ns,
        "round trip": answer.round_trip_ns,
    }
    functions = [(f"function {name}", duration_text(time)) for name, time in answer.timings_ns.items()]
    rows = [*functions, (), *((name, duration_text(time)) for name, time in totals.items())]
    print_table({"where": {}, "time": {"justify": "right"}}, rows, title)


def _by_token(given: Sequence[str], tokens: Sequence[str], kind: str) -> dict[str, str]:
    """Parse ``FILE`` or ``TOKEN=FILE`` arguments; ``FILE`` alone is for the one token.

    Raises
    ------
    UnknownName
        There is no such token.
    ServiceError
        An input token is missing, or a file is not for one certain token.
    """
    found: dict[str, str] = {}
    for text in given:
        name, equals, file = text.partition("=")
        if equals and name in tokens:
            found[name] = file
        elif equals and name.isidentifier() and not Path(text).exists():
            raise UnknownName(f"{kind} token", name, tokens, "in this bundle")
        elif len(tokens) == 1 and len(given) == 1:
            found[tokens[0]] = text
        else:
            choices = ", ".join(f"{token}=FILE" for token in tokens)
            raise ServiceError(text, f"Which {kind} is {text!r}? Write one of: {choices}")
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
