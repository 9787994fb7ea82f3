"""A subscriber on a broker loses nothing, handles nothing twice, and stops in time.

The broker lives in this process, so that it can go away at any moment; the real ones are tested elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
import pickle
import queue
import signal
import sys
import threading
from time import monotonic

import pytest

import epypes as ep
from epypes.errors import AddressError, BrokerError
from epypes.transport.address import open_channel, parse_address
from epypes.transport.brokers.channel import BrokerChannel
from epypes.transport.brokers.message import ATTEMPTS, REASON
from epypes.transport.channel import ChannelOptions, Delivery
from epypes.transport.memory import MemorySession, away, queued
from epypes.transport.subscriber import Subscriber
from epypes.wire import Envelope, encode
from tests.transport.peers import WAIT_S, threads, wait_until

_numbers = itertools.count()


@pytest.fixture
def broker():
    return f"subscriber{next(_numbers)}"


@pytest.fixture
def address(broker):
    return f"memory://{broker}/events?create=true"


@pytest.fixture
def send(address):
    """Sends messages as any program does, and waits until the broker has them."""
    channel = open_channel(address)
    channel.open(None)

    def send(*frames, **options):
        is_sent = threading.Event()
        channel.send(frames or (b"x",), confirmed=lambda error: is_sent.set(), **options)
        assert is_sent.wait(WAIT_S)

    yield send
    channel.close()


def dead_letters(address):
    found = queued(parse_address(address).dead_letters)
    return [(letter.id, letter.headers[REASON], letter.headers[ATTEMPTS]) for letter in found]


def left(address):
    return [message.id for message in queued(address)]


def take(q):
    return q.get(timeout=WAIT_S)


# What arrives


def test_bytes_and_envelopes_arrive_with_their_ids_and_attempts(address, send):
    q = queue.Queue()
    send(*encode(Envelope("vision", {"x": 1}, id="a")), id="a")
    send(b"2019", id="b")
    with Subscriber(address, q) as sub:
        envelope, data = take(q), take(q)
        assert isinstance(envelope, Envelope)
        assert (envelope.id, envelope.parts["x"], envelope.attempt) == ("a", 1, 1)
        assert (data, data.id, data.attempt) == (b"2019", "b", 1)
        assert (sub.received, sub.is_connected, sub.trouble) == (2, True, "")
        envelope.ack()
        data.ack()
    assert left(address) == []


def test_undecoded_messages_are_deliveries_that_are_deduplicated_by_the_id_in_their_header(address, send):
    q, frames = queue.Queue(), encode(Envelope("vision", {"x": 1}, id="a"))
    with Subscriber(address, q, undecoded=True) as sub:
        send(*frames, headers={"h": "v"})
        send(*frames)
        send(b"no", b"envelope", id="b")
        first, second = take(q), take(q)
        assert isinstance(first, Delivery)
        assert ([*map(bytes, first.frames)], first.id, first.attempt) == ([*map(bytes, frames)], "a", 1)
        assert first.headers == {"h": "v"}
        assert second.id == "b"
        wait_until(lambda: sub.duplicates == 1)
        first.ack()
        second.reject("unreadable")
    assert left(address) == []
    assert [known_as for known_as, _, _ in dead_letters(address)] == ["b"]


def test_an_unacknowledged_message_is_delivered_again_to_any_subscriber(address, send):
    q = queue.Queue()
    for known_as in "abc":
        send(id=known_as)
    with Subscriber(address, q):
        take(q).ack()
        kept = take(q)
    assert left(address) == ["b", "c"]
    with Subscriber(address, queue.Queue()) as other:
        wait_until(lambda: other.received == 2)
    kept.ack()
    assert left(address) == ["b", "c"]


def test_a_nacked_message_is_delivered_again(address, send):
    q = queue.Queue()
    send(id="a")
    with Subscriber(address, q) as sub:
        take(q).nack()
        again = take(q)
        assert (again.id, again.attempt, sub.duplicates) == ("a", 2, 0)
        again.ack()
    assert left(address) == []


def test_what_is_acknowledged_when_received_is_not_kept_by_the_broker(address, send):
    q = queue.Queue()
    send(id="a")
    with Subscriber(address, q, acknowledge="received"):
        item = take(q)
    assert left(address) == []
    item.reject("too late")
    assert dead_letters(address) == []


def test_a_message_that_can_not_be_understood_is_a_dead_letter_and_the_next_one_is_taken(address, send):
    q = queue.Queue()
    send(b"no", b"envelope", id="a")
    send(b"x" * 2_000, id="c")
    send(b"good", id="d")
    with Subscriber(address, q, max_message_bytes=1_000) as sub:
        assert take(q) == b"good"
        assert sub.rejected == {"bad topic": 1, "too large": 1}
        assert (sub.dead_letters, sub.received) == (2, 1)
    assert [(known_as, reason[:21]) for known_as, reason, _ in dead_letters(address)] == [
        ("a", "The first frame is no"),
        ("c", "A message of 2,000 by"),
    ]


@pytest.mark.parametrize("kind", ["queue", "broadcast"])
def test_a_message_of_another_topic_is_a_dead_letter_of_a_queue_and_left_alone_elsewhere(broker, kind):
    address, q = f"memory://{broker}/events?create=true&kind={kind}", queue.Queue()
    with Subscriber(address, q, "cam1") as sub, contextlib.closing(open_channel(address)) as channel:
        channel.open(None)
        for topic in ("none", "cam1", "cam10", "cam1/left"):
            channel.send(encode(Envelope(topic), topic))
        assert [take(q).type, take(q).type] == ["cam1", "cam1/left"]
        assert sub.rejected == ({"other topic": 2} if kind == "queue" else {})


# Duplicates


def test_a_message_that_is_in_flight_or_answered_is_not_put_again(address, send):
    q = queue.Queue()
    for known_as in "aab":
        send(id=known_as)
    with Subscriber(address, q) as sub:
        item = take(q)
        take(q).ack()
        assert (sub.received, sub.duplicates) == (2, 1)
        item.ack()
        send(id="a")
        send(id="b")
        wait_until(lambda: sub.duplicates == 3)
        assert q.empty()
    assert left(address) == []


def test_a_message_without_an_id_is_never_a_duplicate(address, send):
    q = queue.Queue()
    with Subscriber(address, q) as sub:
        for _ in range(3):
            send(b"same")
        assert [take(q) for _ in range(3)] == [b"same"] * 3
        assert sub.duplicates == 0


def test_ids_of_any_length_are_told_apart(address, send):
    q, long = queue.Queue(), ["x" * 60_000 + str(number) for number in range(2)]
    with Subscriber(address, q) as sub:
        for known_as in (*long, *long):
            send(id=known_as)
        items = [take(q), take(q)]
        assert [item.id for item in items] == long
        wait_until(lambda: sub.duplicates == 2)


@pytest.mark.slow
def test_a_message_that_the_user_has_thrown_away_is_put_again(broker, address, send):
    q = queue.Queue()
    send(id="a")
    with Subscriber(address, q) as sub:
        take(q)
        gc.collect()
        with away(broker):
            wait_until(lambda: not sub.is_connected)
        again = take(q)
        assert (again.id, again.attempt) == ("a", 2)


# Too often


@pytest.mark.slow
def test_a_message_that_was_delivered_too_often_is_a_dead_letter(broker, send, caplog):
    address, q = f"memory://{broker}/events?create=true&attempts=2", queue.Queue()
    send(id="a")
    for _ in range(2):
        with Subscriber(address, q):
            take(q)
    with Subscriber(address, q) as sub:
        wait_until(lambda: sub.dead_letters == 1)
        assert (sub.received, sub.rejected) == (0, {"exhausted": 1})
    assert dead_letters(address) == [("a", "delivered 3 times, and no consumer has answered it", "3")]
    (line,) = [message for message in caplog.messages if "rejected" in message]
    for part in ("'a'", str(parse_address(address)), str(parse_address(address).dead_letters), "ack()", "attempts=N"):
        assert part in line


@pytest.mark.parametrize("raises", [False, True])
def test_a_handler_of_exhausted_messages_rejects_them_itself_unless_it_raises(broker, send, raises):
    address, q, exhausted = f"memory://{broker}/events?create=true&attempts=1", queue.Queue(), queue.Queue()

    def handle(item):
        exhausted.put(item)
        if raises:
            raise SystemExit

    send(id="a")
    with Subscriber(address, q):
        take(q)
    with Subscriber(address, q, exhausted=handle) as sub:
        item = take(exhausted)
        assert (item.attempt, sub.received) == (2, 0)
        if raises:
            wait_until(lambda: sub.dead_letters == 1)
        else:
            item.reject("given up")
    assert len(dead_letters(address)) == 1


# Order


def numbered(*sequences, source="cam"):
    return [encode(Envelope("e", {"n": number}, source=source, epoch=1, sequence=number)) for number in sequences]


def test_ordered_envelopes_are_put_by_their_numbers_source_by_source(address, send):
    q = queue.Queue()
    with Subscriber(address, q, ordered=True, acknowledge="received"):
        for frames in (*numbered(2, 3), *numbered(1, source="other"), *numbered(1, 4)):
            send(*frames)
        found = [take(q) for _ in range(5)]
    assert [item.sequence for item in found if item.source == "cam"] == [1, 2, 3, 4]
    assert found[0].source == "other"


def test_answers_of_several_replicas_are_put_in_the_order_of_their_requests(address, send):
    q = queue.Queue()
    with Subscriber(address, q, ordered=True, acknowledge="received"):
        for own, (replica, request) in enumerate((("a", 2), ("b", 1), ("a", 3), ("b", 5), ("a", 4)), 1):
            request_of = {"request_source": "cam", "request_epoch": 7, "request_sequence": request}
            send(*encode(Envelope("answer", source=replica, epoch=1, sequence=own, **request_of)))
        assert [take(q).request_sequence for _ in range(5)] == [1, 2, 3, 4, 5]


@pytest.mark.slow
def test_ordered_envelopes_go_on_after_a_while_without_the_missing_one_which_is_named(address, send, caplog):
    q = queue.Queue()
    with Subscriber(address, q, ordered=0.3, acknowledge="received"):
        for frames in numbered(1, 4, 5):
            send(*frames)
        assert [take(q).sequence for _ in range(3)] == [1, 4, 5]
        assert "waited in vain for 2..3 of source 'cam'" in caplog.text
        # What comes too late is put all the same.
        for frames in numbered(2, 6):
            send(*frames)
        assert [take(q).sequence for _ in range(2)] == [2, 6]


def test_what_an_ordered_subscriber_holds_back_is_delivered_again_when_it_stops(address, send):
    q = queue.Queue()
    with Subscriber(address, q, ordered=True) as sub:
        for frames in numbered(1, 3):
            send(*frames)
        take(q).ack()
        wait_until(lambda: left(address) == [])
    assert sub.received == 1
    assert len(left(address)) == 1


def test_an_ordered_subscriber_that_was_stopped_while_it_waited_goes_on_after_its_next_start(address, send):
    q = queue.Queue()
    sub = Subscriber(address, q, ordered=0.5, acknowledge="received")
    with sub:
        for frames in numbered(1, 3):
            send(*frames)
        assert take(q).sequence == 1
        wait_until(lambda: "epypes-ordering" in [thread.name for thread in threads()])
    with sub:
        assert take(q).sequence == 3


def test_the_queue_of_an_ordered_subscriber_may_stop_it(address, send, caplog):
    class Stopping(queue.Queue):
        def put(self, item, block=True, timeout=None):
            super().put(item)
            if item.sequence == 1:
                sub.stop()

    q = Stopping()
    sub = Subscriber(address, q, ordered=True, acknowledge="received").start()
    for frames in numbered(2, 3, 1):
        send(*frames)
    wait_until(lambda: [thread for thread in threads() if thread.name.startswith("epypes from")] == [])
    assert [item.sequence for item in q.queue] == [1]
    assert "could not be taken" not in caplog.text
    with sub:
        assert [take(q).sequence for _ in range(3)] == [1, 2, 3]


# A broker that goes away


@pytest.mark.slow
def test_after_an_outage_a_message_that_is_in_flight_is_not_put_again_and_can_be_acknowledged(
    broker, address, send, caplog
):
    q, changes = queue.Queue(), []
    caplog.set_level(logging.WARNING, "epypes.transport")
    sub = Subscriber(address, q)
    sub.on_connection = lambda *change: changes.append(change)
    with sub:
        send(id="a")
        item = take(q)
        with away(broker):
            wait_until(lambda: not sub.is_connected)
            wait_until(lambda: "can't be reached" in sub.trouble)
        assert sub.wait_connected(WAIT_S)
        wait_until(lambda: sub.duplicates == 1)
        assert (q.empty(), sub.reconnects, sub.trouble) == (True, 1, "")
        item.ack()
        wait_until(lambda: "is connected again" in caplog.text)
    assert left(address) == []
    assert [is_connected for is_connected, _ in changes] == [True, False, True]


@pytest.mark.slow
def test_a_message_that_was_rejected_during_an_outage_is_a_dead_letter_once(broker, address, send):
    q = queue.Queue()
    with Subscriber(address, q) as sub:
        send(id="a")
        item = take(q)
        with away(broker):
            item.reject("too dark")
            wait_until(lambda: not sub.is_connected)
        wait_until(lambda: sub.duplicates == 1)
        send(id="a")
        wait_until(lambda: sub.duplicates == 2)
        assert sub.dead_letters == 1
    assert dead_letters(address) == [("a", "too dark", "2")]
    assert left(address) == []


# Queues of the user


def test_nothing_is_dropped_when_the_queue_is_full(address, send):
    q = queue.Queue(1)
    with Subscriber(address, q, prefetch=100) as sub:
        for number in range(20):
            send(id=str(number))
        wait_until(q.full)
        assert [take(q).id for _ in range(20)] == [str(number) for number in range(20)]
        assert sub.dropped == {}


def test_a_subscriber_whose_queue_is_full_stops_at_once_and_returns_what_did_not_fit(address, send):
    q = queue.Queue(1)
    for known_as in "abc":
        send(id=known_as)
    with Subscriber(address, q) as sub:
        wait_until(q.full)
    assert sub.received == 1
    assert sorted(left(address)) == ["a", "b", "c"]
    with sub:
        # The first one is in the queue since before.
        assert sorted(take(q).id for _ in range(3)) == ["a", "b", "c"]


def test_what_a_queue_refuses_is_counted_and_a_dead_letter(address, send):
    q = ep.Mailbox("fault")
    send(id="a")
    send(id="b")
    with Subscriber(address, q) as sub:
        wait_until(lambda: sub.dead_letters)
        assert (sub.dropped, sub.received) == ({"MailboxOverflow": 1}, 1)
    assert [(known_as, "full" in reason) for known_as, reason, _ in dead_letters(address)] == [("b", True)]


def test_what_a_queue_does_not_take_because_it_has_ended_goes_to_other_consumers(address, send):
    class Ended(queue.Queue):
        def put(self, item, block=True, timeout=None):
            # As a Mailbox whose publisher is stopped, and a queue of Python 3.13 that was shut down.
            raise getattr(queue, "ShutDown", BrokerError(address, "the publisher is stopped"))

    with Subscriber(address, Ended()) as sub:
        send(id="a")
        wait_until(lambda: sub.dropped)
        assert (sub.received, sub.dead_letters) == (0, 0)
    assert left(address) == ["a"]
    assert dead_letters(address) == []


@pytest.mark.slow
def test_a_subscriber_whose_queue_has_ended_takes_no_message_for_a_moment(address, send):
    class Ended(queue.Queue):
        def put(self, item, block=True, timeout=None):
            times_s.append(monotonic())
            raise BrokerError(address, "the publisher is stopped")

    times_s = []
    with Subscriber(address, Ended()):
        send(id="a")
        wait_until(lambda: len(times_s) == 2)
    assert times_s[1] - times_s[0] > 0.5


def test_a_message_that_a_newer_one_supersedes_is_a_dead_letter(address, send):
    latest = ep.Mailbox("latest")
    for known_as in "ab":
        send(id=known_as)
    with Subscriber(address, latest) as sub:
        wait_until(lambda: sub.received == 2)
        assert take(latest).id == "b"
    assert dead_letters(address) == [("a", "superseded", "1")]


def test_a_paused_subscriber_takes_nothing_and_can_acknowledge(broker, address, send):
    q = queue.Queue()
    with Subscriber(address, q) as sub:
        send(id="a")
        item = take(q)
        sub.pause()
        send(id="b")
        item.ack()
        assert sub.is_connected
        with away(broker):
            wait_until(lambda: not sub.is_connected)
        assert sub.wait_connected(WAIT_S)
        assert q.empty()
        sub.resume()
        assert take(q).id == "b"


def test_bytes_go_to_another_process_as_bytes(address, send):
    q = queue.Queue()
    with Subscriber(address, q):
        send(b"21.5 C")
        event = take(q)
        copied = pickle.loads(pickle.dumps(event))
        assert (copied, type(copied)) == (b"21.5 C", bytes)


# Starting and stopping


def test_a_start_fails_with_a_reason_when_the_broker_is_away_or_has_no_such_queue(broker, address):
    sub = Subscriber(address, queue.Queue())
    with away(broker), pytest.raises(BrokerError, match="can't be reached"):
        sub.start()
    with pytest.raises(BrokerError, match="no queue 'nowhere'"):
        Subscriber(f"memory://{broker}/nowhere", queue.Queue()).start()
    wait_until(lambda: threads() == [])
    with sub:
        assert sub.is_connected


def test_a_start_for_which_the_system_has_no_thread_leaves_no_connection(address, monkeypatch):
    start = threading.Thread.start

    def fail(thread):
        if thread.name.startswith("epypes from"):
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(RuntimeError, match="new thread"):
        Subscriber(address, queue.Queue()).start()
    wait_until(lambda: threads() == [])


def test_a_start_that_is_interrupted_connects_no_more(address, send):
    is_cancelled = threading.Event()
    main = threading.main_thread().ident

    class Silent(MemorySession):
        async def connect(self, window):
            while sys._current_frames()[main].f_code.co_name != "wait":
                await asyncio.sleep(0.01)
            signal.pthread_kill(main, signal.SIGUSR1)
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                is_cancelled.set()
                raise

    def interrupt(number, frame):
        raise KeyboardInterrupt

    options = ChannelOptions(timeout_s=10 * WAIT_S)
    before = signal.signal(signal.SIGUSR1, interrupt)
    try:
        # The channel of `send` keeps the event loop running.
        with pytest.raises(KeyboardInterrupt):
            BrokerChannel(Silent(parse_address(address), options.timeout_s), options).open(lambda delivery: None)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert is_cancelled.wait(WAIT_S)


def test_an_address_that_can_not_be_understood_is_refused_without_its_password():
    with pytest.raises(AddressError, match="'kafka' is not the beginning") as raised:
        Subscriber("kafka://me:secret@host/events", queue.Queue())
    assert "secret" not in str(raised.value)
    sub = Subscriber("amqp://me:secret@127.0.0.1/events", queue.Queue())
    assert "secret" not in repr(sub) + sub.address


@pytest.mark.parametrize("options", [{"acknowledge": "never"}, {"prefetch": 0}])
def test_options_without_a_meaning_are_refused(address, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Subscriber(address, queue.Queue(), **options)


def test_keys_are_refused_for_a_broker_and_a_broker_for_a_zmq_subscriber(address):
    with pytest.raises(AddressError, match="which are for ZeroMQ"):
        Subscriber(address, queue.Queue(), keys=ep.transport.Keys("p" * 40, "s" * 40), allow="x" * 40)
    with pytest.raises(AddressError, match="Give it to a Subscriber in place of a ZMQSubscriber"):
        ep.ZMQSubscriber(address, queue.Queue())


def test_a_subscriber_is_stopped_by_its_listener(broker, address):
    sub = Subscriber(address, queue.Queue())
    sub.on_connection = lambda is_connected, reason: is_connected or sub.stop()
    sub.start()
    with away(broker):
        wait_until(lambda: not [thread for thread in threads() if thread.name.startswith("epypes from")])
    sub.stop()
