"""How does somebody use NATS JetStream with nats-py alone: a work queue, answers confirmed, then the event acknowledged?"""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable

import nats
import numpy as np
from nats.aio.client import Client
from nats.js import JetStreamContext
from nats.js.api import ConsumerConfig, RetentionPolicy, StorageType

from tests.benchmarks.brokers.parties import DEADLINE_S, GROUP, OUTSTANDING, Meeting

_DUPLICATES_S = 120.0


async def _connected(meeting: Meeting) -> Client:
    address = f"nats://127.0.0.1:{meeting.port}"
    return await nats.connect(address, user=meeting.user, password=meeting.password)


def prepare(meeting: Meeting) -> None:
    """Make the two streams as EPypes makes its own."""
    asyncio.run(_prepare(meeting))


async def _prepare(meeting: Meeting) -> None:
    client = await _connected(meeting)
    for name in (meeting.events, meeting.answers):
        await client.jetstream().add_stream(
            name=name.replace(".", "-"),
            subjects=[name],
            retention=RetentionPolicy.WORK_QUEUE,
            storage=StorageType.FILE,
            duplicate_window=_DUPLICATES_S,
        )
    await client.close()


async def _send(stream: JetStreamContext, subject: str, body: bytes, message_id: str) -> None:
    await stream.publish(subject, body, DEADLINE_S, headers={"Nats-Msg-Id": message_id})


async def _pulling(stream: JetStreamContext, subject: str) -> JetStreamContext.PullSubscription:
    return await stream.pull_subscribe(subject, durable=GROUP, config=ConsumerConfig(ack_wait=DEADLINE_S))


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""
    asyncio.run(_serve(meeting, ready))


async def _serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    client = await _connected(meeting)
    stream = client.jetstream()
    events = await _pulling(stream, meeting.events)
    ready()
    while True:
        try:
            (message,) = await events.fetch(1, DEADLINE_S)
        except nats.errors.TimeoutError:
            continue
        await _send(stream, meeting.answers, message.data, (message.headers or {})["Nats-Msg-Id"])
        await message.ack()


class Asker:
    """Who asks: one connection, and a task for each of those who send."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._events, self._senders = meeting.events, senders
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self._open(meeting))

    async def _open(self, meeting: Meeting) -> None:
        self._client = await _connected(meeting)
        self._stream = self._client.jetstream()
        self._answers = await _pulling(self._stream, meeting.answers)

    def ask(self, image: np.ndarray) -> np.ndarray:
        body = self._loop.run_until_complete(self._ask(image.tobytes()))
        return np.frombuffer(body, image.dtype).reshape(image.shape)

    async def _ask(self, body: bytes) -> bytes:
        await _send(self._stream, self._events, body, str(uuid.uuid4()))
        return await self._receive()

    async def _receive(self) -> bytes:
        (message,) = await self._answers.fetch(1, DEADLINE_S)
        await message.ack()
        return message.data

    def ask_many(self, image: np.ndarray, count: int) -> None:
        self._loop.run_until_complete(self._ask_many(image, count))

    async def _ask_many(self, image: np.ndarray, count: int) -> None:
        room, left = asyncio.Semaphore(OUTSTANDING), iter(range(count))

        async def send_on() -> None:
            for _ in left:
                await room.acquire()
                await _send(self._stream, self._events, image.tobytes(), str(uuid.uuid4()))

        sending = [asyncio.create_task(send_on()) for _ in range(self._senders)]
        for _ in range(count):
            await self._receive()
            room.release()
        await asyncio.gather(*sending)

    def close(self) -> None:
        self._loop.run_until_complete(self._client.close())
        self._loop.close()
