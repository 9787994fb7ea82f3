"""What does the way through the sockets cost?

The limit is one thread that sends and receives by itself, with zero-copy frames; ours goes from the user's queue through
the I/O thread into another queue, and wakes up a thread on its way.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
import zmq

import epypes as ep
from epypes.wire import Envelope
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort

ANY = "tcp://127.0.0.1:*"


def _row(effort: Effort, name: str, image: np.ndarray, rounds: int, goal: Goal | None = None) -> Row:
    # As what a function returns is: nobody can change it, so that it can be sent without a copy, as by hand.
    image.flags.writeable = False
    context = zmq.Context()
    sender, receiver = context.socket(zmq.PUB), context.socket(zmq.SUB)
    sender.bind(ANY)
    receiver.connect(sender.getsockopt_string(zmq.LAST_ENDPOINT))
    receiver.subscribe(b"")
    while not receiver.poll(10):
        sender.send(b"joined?")

    def by_hand() -> np.ndarray:
        sender.send(image, copy=False)
        frame = receiver.recv(copy=False)
        while len(frame.buffer) != image.nbytes:
            frame = receiver.recv(copy=False)
        return np.frombuffer(frame.buffer, image.dtype).reshape(image.shape)

    with ExitStack() as stack:
        contenders = {
            "by hand": by_hand,
            OURS: _hop(stack, ep.Mailbox("block", 100), image),
            f"{OURS}, SimpleQueue": _hop(stack, queue.SimpleQueue(), image),
        }
        times = effort.measure(contenders, rounds)
    sender.close(0)
    receiver.close(0)
    context.term()
    return row(name, times, goal=goal)


def _hop(stack: ExitStack, q_out: Any, image: np.ndarray) -> Callable[[], np.ndarray]:
    """Return what sends an image from a queue to a SimpleQueue."""
    q_in: queue.SimpleQueue[Any] = queue.SimpleQueue()
    publisher = stack.enter_context(ep.ZMQPublisher(ANY, q_out))
    subscriber = stack.enter_context(ep.ZMQSubscriber(publisher.address, q_in))
    subscriber.wait_joined(10)

    def hop() -> np.ndarray:
        q_out.put(Envelope(type="image", parts={"image": image}))
        return q_in.get(timeout=10).parts["image"]

    return hop


def rows(effort: Effort) -> list[Row]:
    return [
        _row(effort, "1 kB over tcp: raw frame, queue to queue", np.zeros((32, 32), np.uint8), 500),
        _row(
            effort,
            "1 MB over tcp: raw frame, queue to queue",
            np.zeros((1000, 1000), np.uint8),
            200,
            Goal("ratio", 1.3),
        ),
    ]
