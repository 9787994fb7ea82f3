"""What does the way through the sockets cost?

The limit is one thread that sends and receives by itself, with zero-copy frames; ours goes from the user's queue through
the I/O thread into another queue, and wakes up a thread on its way.
"""

from __future__ import annotations

import queue

import numpy as np
import zmq

import epypes as ep
from epypes.wire import Envelope
from tests.benchmarks.row import OURS, Row, row
from tests.benchmarks.timing import Effort

ANY = "tcp://127.0.0.1:*"


def _row(effort: Effort, name: str, image: np.ndarray, rounds: int) -> Row:
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

    q_out, q_in = queue.SimpleQueue(), queue.SimpleQueue()
    with ep.ZMQPublisher(ANY, q_out) as publisher, ep.ZMQSubscriber(publisher.address, q_in) as subscriber:
        subscriber.wait_joined(10)

        def ours() -> np.ndarray:
            q_out.put(Envelope(type="image", parts={"image": image}))
            return q_in.get(timeout=10).parts["image"]

        times = effort.measure({"by hand": by_hand, OURS: ours}, rounds)
    sender.close(0)
    receiver.close(0)
    context.term()
    return row(name, times)


def rows(effort: Effort) -> list[Row]:
    return [
        _row(effort, "1 kB over tcp: raw frame, queue to queue", np.zeros((32, 32), np.uint8), 500),
        _row(effort, "1 MB over tcp: raw frame, queue to queue", np.zeros((1000, 1000), np.uint8), 200),
    ]
