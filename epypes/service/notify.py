"""What is systemd told of a service? That it is ready, reloads, stops, and that it is alive.

The protocol of sd_notify(3): lines of text in a datagram to the socket that NOTIFY_SOCKET names.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from time import CLOCK_MONOTONIC, clock_gettime_ns, monotonic
from typing import Final

SOCKET: Final = "NOTIFY_SOCKET"
WATCHDOG: Final = "WATCHDOG_USEC"
_TIMEOUT_S: Final = 1.0
WATCHDOG_PID: Final = "WATCHDOG_PID"
# Not for the worker, which is no service of its own.
VARIABLES: Final = (SOCKET, WATCHDOG, WATCHDOG_PID)


def notify(*lines: str) -> bool:
    """Tell systemd; return whether there was one to be told.

    Examples
    --------
    >>> notify("READY=1", "STATUS=3 events")
    False
    """
    address = os.environ.get(SOCKET, "")
    if not address.startswith(("/", "@")):
        return False
    # One that begins with @ stands in the abstract namespace.
    target = f"\0{address[1:]}" if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            # Who does not read its datagrams must not hold the service up for long.
            sender.settimeout(_TIMEOUT_S)
            sender.sendto("\n".join(lines).encode(), target)
    except OSError:
        return False
    return True


def reloading() -> bool:
    """Tell systemd that the service reloads, until READY=1 follows."""
    return notify("RELOADING=1", f"MONOTONIC_USEC={clock_gettime_ns(CLOCK_MONOTONIC) // 1_000}")


def watchdog_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """Return how often systemd is to be told that the service is alive, in seconds; None if it does not ask.

    Examples
    --------
    >>> watchdog_s({"WATCHDOG_USEC": "30000000", "NOTIFY_SOCKET": "/run/systemd/notify"})
    15.0
    """
    for_another = environment.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid())
    micros = environment.get(WATCHDOG, "")
    if for_another or not micros.isdecimal() or not environment.get(SOCKET):
        return None
    # Half of it, as sd_watchdog_enabled(3) recommends.
    return int(micros) / 2e6 or None


class Watchdog:
    """When systemd is to be told next that the service is alive, which it does if it was asked to."""

    def __init__(self) -> None:
        self._every_s, self._told_s = watchdog_s(), 0.0

    def due_in_s(self) -> float | None:
        """Return in how many seconds that is, 0 or less if it is late; None if nobody asks."""
        return None if self._every_s is None else self._told_s + self._every_s - monotonic()

    def tell(self) -> None:
        """Tell it: that somebody comes here shows that no lock is held for ever."""
        self._told_s = monotonic()
        notify("WATCHDOG=1")
