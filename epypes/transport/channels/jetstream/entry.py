"""How is a NATS server entered, and what is a user told whom it does not let in?"""

from __future__ import annotations

import os
import ssl
from typing import Any, Final

from nats.aio.client import Client

from epypes.errors import BrokerError
from epypes.transport.channels.place import Place

# The library's own questions whether a server is still there: after them it would wait for a link that is cut.
_NEVER_S: Final = 10**6


def entry(place: Place, timeout_s: float, client: Client) -> dict[str, Any]:
    """Return what the client is told to connect by: once, without coming back by itself."""
    host = f"[{place.host}]" if ":" in place.host else place.host
    options: dict[str, Any] = {
        "servers": f"{'tls' if place.is_encrypted else 'nats'}://{host}:{place.port}",
        "name": "epypes",
        "allow_reconnect": False,
        "connect_timeout": timeout_s,
        "reconnect_time_wait": 0,
        "max_reconnect_attempts": 1,
        "ping_interval": _NEVER_S,
        # Nothing waits to be sent while there is no connection.
        "pending_size": 0,
    }

    def password() -> str:
        # Asked for when it is about to be sent: a server that doesn't encrypt must not get to know it.
        check_encryption(place, client)
        return place.password

    if place.user:
        options |= {"user": place.user, "password": password}
    elif place.password:
        options["token"] = password
    if place.is_encrypted or place.ca:
        options["tls"] = _trusted(place)
    return options


def check_encryption(place: Place, client: Client) -> None:
    """Raise BrokerError if a place asks for encryption, and its client's connection has none by now."""
    writer = getattr(getattr(client, "_transport", None), "_io_writer", None)
    if place.is_encrypted and (writer is None or writer.get_extra_info("ssl_object") is None):
        raise unencrypted(place)


def _trusted(place: Place) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=place.ca or None)
    except OSError as error:
        text = f"The certificates that {place} is checked by can't be read from {place.ca}: {error.strerror or error}."
        raise BrokerError(str(place), text) from error


def unreachable(place: Place, error: BaseException, timeout_s: float) -> BrokerError:
    """Return what is said to who can't connect, for what the client said."""
    if isinstance(error, BrokerError):
        return error
    return BrokerError(str(place), _refused(place, error) or f"{place} can't be reached: {_why(error, timeout_s)}.")


def _refused(place: Place, error: BaseException) -> str:
    """Return why one won't have the other; empty if that is not so."""
    if "authorization" in str(error).lower():
        who = f"the user {place.user!r} with this password" if place.user else "who has no user and password"
        return f"{place} refuses {who}. {place.refused_way_out}"
    if isinstance(error, ssl.SSLError):
        told = getattr(error, "verify_message", "") or error.reason or str(error)
        return f"{place} can't be trusted: {told}. Name the file of who has signed its certificate: ?ca=FILE."
    return ""


def _why(error: BaseException, timeout_s: float) -> str:
    if isinstance(error, ConnectionRefusedError):
        return "nobody listens there. Start nats-server, or mend the host and the port"
    if isinstance(error, TimeoutError):
        return f"no NATS server has answered within {timeout_s:g} s"
    if isinstance(error, OSError):
        # asyncio's own text for it names an address as Python writes one.
        told = os.strerror(error.errno) if error.errno is not None and error.errno > 0 else error.strerror or str(error)
        return f"{told}. See that the server runs there, and try again"
    return f"who answers there is no NATS server ({said(error)})"


def unencrypted(place: Place) -> BrokerError:
    """Return what is said to who asked for encryption, to a server that has none."""
    text = f"{place} can't be trusted: it does not encrypt. Write nats:// if all on the way may read what is sent."
    return BrokerError(str(place), text)


def refusal(place: Place, error: BaseException) -> BrokerError:
    """Return what is said to who was refused something by a server that has let him in."""
    return BrokerError(str(place), f"{place} refuses: {said(error)}.")


def said(error: BaseException) -> str:
    """Return the words of an error of the client or the server."""
    described = getattr(error, "description", None)
    return str(described or error).removeprefix("nats: ").strip("'. ") or type(error).__name__
