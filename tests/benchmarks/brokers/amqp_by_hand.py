"""RabbitMQ with aio-pika alone: a work queue, answers confirmed, then the event acknowledged."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable

import aio_pika
import numpy as np
from aio_pika.abc import AbstractChannel, AbstractConnection, AbstractIncomingMessage

from tests.benchmarks.brokers.parties import DEADLINE_S, OUTSTANDING, PREFETCH, Meeting


async def _connected(meeting: Meeting) -> AbstractConnection:
    return await aio_pika.connect(host="127.0.0.1", port=meeting.port, login=meeting.user, password=meeting.password)


async def _opened(connection: AbstractConnection) -> AbstractChannel:
    channel = await connection.channel()
    await channel.set_qos(PREFETCH)
    return channel


def prepare(meeting: Meeting) -> None:
    """Make the two queues as EPypes makes its own."""
    asyncio.run(_prepare(meeting))


async def _prepare(meeting: Meeting) -> None:
    async with await _connected(meeting) as connection:
        channel = await _opened(connection)
        for name in (meeting.events, meeting.answers):
            await channel.declare_queue(name, durable=True, arguments={"x-queue-type": "quorum"})


async def _send(channel: AbstractChannel, queue: str, body: bytes, message_id: str) -> None:
    persistent = aio_pika.DeliveryMode.PERSISTENT
    await channel.default_exchange.publish(
        aio_pika.Message(body, message_id=message_id, delivery_mode=persistent), queue
    )


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""
    asyncio.run(_serve(meeting, ready))


async def _serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    channel = await _opened(await _connected(meeting))

    async def answer(message: AbstractIncomingMessage) -> None:
        await _send(channel, meeting.answers, message.body, message.message_id or "")
        await message.ack()

    events = await channel.get_queue(meeting.events, ensure=False)
    await events.consume(answer)
    ready()
    await asyncio.Event().wait()


class Asker:
    """A connection, and a task for each of those that send."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._events, self._senders = meeting.events, senders
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(self._open(meeting))

    async def _open(self, meeting: Meeting) -> None:
        self._answers: asyncio.Queue[bytes] = asyncio.Queue()
        self._connection = await _connected(meeting)
        self._channel = await _opened(self._connection)
        answers = await self._channel.get_queue(meeting.answers, ensure=False)
        await answers.consume(self._take)

    async def _take(self, message: AbstractIncomingMessage) -> None:
        self._answers.put_nowait(message.body)
        await message.ack()

    def ask(self, image: np.ndarray) -> np.ndarray:
        body = self._loop.run_until_complete(self._ask(image.tobytes()))
        return np.frombuffer(body, image.dtype).reshape(image.shape)

    async def _ask(self, body: bytes) -> bytes:
        await _send(self._channel, self._events, body, str(uuid.uuid4()))
        return await asyncio.wait_for(self._answers.get(), DEADLINE_S)

    def ask_many(self, image: np.ndarray, count: int) -> None:
        self._loop.run_until_complete(self._ask_many(image, count))

    async def _ask_many(self, image: np.ndarray, count: int) -> None:
        room, left = asyncio.Semaphore(OUTSTANDING), iter(range(count))

        async def send_on() -> None:
            for _ in left:
                await room.acquire()
                await _send(self._channel, self._events, image.tobytes(), str(uuid.uuid4()))

        sending = [asyncio.create_task(send_on()) for _ in range(self._senders)]
        for _ in range(count):
            await asyncio.wait_for(self._answers.get(), DEADLINE_S)
            room.release()
        await asyncio.gather(*sending)

    def close(self) -> None:
        self._loop.run_until_complete(self._connection.close())
        self._loop.close()
