"""Where does HTTP listen, and which names may callers use for it?"""

from __future__ import annotations

import errno
import re
import socket
import sys
from typing import Final

from epypes.errors import AddressError
from epypes.transport import is_loopback_host

_ADDRESS: Final = re.compile(
    r"(?:http://)?(?:(?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+|\*):)?(?P<port>\d{1,5}|\*)/?", re.ASCII
)
_MAX_PORT: Final = 65_535
BACKLOG: Final = 128
# Answers that nobody takes: the kernel ends the connection.
_UNTAKEN_MS: Final = 20_000
_FORMS: Final = "Write 127.0.0.1:8642, or 127.0.0.1:* for a free port."
_LOOPBACK_NAMES: Final = frozenset({"localhost", "127.0.0.1", "[::1]"})
_ANY: Final = {"*": "0.0.0.0", "0.0.0.0": "0.0.0.0", "[::]": "::"}  # noqa: S104 - bound when insecure alone


def listening(address: str, *, insecure: bool = False) -> socket.socket:
    """Return a socket that listens at ``HOST:PORT``, ``PORT`` or a URL; port 0 or ``*`` takes a free one.

    Raises
    ------
    AddressError
        It is no address, is in use or isn't this machine's, or others could reach it and it is not ``insecure``.
    """
    host, port = _parted(address)
    if not insecure and not is_loopback_host(host):
        raise AddressError(
            address,
            f"{address} can be reached from other machines, and HTTP has no encryption. Bind 127.0.0.1 and reach it "
            "through SSH (ssh -L 8642:127.0.0.1:8642 HOST), or say --insecure.",
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY where the protocol is named only; without, each answer waits 40 ms for its second half.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if sys.platform == "linux":
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNTAKEN_MS)
        listener.bind((host, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise _refusal(address, port, error) from error
    return listener


def url_of(listener: socket.socket) -> str:
    """Return the URL by which callers on this machine reach a socket."""
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104 - named, not bound
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def names_of(listener: socket.socket) -> frozenset[str] | None:
    """Return the hosts that requests may name; None if they may name any, since others know this machine by any name.

    A page of a foreign site whose name was made to mean 127.0.0.1 (DNS rebinding) still sends the site's name.
    """
    host = str(listener.getsockname()[0])
    if not is_loopback_host(host):
        return None
    return _LOOPBACK_NAMES | {f"[{host}]" if ":" in host else host}


def _parted(address: str) -> tuple[str, int]:
    found = _ADDRESS.fullmatch(address) if isinstance(address, str) else None
    if found is None:
        raise AddressError(str(address), f"{address!r:.200} is no address for HTTP. {_FORMS}")
    port = 0 if found["port"] == "*" else int(found["port"])
    if port > _MAX_PORT:
        raise AddressError(address, f"{address} has port {port}; ports go up to {_MAX_PORT}. {_FORMS}")
    host = found["host"] or "127.0.0.1"
    # A name may have several addresses; localhost means the first of them for everybody.
    return _ANY.get(host, "127.0.0.1" if host == "localhost" else host.strip("[]")), port


def _refusal(address: str, port: int, error: OSError) -> AddressError:
    if error.errno == errno.EADDRINUSE:
        text = f"port {port} is in use. Stop what uses it, or take another; 127.0.0.1:* takes a free port."
    elif error.errno == errno.EACCES:
        text = f"port {port} is the system's. Take one above 1023."
    else:
        text = f"{error.strerror or error}. {_FORMS}"
    return AddressError(address, f"HTTP can't listen at {address}: {text}")
