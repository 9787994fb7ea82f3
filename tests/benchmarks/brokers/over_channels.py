"""The channels of EPypes alone, without a pipeline: a replica and an asker that send and receive by them."""

from __future__ import annotations

import queue
from collections.abc import Callable
from threading import Event

import numpy as np

from epypes.transport.address import open_channel
from epypes.transport.channel import Channel, ChannelOptions, Delivery
from epypes.wire import new_id
from tests.benchmarks.brokers.parties import DEADLINE_S, PREFETCH, Meeting, keep_busy


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came, and acknowledge it when the answer is confirmed."""
    events = open_channel(meeting.events, ChannelOptions(prefetch=PREFETCH))
    answers = open_channel(meeting.answers)
    answers.open(None)

    def answer(delivery: Delivery) -> None:
        answers.send(delivery.frames, id=delivery.id, confirmed=lambda error: delivery.ack())

    events.open(answer)
    ready()
    Event().wait()


class Asker:
    """A channel that takes answers, and one for each thread that sends."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._arrived: queue.SimpleQueue[Delivery] = queue.SimpleQueue()
        self._senders = [open_channel(meeting.events) for _ in range(senders)]
        self._answers = open_channel(meeting.answers, ChannelOptions(prefetch=PREFETCH))
        for sender in self._senders:
            sender.open(None)
        self._answers.open(self._arrived.put)

    def _receive(self) -> bytes | memoryview:
        answer = self._arrived.get(timeout=DEADLINE_S)
        answer.ack()
        return answer.frames[0]

    def ask(self, image: np.ndarray) -> np.ndarray:
        self._senders[0].send([image.tobytes()], id=new_id())
        return np.frombuffer(self._receive(), image.dtype).reshape(image.shape)

    def ask_many(self, image: np.ndarray, count: int) -> None:
        def sending(channel: Channel) -> Callable[[], object]:
            def send() -> None:
                # As by hand, the next one is sent when this one is confirmed.
                confirmed = Event()
                channel.send([image.tobytes()], id=new_id(), confirmed=lambda error: confirmed.set())
                confirmed.wait(DEADLINE_S)

            return send

        keep_busy([sending(channel) for channel in self._senders], self._receive, count)

    def close(self) -> None:
        for channel in (*self._senders, self._answers):
            channel.close()
