"""Requests that no HTTP client would send."""

from __future__ import annotations

import socket
from contextlib import contextmanager
from time import monotonic, sleep
from urllib.parse import urlsplit

DEADLINE_S = 60.0


@contextmanager
def connection(url):
    """Give a connected socket."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), DEADLINE_S) as end:
        end.settimeout(DEADLINE_S)
        yield end


def exchange(url, data):
    """Send bytes and return all that comes back until the server closes; it must close."""
    with connection(url) as end:
        end.sendall(data)
        return received(end)


def received(end):
    """Return what comes until the other side closes, or drops the connection."""
    found = b""
    try:
        while part := end.recv(65_536):
            found += part
    except ConnectionResetError:
        pass
    return found


def request(url, start, *headers, body=b""):
    """Send one request that closes its connection; return status and body."""
    host = urlsplit(url).netloc
    lines = [start, *headers]
    if not any(line.lower().startswith("host:") for line in headers):
        lines.append(f"Host: {host}")
    head = "\r\n".join([*lines, "Connection: close", "", ""]).encode("latin-1")
    answer = exchange(url, head + body)
    first, _, rest = answer.partition(b"\r\n\r\n")
    return int(first.split()[1]), rest.decode(errors="replace")


def until(condition, deadline_s=DEADLINE_S):
    """Wait until a condition holds."""
    end = monotonic() + deadline_s
    while not condition():
        assert monotonic() < end, "it did not come true in time"
        sleep(0.01)
