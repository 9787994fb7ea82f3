"""How does somebody use RabbitMQ with pika alone: a work queue, answers confirmed, then the event acknowledged?"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
import pika
from pika.adapters.blocking_connection import BlockingChannel

from tests.benchmarks.brokers.parties import DEADLINE_S, PREFETCH, Meeting, keep_busy

_PERSISTENT = 2


def _connected(meeting: Meeting, heartbeat: int | None = None) -> BlockingChannel:
    credentials = pika.PlainCredentials(meeting.user, meeting.password)
    parameters = pika.ConnectionParameters("127.0.0.1", meeting.port, credentials=credentials, heartbeat=heartbeat)
    channel = pika.BlockingConnection(parameters).channel()
    channel.basic_qos(prefetch_count=PREFETCH)
    channel.confirm_delivery()
    return channel


def prepare(meeting: Meeting) -> None:
    """Make the two queues as EPypes makes its own."""
    channel = _connected(meeting)
    for name in (meeting.events, meeting.answers):
        channel.queue_declare(name, durable=True, arguments={"x-queue-type": "quorum"})
    channel.connection.close()


def _send(channel: BlockingChannel, queue: str, body: bytes, message_id: str) -> None:
    properties = pika.BasicProperties(delivery_mode=_PERSISTENT, message_id=message_id)
    channel.basic_publish("", queue, body, properties, mandatory=True)


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""

    def answer(channel: BlockingChannel, method: Any, properties: Any, body: bytes) -> None:
        _send(channel, meeting.answers, body, properties.message_id)
        channel.basic_ack(method.delivery_tag)

    channel = _connected(meeting)
    channel.basic_consume(meeting.events, answer)
    ready()
    channel.start_consuming()


class Asker:
    """Who asks: a connection that takes answers, and one for each thread that sends."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._events = meeting.events
        # Nobody looks after these connections while the other contenders are measured.
        self._senders = [_connected(meeting, heartbeat=0) for _ in range(senders)]
        self._receiver = _connected(meeting, heartbeat=0)
        self._answers: list[bytes] = []
        self._receiver.basic_consume(meeting.answers, self._take)

    def _take(self, channel: BlockingChannel, method: Any, properties: Any, body: bytes) -> None:
        self._answers.append(body)
        channel.basic_ack(method.delivery_tag)

    def _receive(self) -> bytes:
        while not self._answers:
            self._receiver.connection.process_data_events(DEADLINE_S)
        return self._answers.pop(0)

    def ask(self, image: np.ndarray) -> np.ndarray:
        _send(self._senders[0], self._events, image.tobytes(), str(uuid.uuid4()))
        return np.frombuffer(self._receive(), image.dtype).reshape(image.shape)

    def ask_many(self, image: np.ndarray, count: int) -> None:
        def sending(channel: BlockingChannel) -> Callable[[], object]:
            return lambda: _send(channel, self._events, image.tobytes(), str(uuid.uuid4()))

        keep_busy([sending(channel) for channel in self._senders], self._receive, count)

    def close(self) -> None:
        for channel in (*self._senders, self._receiver):
            channel.connection.close()
