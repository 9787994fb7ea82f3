"""Publishes numbered events until it is told to end: ``python -m tests.service.chaos_publisher ADDRESS POISON COUNT PACE_MS``.

Each event has the parts ``number`` and ``kind``; the id says the number too. Of every POISON events one kills the process that works
on it, and another one raises. On standard output: a line when a subscriber has joined, and one with how many were sent.
"""

from __future__ import annotations

import queue
import signal
import sys
import threading

import epypes as ep
from epypes.wire import Envelope


def kind_of(number: int, poison: int) -> int:
    """Return 1 for an event that kills, 2 for one that raises, 0 for all others."""
    return {poison // 3: 1, poison // 2: 2}.get(number % poison, 0)


def main(address: str, poison: int, count: int, pace_ms: int) -> None:
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    items: queue.SimpleQueue = queue.SimpleQueue()
    with ep.ZMQPublisher(address, items, bind=False) as publisher:
        publisher.wait_for_subscriber(60)
        print("JOINED", flush=True)  # noqa: T201
        sent = 0
        while sent < count and not ended.wait(pace_ms / 1000):
            kind = kind_of(sent, poison)
            items.put(Envelope("frame", {"number": sent, "kind": kind}, id=f"event-{sent}"))
            sent += 1
    print(f"SENT {sent}", flush=True)  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
