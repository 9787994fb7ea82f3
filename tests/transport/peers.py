"""Other processes for these tests, and how they wait: publishers that can be stopped, continued and killed."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic

LOCAL = "tcp://127.0.0.1:*"
WAIT_S = 60.0


def threads() -> list[threading.Thread]:
    """Return the threads of this room that run; other rooms may have left some."""
    named = ("epypes-io", "epypes-guard", "epypes-publisher", "epypes-ordering", "epypes-decoding")
    return [
        one
        for one in threading.enumerate()
        if one.name.startswith((*named, "epypes from", "epypes brokers", "epypes peer"))
    ]


def wait_until(condition: Callable[[], object], timeout_s: float = WAIT_S) -> None:
    """Wait on an event that nobody sets, a little at a time, until a counter of another thread is right."""
    never, end_s = threading.Event(), monotonic() + timeout_s
    while not condition():
        if monotonic() > end_s:
            raise AssertionError(f"the condition did not come true within {timeout_s:g} s")
        never.wait(0.005)


@contextmanager
def process(script: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a script in a process of its own, which is killed at the end."""
    command = [sys.executable, "-W", "ignore::ResourceWarning", "-c", script, *arguments]
    started = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


def line_of(started: subprocess.Popen[str]) -> str:
    """Return the next line that a process prints."""
    return started.stdout.readline().strip()


# Prints its address; for every line "N" on its input it publishes N envelopes, numbered on.
PUBLISHER = """
import queue, sys
from epypes.transport import ZMQPublisher
from epypes.wire import Envelope
out = queue.SimpleQueue()
with ZMQPublisher(sys.argv[1], out, "t") as pub:
    print(pub.address, flush=True)
    number = 0
    for line in sys.stdin:
        for _ in range(int(line)):
            number += 1
            out.put(Envelope("x", {"n": number}, source="peer"))
"""

# Likewise over any address without a broker; it prints "joined" when a subscriber is there.
PEER_PUBLISHER = """
import sys
from epypes.transport import Publisher
from epypes.wire import Envelope
with Publisher(sys.argv[1], topic="t") as pub:
    assert pub.wait_for_subscriber(60)
    print("joined", flush=True)
    number = 0
    for line in sys.stdin:
        for _ in range(int(line)):
            number += 1
            pub.send(Envelope("x", {"n": number}, source="peer"))
"""


def publish(started: subprocess.Popen[str], count: int) -> None:
    """Have a PUBLISHER send some."""
    started.stdin.write(f"{count}\n")
    started.stdin.flush()
