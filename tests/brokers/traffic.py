"""Events that tests send to a broker, answers that they read, and what a broker still keeps."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections import Counter
from time import monotonic

import epypes as ep
from epypes.transport.address import open_channel, parse_address
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
    channel = open_channel(address)
    channel.open(None)
    channel.close()
    until(lambda: broker.has_written, f"{broker.name} to have written its queues")
    return address


class Reader:
    """Reads the answers of an address, each id once."""

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
        """Return how many have arrived."""
        while not self._inbox.empty():
            self.answers.append(self._inbox.get_nowait())
        return len(self.answers)

    def ids(self):
        """Return how often each event was answered."""
        self.look()
        return Counter(answer.correlation_id for answer in self.answers)


def dead_letters(address, count, timeout_s=WAIT_S):
    """Take dead letters of an address until there are so many, and look for more; return the deliveries by id.

    One whose consumer was killed before it had acknowledged the event may be there twice.
    """
    found, end_s, inbox = {}, monotonic() + timeout_s, queue.SimpleQueue()
    with ep.Subscriber(parse_address(address).dead_letters, inbox, undecoded=True):
        while monotonic() < end_s:
            try:
                delivery = inbox.get(timeout=0.2)
            except queue.Empty:
                if len(found) >= count:
                    break
                continue
            delivery.ack()
            found[delivery.id] = delivery
    assert len(found) == count, {name: received.headers for name, received in found.items()}
    return found


def left(address):
    """Return how many messages a broker keeps in a queue, by the broker's own client; 0 for MQTT, which does not say."""
    address = parse_address(address)
    return {"amqp": _left_in_rabbitmq, "nats": _left_in_nats, "mqtt": lambda address: 0}[address.scheme](address)


def remove(address):
    """Remove a queue with what it keeps, by the broker's own client."""
    address = parse_address(address)
    if address.scheme == "amqp":
        _in_rabbitmq(address, lambda channel: channel.queue_delete(address.name))
    else:
        _in_nats(address, lambda jetstream, stream: jetstream.delete_stream(stream))


def _left_in_rabbitmq(address):
    async def count(channel):
        return (await channel.declare_queue(address.name, passive=True)).declaration_result.message_count

    return _in_rabbitmq(address, count)


def _in_rabbitmq(address, ask):
    import aio_pika

    async def asked():
        options = {"host": address.host, "port": address.port, "login": address.user, "password": address.password}
        async with await aio_pika.connect(**options, virtualhost=address.vhost) as connection:
            return await ask(await connection.channel())

    return apart(lambda: asyncio.run(asked()))


def _left_in_nats(address):
    # Not what the stream keeps: a server that was killed may find messages again in its files that had been
    # acknowledged; it knows that, and delivers them to nobody.
    found = _in_nats(address, lambda jetstream, stream: jetstream.consumer_info(stream, address.group))
    return found.num_pending + found.num_ack_pending


def _in_nats(address, ask):
    import nats

    async def asked():
        client = await nats.connect(
            f"nats://{address.host}:{address.port}", user=address.user, password=address.password
        )
        try:
            jetstream = client.jetstream()
            return await ask(jetstream, await jetstream.find_stream_name_by_subject(address.name))
        finally:
            await client.close()

    return apart(lambda: asyncio.run(asked()))
