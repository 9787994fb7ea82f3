"""``epypes deploy``, ``epypes rollback``: another bundle for a running service."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from epypes.cli.terminal import err, out
from epypes.errors import KeysError

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection

_Http = Annotated[str, typer.Option(help="Where the service is controlled, as http://127.0.0.1:8642.")]
_TokenFile = Annotated[
    Path | None, typer.Option(help="The file with its token; EPYPES_TOKEN, or that of this user's service if left out.")
]
_DIGITS = 12


def deploy(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle, on the service's machine.")],
    http: _Http,
    token_file: _TokenFile = None,
) -> None:
    """Have a running service replay another bundle and serve it; if it computes something else, the old one goes on."""
    with _connected(http, token_file) as service:
        before = service.info()
        err.print(f"{bundle} is replayed beside {before['bundle']}, which goes on meanwhile.")
        out.print(_told("DEPLOYED", before, service.deploy(bundle)))


def rollback(http: _Http, token_file: _TokenFile = None) -> None:
    """Have a running service serve the bundle again that it served before; twice is there and back."""
    with _connected(http, token_file) as service:
        out.print(_told("ROLLED BACK", service.info(), service.rollback()))


def _told(what: str, before: dict[str, Any], now: dict[str, Any]) -> str:
    """Return in one line what happened."""
    served, left = (f"{info['bundle']} ({info['digest'][:_DIGITS]})" for info in (now, before))
    changed = "".join(f" {line}." for line in now.get("changed", ()))
    return f"{what} {served} in place of {left}: {now['state']}.{changed}"


def _connected(http: str, token_file: Path | None) -> Connection:
    from epypes.service.remote.connection import connect

    return connect(http, token=None if token_file is None else _token(token_file))


def _token(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise KeysError(file, f"The token file {file} can't be read: {error}.") from error
