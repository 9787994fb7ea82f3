"""Notifications to systemd: ready, reloading, stopping, alive.

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
WATCHDOG_PID: Final = "WATCHDOG_PID"
# The worker, which is no service of its own, does not inherit them.
VARIABLES: Final = (SOCKET, WATCHDOG, WATCHDOG_PID)
_TIMEOUT_S: Final = 1.0


def notify(*lines: str) -> bool:
    """Send lines to systemd; return whether it expects them.

    Examples
    --------
    >>> notify("READY=1", "STATUS=3 events")
    False
    """
    address = os.environ.get(SOCKET, "")
    if not address.startswith(("/", "@")):
        return False
    # An address that begins with @ is in the abstract namespace.
    target = f"\0{address[1:]}" if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            # A reader that reads no datagrams must not block the service for long.
            sender.settimeout(_TIMEOUT_S)
            sender.sendto("\n".join(lines).encode(), target)
    except OSError:
        return False
    return True


def notify_reloading() -> bool:
    """Report that the service reloads, until READY=1 follows."""
    return notify("RELOADING=1", f"MONOTONIC_USEC={clock_gettime_ns(CLOCK_MONOTONIC) // 1_000}")


def watchdog_period_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """Return how often systemd expects a sign of life, in seconds; None if it does not.

    Examples
    --------
    >>> watchdog_period_s({"WATCHDOG_USEC": "30000000", "NOTIFY_SOCKET": "/run/systemd/notify"})
    15.0
    """
    is_for_another = environment.get(WATCHDOG_PID, str(os.getpid())) != str(os.getpid())
    micros = environment.get(WATCHDOG, "")
    if is_for_another or not micros.isdecimal() or not environment.get(SOCKET):
        return None
    # Half of it, as sd_watchdog_enabled(3) recommends.
    return int(micros) / 2e6 or None


class Watchdog:
    """When the next sign of life is due, if systemd expects any."""

    def __init__(self) -> None:
        self._period_s, self._sent_s = watchdog_period_s(), 0.0

    def due_in_s(self) -> float | None:
        """Return in how many seconds it is due, 0 or less if it is late; None if none is expected."""
        return None if self._period_s is None else self._sent_s + self._period_s - monotonic()

    def send(self) -> None:
        """Send one: that a thread comes here shows that no lock is held for ever."""
        self._sent_s = monotonic()
        notify("WATCHDOG=1")
