"""The running service that a command is about."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epypes.errors import KeysError, ServiceError

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.service.state_file import ServiceState

Source = Annotated[str, typer.Argument(help="The bundle that is served, or the http URL of its service.")]
TokenFile = Annotated[
    Path | None, typer.Option(help="The file with its token; EPYPES_TOKEN, or that of this user's service if left out.")
]


def is_url(source: str) -> bool:
    """Whether a source is the address of a service, and no path."""
    return source.startswith(("http://", "https://"))


def state_of(source: str, replica: str = "") -> ServiceState:
    """Return what a running service of this user's says of itself; of several replicas the first one.

    Raises
    ------
    ServiceError
        None runs for this bundle, or at this address.
    """
    return states_of(source, replica)[0]


def states_of(source: str, replica: str = "") -> list[ServiceState]:
    """Return what the running services of this user's say of themselves: one, or all replicas of a bundle.

    Raises
    ------
    ServiceError
        None runs for this bundle, or at this address.
    """
    from epypes.service.state_file import read_states, running_at

    if is_url(source):
        at = running_at(source)
        found = [] if at is None else [at]
        way_out = "Is it another user's, or another machine's?"
    else:
        found, way_out = read_states(_bundle(source), replica), f"Start it: epypes serve {source}"
    if not found:
        named = f" as replica {replica!r}" if replica else ""
        raise ServiceError(source, f"No service of yours runs for {source}{named}. {way_out}")
    return found


def url_of(source: str, replica: str = "") -> str:
    """Return where a running service is controlled.

    Raises
    ------
    ServiceError
        It does not run, or not over HTTP.
    """
    if is_url(source):
        return source
    states = states_of(source, replica)
    http = next((state.http for state in states if state.http), "")
    if not http:
        raise ServiceError(source, f"The service of {source} has no HTTP address. Start it with --http 127.0.0.1:8642.")
    return http


def connected(source: str, token_file: Path | None, replica: str = "") -> Connection:
    """Return a connection to the service that is meant."""
    from epypes.service.remote.connection import connect

    return connect(url_of(source, replica), token=None if token_file is None else _token(token_file))


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
