"""A replica in code: ``python -m tests.brokers.replica SUB PUB``. It computes until its input ends.

On standard output: READY, and at the end how many events it has received and how many of them were duplicates.
"""

from __future__ import annotations

import os
import sys
from time import monotonic

import numpy as np

import epypes as ep
from epypes.wire import Envelope
from tests.brokers.traffic import KILLS, RAISES


def work(number, kind, gain):
    """Multiply; do worse where a test asks for it."""
    if kind == KILLS:
        os.kill(os.getpid(), 9)
    if kind == RAISES:
        raise ValueError(f"event {number} is spoilt")
    until_s = monotonic() + 0.002
    while monotonic() < until_s:
        pass
    return np.array([number, number * gain])


def request(event):
    return {name: event.parts[name] for name in ("number", "kind")}


def answer(pipe):
    number = int(pipe["number"])
    parts = {"result": pipe["result"], "process": os.getpid()}
    return Envelope("answer", parts, id=f"event-{number}", correlation_id=f"event-{number}")


def main(sub, pub):
    q_in, q_out = ep.Mailbox("block", size=64), ep.Mailbox("block")
    graph = ep.CompGraph({"work": work}, {"work": (("number", "kind", "gain"), "result")})
    subscriber = ep.Subscriber(sub, q_in, prefetch=4)
    # The pipeline ends first: what it has answered is acknowledged, and what it has not begun is given back.
    with (
        ep.Publisher(pub, q_out),
        subscriber,
        ep.FullPipeline("replica", graph, q_in, q_out, request, answer, {"gain": 2}),
    ):
        print("READY", flush=True)  # noqa: T201
        sys.stdin.read()
    print(subscriber.received, subscriber.duplicates, flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
