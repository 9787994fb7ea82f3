"""How does EPypes do it: a pipeline between a subscriber and a publisher, for any address, and who asks it?"""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Callable
from contextlib import ExitStack
from threading import Event
from typing import Any

import numpy as np

import epypes as ep
from epypes.transport.address import is_broker
from epypes.wire import Envelope
from tests.benchmarks.brokers.parties import DEADLINE_S, PREFETCH, Meeting, keep_busy
from tests.benchmarks.work import passed


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""
    q_in: queue.SimpleQueue[Any] = queue.SimpleQueue()
    q_out = ep.Mailbox("block", PREFETCH)
    with (
        _publisher(meeting.answers, q_out),
        ep.FullPipeline("echo", _graph(), q_in, q_out, _f_in, _f_out),
        _subscriber(meeting.events, q_in),
    ):
        ready()
        Event().wait()


def _publisher(address: str, q_out: ep.Mailbox) -> Any:
    return ep.Publisher(address, q_out) if is_broker(address) else ep.ZMQPublisher(address, q_out)


def _subscriber(address: str, q_in: Any) -> Any:
    return ep.Subscriber(address, q_in, prefetch=PREFETCH) if is_broker(address) else ep.ZMQSubscriber(address, q_in)


def _graph() -> ep.CompGraph:
    return ep.CompGraph({"echo": passed}, {"echo": ("image", "out")})


def _f_in(event: Any) -> dict[str, Any]:
    return {"image": event.parts["image"] if isinstance(event, Envelope) else event}


def _f_out(view: Any) -> Any:
    out = view["out"]
    return out if isinstance(out, bytes) else Envelope(type="echo", parts={"out": out})


class TwinsAsker:
    """Who asks from a program of threads and queues: a subscriber takes answers, a publisher sends for each thread.

    With `is_plain` false it sends envelopes with an array, else bytes, as is done by hand.
    """

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self.is_plain = True
        self._stack = ExitStack()
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._senders = [ep.Mailbox("block", PREFETCH) for _ in range(senders)]
        for each in self._senders:
            self._stack.enter_context(_publisher(meeting.events, each))
        self._stack.enter_context(_subscriber(meeting.answers, self._answers))
        self._is_brokered = is_broker(meeting.events)
        if not self._is_brokered:
            self._join()

    def _join(self) -> None:
        """Ask until somebody answers, and wait for the answers to what was asked in vain."""
        wait_s = 0.05
        while True:
            self._senders[0].put(b"joined?")
            with contextlib.suppress(queue.Empty):
                self._answers.get(timeout=wait_s)
                break
        with contextlib.suppress(queue.Empty):
            while True:
                self._answers.get(timeout=4 * wait_s)

    def _event(self, image: np.ndarray) -> Any:
        return image.tobytes() if self.is_plain else Envelope(type="image", parts={"image": image})

    def _receive(self) -> Any:
        answer = self._answers.get(timeout=DEADLINE_S)
        if self._is_brokered:
            answer.ack()
        return answer

    def ask(self, image: np.ndarray) -> np.ndarray:
        self._senders[0].put(self._event(image))
        answer = self._receive()
        return np.frombuffer(answer, image.dtype).reshape(image.shape) if self.is_plain else answer.parts["out"]

    def ask_many(self, image: np.ndarray, count: int) -> None:
        def sending(mailbox: ep.Mailbox) -> Callable[[], object]:
            return lambda: mailbox.put(self._event(image))

        keep_busy([sending(mailbox) for mailbox in self._senders], self._receive, count)

    def close(self) -> None:
        self._stack.close()
