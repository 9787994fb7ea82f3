"""``epypes call``: one event to a running service, and its answer to files or the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import out, print_answer
from epypes.errors import ServiceError, UnknownName

if TYPE_CHECKING:
    from epypes.images import Order


def call(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle that is being served.")],
    images: Annotated[
        list[str], typer.Argument(help="An image file or a number; or TOKEN=FILE, TOKEN=NUMBER for each input token.")
    ],
    out_file: Annotated[
        list[str] | None, typer.Option("--out", help="The file for the output token, or TOKEN=FILE; an image or .npy.")
    ] = None,
    timeout: Annotated[float, typer.Option(help="How long to wait for the answer, in seconds.", min=0.001)] = 10.0,
    count: Annotated[int, typer.Option(help="How often to send it; the times are those of the fastest.", min=1)] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the times as JSON, in nanoseconds.")] = False,
    keys: Keys = None,
    allow: Allow = None,
    sub: Annotated[str, typer.Option(help="As of epypes serve, where a broker asks for a password.")] = "",
    pub: Annotated[str, typer.Option(help="As of epypes serve.")] = "",
) -> None:
    """Send one image, or other values, to the service of a bundle; write the answer to files and print the rest."""
    from epypes.bundle.load import SETTINGS
    from epypes.bundle.manifest import check_manifest
    from epypes.bundle.settings import read_settings
    from epypes.display.previews.preview import preview
    from epypes.service import Client

    check_manifest(bundle)
    settings = read_settings(bundle / SETTINGS)
    given = by_token(images, settings.inputs, "input")
    targets = by_token(out_file or [], settings.outputs, "output")
    payload = {token: _read(text, settings.order(token)) for token, text in given.items()}
    with Client(bundle, timeout_s=timeout, keys=keys, allow=allow, sub=sub, pub=pub) as client:
        answers = [client.call(payload) for _ in range(count)]
    answer = min(answers, key=lambda answer: answer.round_trip_ns)
    for token, file in targets.items():
        _write(file, answer.tokens[token], settings.order(token))
    for token, value in answer.tokens.items():
        if token not in targets and not as_json:
            out.print(f"{token} = {preview(value).text}")
    if as_json:
        out.print(json.dumps(asdict(replace(answer, tokens={}))))
    else:
        print_answer(" ".join([f"{bundle}:", *targets.values()]), answer)


def by_token(given: Sequence[str], tokens: Sequence[str], kind: str) -> dict[str, str]:
    """Read ``FILE`` or ``TOKEN=FILE`` arguments; a file alone is the one token's.

    Raises
    ------
    UnknownName
        There is no such token.
    ServiceError
        A token is missing, or it is not clear which one a file is for.
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
            raise ServiceError(
                text, f"Which {kind} is {text!r}? Write one of: {', '.join(f'{t}=FILE' for t in tokens)}"
            )
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
        raise ServiceError(file, f"The answer is of type {kind}, not an image. Leave out --out, and it is printed.")
