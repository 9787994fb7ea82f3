"""Which running service does a command mean?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.errors import KeysError, ServiceError

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.service.state import ServiceState

Source = Annotated[str, typer.Argument(help="The bundle that is served, or the http URL of its service.")]
TokenFile = Annotated[
    Path | None, typer.Option(help="The file with its token; EPYPES_TOKEN, or that of this user's service if left out.")
]


def is_url(source: str) -> bool:
    """Whether a source is the address of a service, and no path."""
    return source.startswith(("http://", "https://"))


def state_of(source: str) -> ServiceState:
    """Return what a running service of this user's says of itself.

    Raises
    ------
    ServiceError
        None runs for this bundle, or at this address.
    """
    from epypes.service.state import read_state, running_at

    found = running_at(source) if is_url(source) else read_state(_bundle(source))
    if found is None:
        way_out = (
            "Is it another user's, or another machine's?" if is_url(source) else f"Start it: epypes serve {source}"
        )
        raise ServiceError(source, f"No service of yours runs for {source}. {way_out}")
    return found


def url_of(source: str) -> str:
    """Return where a running service is controlled.

    Raises
    ------
    ServiceError
        It does not run, or not over HTTP.
    """
    if is_url(source):
        return source
    http = state_of(source).http
    if not http:
        raise ServiceError(source, f"The service of {source} has no HTTP address. Start it with --http 127.0.0.1:8642.")
    return http


def connected(source: str, token_file: Path | None) -> Connection:
    """Return a connection to the service that is meant."""
    from epypes.service.remote.connection import connect

    return connect(url_of(source), token=None if token_file is None else _token(token_file))


def _bundle(source: str) -> Path:
    folder = Path(source)
    if not folder.is_dir():
        raise ServiceError(source, f"{source} does not exist. Name the bundle that is served, or its http URL.")
    return folder


def _token(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise KeysError(file, f"The token file {file} can't be read: {error}.") from error
