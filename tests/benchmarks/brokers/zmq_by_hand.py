"""How does somebody use ZeroMQ with pyzmq alone: events by PUB and SUB, and answers the same way back?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import zmq

from tests.benchmarks.brokers.parties import DEADLINE_S, Meeting, keep_busy


def prepare(meeting: Meeting) -> None:
    """There is nothing to make: nobody keeps anything between two sockets."""


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""
    context = zmq.Context()
    events, answers = context.socket(zmq.SUB), context.socket(zmq.PUB)
    events.subscribe(b"")
    events.connect(meeting.events)
    answers.bind(meeting.answers)
    ready()
    while True:
        answers.send(events.recv(copy=False), copy=False)


class Asker:
    """Who asks: a socket for events and one for answers."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._context = zmq.Context()
        self._events, self._answers = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        for each in (self._events, self._answers):
            each.set_hwm(0)
        self._events.bind(meeting.events)
        self._answers.subscribe(b"")
        self._answers.connect(meeting.answers)
        while not self._answers.poll(50):  # until both have joined
            self._events.send(b"joined?")
        while self._answers.poll(200):
            self._answers.recv()

    def _receive(self) -> zmq.Frame:
        if not self._answers.poll(DEADLINE_S * 1e3):
            raise TimeoutError("Nobody answers.")
        return self._answers.recv(copy=False)

    def ask(self, image: np.ndarray) -> np.ndarray:
        self._events.send(image, copy=False)
        return np.frombuffer(self._receive().buffer, image.dtype).reshape(image.shape)

    def ask_many(self, image: np.ndarray, count: int) -> None:
        keep_busy([lambda: self._events.send(image, copy=False)], self._receive, count)

    def close(self) -> None:
        self._context.destroy(linger=0)
