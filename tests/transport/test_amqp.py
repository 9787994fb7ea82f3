"""RabbitMQ: what it alone promises, and the errors it gives; against a real one."""

from __future__ import annotations

import asyncio
import contextlib
import itertools

import aio_pika
import pytest

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import parse_address
from epypes.transport.brokers.amqp import make_channel
from epypes.transport.channel import ChannelOptions
from tests.apart import apart
from tests.brokers.rabbitmq import MAX_MESSAGE_BYTES
from tests.transport.channels import WAIT_S, Receiver, Sender, body
from tests.transport.peers import wait_until

pytestmark = pytest.mark.slow
_numbers = itertools.count()


@pytest.fixture
def name():
    return f"amqp events {next(_numbers)}"


@pytest.fixture
def by_hand(rabbitmq):
    """Do something with a channel of aio-pika, as another program does."""

    def do(work):
        async def live():
            options = {"host": "127.0.0.1", "port": rabbitmq.port, "login": rabbitmq.user}
            async with await aio_pika.connect(**options, password=rabbitmq.password) as connection:
                return await work(await connection.channel())

        return apart(lambda: asyncio.run(live()))

    return do


def declare(name, **arguments):
    return lambda channel: channel.declare_queue(name, durable=True, arguments=arguments or None)


def publish(name, text, **headers):
    return lambda channel: channel.default_exchange.publish(aio_pika.Message(text, headers=headers), name)


@pytest.fixture
def soon(monkeypatch):
    """What could not be put into the dead-letter queue is delivered again soon."""
    monkeypatch.setattr("epypes.transport.brokers.channel.REDELIVERY_S", 0.2)


def test_what_can_not_be_a_dead_letter_is_delivered_again_later(rabbitmq, name, opened, by_hand, soon, caplog):
    sender = opened(Sender, rabbitmq.address(name, create=True))
    receiver = opened(Receiver, rabbitmq.address(name), prefetch=2)
    sender.send(b"keep me", id="spoilt")
    by_hand(lambda channel: channel.queue_delete(f"{name}.dead"))
    spoilt = receiver.next()
    sender.send(b"other", id="other")
    spoilt.reject("no")
    came = {delivery.id: delivery for delivery in receiver.take(2)}
    assert (came["spoilt"].attempt, came["other"].attempt) == (2, 1)
    assert f"and is delivered again in 0.2 s: There is no queue '{name}.dead'" in caplog.text
    came["other"].ack()
    by_hand(declare(f"{name}.dead", **{"x-queue-type": "quorum"}))
    came["spoilt"].reject("at last")
    letter = opened(Receiver, rabbitmq.address(f"{name}.dead")).next()
    assert (letter.id, letter.headers["epypes-reason"]) == ("spoilt", "at last")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"kind": "log"}, "no queue 'nowhere'"),
        ({"kind": "broadcast"}, "no exchange 'nowhere'"),
        ({"user": "nobody"}, "refuses user 'nobody'"),
        ({"vhost": "elsewhere"}, "no virtual host 'elsewhere'"),
    ],
)
def test_an_error_names_what_the_broker_refuses_without_the_password(rabbitmq, options, text):
    with pytest.raises(BrokerError, match=text) as refused:
        Sender(rabbitmq.address("nowhere", **options))
    assert rabbitmq.password not in str(refused.value)
    assert "wrong" not in str(refused.value)


def test_a_queue_without_a_dead_letter_queue_is_refused(rabbitmq, name, by_hand):
    by_hand(declare(name))
    with pytest.raises(BrokerError, match=rf"no queue '{name}.dead', the dead-letter queue of '{name}'.*\?dead="):
        Receiver(rabbitmq.address(name))


def test_a_queue_of_another_program_is_taken_as_it_is(rabbitmq, name, opened, by_hand):
    by_hand(declare(name))
    by_hand(publish(name, b"plain", number=7))
    receiver = opened(Receiver, rabbitmq.address(name, create=True))
    delivery = receiver.next()
    assert (body(delivery), delivery.attempt) == (b"plain", 1)
    assert delivery.headers == {"number": "7"}
    receiver.channel.close()
    assert opened(Receiver, rabbitmq.address(name)).next().attempt == 2


def test_a_message_whose_sizes_do_not_fit_comes_without_frames_and_is_rejected_whole(rabbitmq, name, opened, by_hand):
    receiver = opened(Receiver, rabbitmq.address(name, create=True))
    by_hand(publish(name, b"12345", **{"epypes-frames": "2,2"}))
    delivery = receiver.next()
    assert delivery.frames == ()
    assert "lists 4 bytes; 5 came" in delivery.headers["epypes-error"]
    delivery.reject(delivery.headers["epypes-error"])
    assert body(opened(Receiver, rabbitmq.address(f"{name}.dead")).next()) == b"12345"


def test_a_dead_letter_whose_headers_leave_no_room_for_the_reason_goes_without_them(rabbitmq, name, opened, by_hand):
    receiver = opened(Receiver, rabbitmq.address(name, create=True))
    by_hand(publish(name, b"12", long="x" * 110_000, **{"epypes-frames": "1,1"}))
    receiver.next().reject("it " + "is too bright " * 1_000)
    letter = opened(Receiver, rabbitmq.address(f"{name}.dead")).next()
    assert body(letter) == b"1|2"
    assert letter.headers.pop("epypes-reason").startswith("it is too bright is")
    assert letter.headers == {"epypes-from": name, "epypes-attempts": "1"}


