"""Which ports does a broker of the tests listen at? Some that stay its own until it listens, and while it is down."""

from __future__ import annotations

import contextlib
import random
import socket
from pathlib import Path

_FIRST = 10_000
_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")


def first_ephemeral() -> int:
    """Return from where on the system gives ports to whoever connects, or asks for any."""
    return int(_RANGE.read_text().split()[0]) if _RANGE.exists() else 32_768


def free_ports(host: str, count: int) -> list[int]:
    """Return ports of an address that are free, and that the system gives to nobody who doesn't name them.

    A port that it does give may be taken before the broker listens, by a test that runs at the same time.
    """
    found: list[int] = []
    with contextlib.ExitStack() as held:
        while len(found) < count:
            # Of the system's randomness: tests set the seed of the other, which would make all choose the same.
            port = random.SystemRandom().randrange(_FIRST, first_ephemeral())
            with contextlib.suppress(OSError):
                held.enter_context(socket.create_server((host, port)))
                found.append(port)
    return found
