"""What was sent, what came back, and what does a broker still keep?"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections import Counter
from time import monotonic

from epypes.transport.channels import open_channel, place_of

import epypes as ep
from epypes.wire import Envelope
from tests.apart import apart

PLAIN, KILLS, RAISES, KILLS_PARENT = range(4)
WAIT_S = 60.0


def until(condition, what, timeout_s=WAIT_S):
    """Wait for something that happens in other processes; ``what`` may be called for how it stands."""
    never, end_s = threading.Event(), monotonic() + timeout_s
    while not condition():
        if monotonic() > end_s:
            raise AssertionError(f"Not within {timeout_s:g} s: {what() if callable(what) else what}")
        never.wait(0.01)


def event(number, kind=PLAIN):
    return Envelope("frame", {"number": number, "kind": kind}, id=f"event-{number}", source="test")


def lasting(broker, name, **options):
    """Make a queue, and wait until it outlives a kill of its broker; return its address."""
    address = broker.address(name, create=True, **options)
    open_channel(address).close()
    until(lambda: broker.has_written, f"{broker.name} to have written its queues")
    return address


class Reader:
    """Who gathers the answers of a place, each id once."""

    def __init__(self, address):
        self._inbox: queue.SimpleQueue = queue.SimpleQueue()
        self.subscriber = ep.Subscriber(address, self._inbox, acknowledge="received", prefetch=64)
        self.answers = []

    def __enter__(self):
        self.subscriber.start()
        return self

    def __exit__(self, *exception):
        self.subscriber.stop()

    def look(self):
        """Return how many have come."""
        while not self._inbox.empty():
            self.answers.append(self._inbox.get_nowait())
        return len(self.answers)

    def ids(self):
        """Return how often each event was answered."""
        self.look()
        return Counter(answer.correlation_id for answer in self.answers)


def dead_letters(address, count, timeout_s=WAIT_S):
    """Take dead letters of a place until there are so many, and look for more; return them by id: ``Received``.

    One whose receiver was killed before it had acknowledged the event may be there twice.
    """
    found, end_s = {}, monotonic() + timeout_s
    channel = open_channel(place_of(address).dead_letters, prefetch=8)
    try:
        while monotonic() < end_s:
            received = channel.receive(0.2)
            if received is not None:
                received.ack()
                found[received.id] = received
            elif len(found) >= count:
                break
    finally:
        channel.close()
    assert len(found) == count, {name: received.headers for name, received in found.items()}
    return found


def left(address):
    """Return how many messages a broker keeps in a queue, as the broker's own client says; MQTT tells nobody."""
    place = place_of(address)
    return {"amqp": _left_in_rabbitmq, "nats": _left_in_nats, "mqtt": lambda place: 0}[place.scheme](place)


def remove(address):
    """Remove a queue with what it keeps, by the broker's own client."""
    place = place_of(address)
    if place.scheme == "amqp":
        _in_rabbitmq(place, lambda channel: channel.queue_delete(place.name))
    else:
        _in_nats(place, lambda jetstream, stream: jetstream.delete_stream(stream))


def _left_in_rabbitmq(place):
    async def count(channel):
        return (await channel.declare_queue(place.name, passive=True)).declaration_result.message_count

    return _in_rabbitmq(place, count)


def _in_rabbitmq(place, ask):
    import aio_pika

    async def asked():
        options = {"host": place.host, "port": place.port, "login": place.user, "password": place.password}
        async with await aio_pika.connect(**options, virtualhost=place.vhost) as connection:
            return await ask(await connection.channel())

    return apart(lambda: asyncio.run(asked()))


def _left_in_nats(place):
    # Not what the stream keeps: a server that was killed may find messages again in its files that had been
    # acknowledged; it knows that, and delivers them to nobody.
    found = _in_nats(place, lambda jetstream, stream: jetstream.consumer_info(stream, place.group))
    return found.num_pending + found.num_ack_pending


def _in_nats(place, ask):
    import nats

    async def asked():
        client = await nats.connect(f"nats://{place.host}:{place.port}", user=place.user, password=place.password)
        try:
            jetstream = client.jetstream()
            return await ask(jetstream, await jetstream.find_stream_name_by_subject(place.name))
        finally:
            await client.close()

    return apart(lambda: asyncio.run(asked()))
