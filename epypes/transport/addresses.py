"""Which addresses stay on this machine, and what is wrong with one that can't be used?"""

from __future__ import annotations

import errno
import ipaddress

from epypes.errors import AddressError

_MAX_PORT = 65_535
_FORMS = "Write tcp://127.0.0.1:5555, tcp://127.0.0.1:* (a free port), ipc:///path/to/socket or inproc://name."


def is_loopback(address: str) -> bool:
    """Return whether an address can be reached from this machine alone.

    Parameters
    ----------
    address
        Of ZeroMQ: ``"tcp://127.0.0.1:5555"``. Loopback are 127.0.0.0/8, ::1, localhost, ipc and inproc. The name of
        a network interface is not: what it stands for may change.
    """
    scheme, _, rest = address.partition("://")
    if scheme in {"ipc", "inproc"}:
        return bool(rest)
    if scheme != "tcp":
        return False
    return is_loopback_host(rest.rpartition(":")[0])


def is_loopback_host(host: str) -> bool:
    """Return whether a host, without its port, can be reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False


def check_bind(address: str, insecure: bool = False) -> None:
    """Refuse to bind where other machines could connect.

    Parameters
    ----------
    address
        The address to bind.
    insecure
        True to bind it all the same, without keys: anybody who reaches it can read and write.

    Raises
    ------
    AddressError
        If the address is no text, or is not loopback and not ``insecure``.
    """
    if not isinstance(address, str) or "://" not in address:
        raise AddressError(str(address), f"{address!r} is not an address. {_FORMS}")
    if not insecure and not is_loopback(address):
        raise AddressError(
            address,
            f"{address} can be reached from other machines, which could then read and write without keys. "
            "Bind 127.0.0.1, give keys= and allow= (epypes.transport.make_keys makes keys), or say insecure=True.",
        )


def check_port(address: str) -> None:
    """Raise AddressError for a TCP port that no machine has; ZeroMQ takes 99999 for 34463."""
    port = address.rpartition(":")[2]
    if address.startswith("tcp:") and port.isdecimal() and int(port) > _MAX_PORT:
        raise AddressError(address, f"{address} has port {port}; ports go up to {_MAX_PORT}. {_FORMS}")


def address_error(address: str, verb: str, number: int, reason: str) -> AddressError:
    """Return the error for an address that ZeroMQ refused.

    Parameters
    ----------
    address
        The address.
    verb
        ``"bound"`` or ``"connected"``.
    number
        ZeroMQ's errno.
    reason
        ZeroMQ's text.
    """
    if number == errno.EADDRINUSE:
        host, _, port = address.partition("://")[2].rpartition(":")
        what = f"port {port} of {host}" if host else "it"
        text = (
            f"{address} can't be {verb}: {what} is in use. Stop what uses it, or take another; "
            "tcp://127.0.0.1:* takes a free port."
        )
    elif number == errno.EADDRNOTAVAIL:
        text = f"{address} can't be {verb}: this machine has no such address. Take one of its own."
    else:
        text = f"{address} can't be {verb}: {reason}. {_FORMS}"
    return AddressError(address, text)