def test_a_message_that_is_too_large_is_refused_and_what_was_sent_with_it_goes_out(rabbitmq, name, opened):
    sender, outcomes = opened(Sender, rabbitmq.address(name, create=True)), {}

    def send(known_as, size):
        sender.channel.send([bytes(size)], id=known_as, confirmed=lambda error: outcomes.update({known_as: error}))

    for known_as, size in (("a", 1), ("large", MAX_MESSAGE_BYTES + 1), ("b", MAX_MESSAGE_BYTES)):
        send(known_as, size)
    wait_until(lambda: len(outcomes) == 3, WAIT_S)
    assert (outcomes["a"], outcomes["b"], outcomes["large"].reason) == (None, None, "too large")
    with pytest.raises(MessageError, match="longer than 255 bytes"):
        sender.send(b"", id="é" * 128)
    came = {opened(Receiver, rabbitmq.address(name)).next().id}
    assert came <= {"a", "b"}


def test_a_deleted_queue_is_named_and_made_again_if_the_address_says_so(rabbitmq, name, opened, by_hand):
    changes = []
    receiver = opened(
        Receiver, rabbitmq.address(name, create=True), on_connection=lambda *change: changes.append(change)
    )
    by_hand(lambda channel: channel.queue_delete(name))
    wait_until(lambda: len(changes) == 3, WAIT_S)
    assert changes[1] == (False, f"the queue '{name}' was deleted")
    opened(Sender, rabbitmq.address(name)).send(b"again")
    assert body(receiver.next()) == b"again"


def test_a_full_queue_is_named_while_the_message_waits(rabbitmq, name, opened, by_hand, caplog):
    limits = {"x-queue-type": "quorum", "x-max-length": 1, "x-overflow": "reject-publish"}
    by_hand(declare(name, **limits))
    opened(Sender, rabbitmq.address(f"{name}.dead", create=True))
    sender, outcomes = opened(Sender, rabbitmq.address(name)), []
    # A quorum queue takes more than its length of what comes at once, so far more than that is sent.
    for number in range(150):
        sender.channel.send([b"x"], id=str(number), confirmed=outcomes.append)
    wait_until(lambda: "did not take a message: the queue is full" in caplog.text, WAIT_S)
    receiver = opened(Receiver, rabbitmq.address(name))
    while len(outcomes) < 150:
        with contextlib.suppress(Exception):
            receiver.next(0.1).ack()
    assert outcomes == [None] * 150


def test_a_broker_that_takes_no_messages_just_now_is_an_error_that_names_where_to_look(rabbitmq, name, opened, caplog):
    sender = opened(Sender, rabbitmq.address(name, create=True), timeout_s=1.0)
    rabbitmq.evaluate("vm_memory_monitor:set_vm_memory_high_watermark(0).")
    try:
        outcomes, sent = [], []

        def is_named():
            # The broker may take some messages before it blocks.
            if len(outcomes) == len(sent):
                sent.append(None)
                sender.channel.send([b"x"], confirmed=outcomes.append)
            return "low on memory" in caplog.text

        wait_until(is_named, WAIT_S)
    finally:
        rabbitmq.evaluate("vm_memory_monitor:set_vm_memory_high_watermark(0.8).")
    wait_until(lambda: len(outcomes) == len(sent), WAIT_S)
    assert outcomes == sent


def test_the_command_that_shows_the_leader_of_a_queue_is_quoted_for_a_shell():
    def hint(text):
        from epypes.transport.brokers.amqp import AmqpSession

        address = parse_address(text)
        return AmqpSession(address, 1.0).hint(address)

    assert " quorum_status robots says " in hint("amqp://h/robots")
    assert " quorum_status --vhost 'cell 7' 'it'\"'\"'s' says " in hint("amqp://h/it's?vhost=cell%207")
    assert "quorum_status" not in hint("amqp://h/robots?kind=broadcast"), "an exchange has no leader"


def test_a_channel_that_nobody_uses_is_kept_alive_and_a_silent_broker_is_lost(rabbitmq, name, opened, monkeypatch):
    monkeypatch.setattr("epypes.transport.brokers.amqp._HEARTBEAT_S", 1)
    sender = opened(Sender, rabbitmq.address(name, create=True))
    before = rabbitmq.log.count("missed heartbeats")
    rabbitmq.pause()
    try:
        wait_until(lambda: not sender.channel.is_connected, WAIT_S)
    finally:
        rabbitmq.resume()
    wait_until(lambda: sender.channel.is_connected, WAIT_S)
    sender.send(b"still here")
    assert rabbitmq.log.count("missed heartbeats") <= before + 1


def test_a_channel_that_was_never_opened_can_be_closed():
    channel = make_channel(parse_address("amqp://127.0.0.1/events"), ChannelOptions())
    channel.close()
    with pytest.raises(BrokerError, match="closed"):
        channel.send([b"a"])
