"""Do a publisher and a subscriber on a broker lose nothing, answer nothing twice, and stop when they are told to?

The broker lives in this process, so that it can go away at any moment; the real ones are asked elsewhere.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import logging
import os
import pickle
import queue
import subprocess
import sys
import threading
import time

import pytest

import epypes as ep
from epypes.errors import AddressError, BrokerError, MessageError, StillRunning
from epypes.transport import inhand
from epypes.transport.channels import memory, open_channel, place_of
from epypes.transport.channels.memory import away
from epypes.transport.channels.packing import ATTEMPTS, REASON
from epypes.transport.connection import Connection
from epypes.wire import Envelope, encode
from tests.transport.peers import wait_until

WAIT_S = 60.0
_numbers = itertools.count()


@pytest.fixture
def broker():
    return f"twins{next(_numbers)}"


@pytest.fixture
def address(broker):
    return f"memory://{broker}/events?create=true"


@pytest.fixture
def send(address):
    """Sends messages as any program does."""
    channel = open_channel(address)

    def sent(*frames, **options):
        channel.send(frames or (b"x",), **options)

    yield sent
    channel.close()


def dead_letters(address):
    """Return (id, reason, attempts) of what was put aside."""
    channel = open_channel(place_of(address).dead_letters, prefetch=1_000)
    found = []
    while (received := channel.receive(0.0)) is not None:
        found.append((received.id, received.headers[REASON], received.headers[ATTEMPTS]))
    channel.close()
    return found


def left(address):
    """Return the ids of what the broker still has for others."""
    channel = open_channel(address, prefetch=1_000)
    found = []
    while (received := channel.receive(0.0)) is not None:
        found.append(received.id)
    channel.close()
    return found


def threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith(("epypes to", "epypes from"))]


def take(q):
    return q.get(timeout=WAIT_S)


# What arrives


def test_what_is_put_at_one_end_arrives_at_the_other(address):
    out, q = queue.Queue(), queue.Queue()
    with ep.Publisher(address, out, "cam1") as pub, ep.Subscriber(address, q) as sub:
        out.put(Envelope("vision", {"x": 1}, id="a"))
        out.put(b"2019")
        envelope, data = take(q), take(q)
        assert isinstance(envelope, Envelope)
        assert (envelope.id, envelope.parts["x"], envelope.sequence, envelope.attempt) == ("a", 1, 1, 1)
        assert (envelope.received.id, data, data.attempt) == ("a", b"2019", 1)
        assert len(data.received.id) == 32
        wait_until(lambda: pub.sent == 2)
        assert (sub.received, sub.is_connected, pub.is_connected, sub.trouble, pub.trouble) == (2, True, True, "", "")
        envelope.ack()
        data.ack()
    assert left(address) == []


def test_what_has_no_word_said_about_it_comes_again_to_whoever_asks(address, send):
    q = queue.Queue()
    for known_as in "abc":
        send(id=known_as)
    with ep.Subscriber(address, q):
        take(q).ack()
        kept = take(q)
    assert left(address) == ["b", "c"]
    with ep.Subscriber(address, queue.Queue()) as other:
        wait_until(lambda: other.received == 2)
    kept.ack()
    assert left(address) == ["b", "c"]


def stalls(caplog):
    return [message for message in caplog.messages if "sends nothing more" in message]


@pytest.mark.slow
def test_who_acknowledges_nothing_is_told_once_why_nothing_more_comes(address, send, caplog, monkeypatch):
    monkeypatch.setattr(inhand, "LONG_S", 0.2)
    q = queue.SimpleQueue()
    for _ in range(12):
        send()
    with ep.Subscriber(address, q) as sub:
        wait_until(lambda: stalls(caplog))
        assert sub.received == 8
        for _ in range(4):
            take(q).ack()
        wait_until(lambda: sub.received == 12)
    (told,) = stalls(caplog)
    assert "8 messages are in hand" in told
    assert "acknowledge='received'" in told
    assert "ack()" in told


@pytest.mark.slow
def test_what_is_in_hand_is_counted_anew_over_a_new_connection(address, broker, send, caplog, monkeypatch):
    monkeypatch.setattr(inhand, "LONG_S", 3600.0)
    q = queue.SimpleQueue()
    for known_as in "abc":
        send(id=known_as)
    with ep.Subscriber(address, q, prefetch=3) as sub:
        kept = [take(q) for _ in "abc"]
        with away(broker):
            wait_until(lambda: not sub.is_connected)
        wait_until(lambda: sub.duplicates == 3)
        monkeypatch.setattr(inhand, "LONG_S", 0.0)
        wait_until(lambda: stalls(caplog))
        assert "3 messages are in hand" in stalls(caplog)[0]
        for item in kept:
            item.ack()
    assert left(address) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"acknowledge": "received", "prefetch": 2}, {"prefetch": 4}, {"prefetch": 3, "exhausted": print}]
)
def test_who_gets_all_or_has_a_clock_of_its_own_is_told_nothing(address, send, caplog, monkeypatch, options):
    monkeypatch.setattr(inhand, "LONG_S", 0.0)
    q, idle = queue.SimpleQueue(), []
    monkeypatch.setattr(Connection, "works", lambda self: idle.append(self))
    with ep.Subscriber(address, q, **options):
        for _ in range(3):
            send()
        kept = [take(q) for _ in range(3)]
        before = len(idle)
        wait_until(lambda: len(idle) > before + 2)
    assert len(kept) == 3
    assert not stalls(caplog)


def test_only_the_first_word_counts(address, send):
    q = queue.Queue()
    send(id="a")
    with ep.Subscriber(address, q) as sub:
        item = take(q)
        item.ack()
        item.reject("too late")
        item.give_back()
        assert sub.dead_letters == 0
    assert (left(address), dead_letters(address)) == ([], [])


def test_what_is_rejected_is_a_dead_letter_with_its_reason_in_one_line(address, send):
    q = queue.Queue()
    send(id="a")
    with ep.Subscriber(address, q) as sub:
        take(q).reject("blur: ValueError:\n too dark \ud800")
        assert sub.dead_letters == 1
    assert dead_letters(address) == [("a", "blur: ValueError: too dark ?", "1")]


def test_what_is_acknowledged_when_received_is_not_kept_by_the_broker(address, send):
    q = queue.Queue()
    send(id="a")
    with ep.Subscriber(address, q, acknowledge="received"):
        item = take(q)
        wait_until(lambda: left(address) == [])
    item.reject("too late")
    assert dead_letters(address) == []


def test_a_message_that_can_not_be_understood_is_put_aside_and_the_next_one_is_taken(address, send):
    q = queue.Queue()
    send(b"no", b"envelope", id="a")
    send(b"any", id="b", headers={"epypes-error": "its header is broken"})
    send(b"x" * 2_000, id="c")
    send(b"good", id="d")
    with ep.Subscriber(address, q, max_message_bytes=1_000) as sub:
        assert take(q) == b"good"
        assert sub.rejected == {"bad topic": 1, "bad frames": 1, "too large": 1}
        assert (sub.dead_letters, sub.received) == (3, 1)
    assert [(known_as, reason[:21]) for known_as, reason, _ in dead_letters(address)] == [
        ("a", "The first frame is no"),
        ("b", "its header is broken"),
        ("c", "A message of 2,000 by"),
    ]


@pytest.mark.parametrize("kind", ["queue", "broadcast"])
def test_what_is_of_another_topic_is_put_aside_at_a_queue_and_left_to_others_elsewhere(broker, kind):
    address, q = f"memory://{broker}/events?create=true&kind={kind}", queue.Queue()
    channel = open_channel(address)
    with ep.Subscriber(address, q, "cam1") as sub:
        for topic in ("cam1", "cam10", "cam1/left", "cam1"):
            # A broadcast reaches who listens by now.
            wait_until(lambda: channel.send(encode(Envelope("e"), "none")) or kind == "queue" or sub.is_connected)
            channel.send(encode(Envelope(topic), topic))
        first = take(q)
        assert [first.type, take(q).type] in (["cam1", "cam1/left"], ["cam1/left", "cam1"])
        assert set(sub.rejected) == ({"other topic"} if kind == "queue" else set())
    channel.close()


# Duplicates


def test_what_is_in_hand_or_done_is_not_put_again(address, send):
    q = queue.Queue()
    for known_as in "aab":
        send(id=known_as)
    with ep.Subscriber(address, q) as sub:
        item = take(q)
        take(q).ack()
        assert (sub.received, sub.duplicates) == (2, 1)
        item.ack()
        send(id="a")
        send(id="b")
        wait_until(lambda: sub.duplicates == 3)
        assert q.empty()
    assert left(address) == []


def test_envelopes_of_one_id_are_one_event_whatever_the_messages_are_called(address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q) as sub:
        for _ in range(2):
            send(*encode(Envelope("e", id="a")))
        item = take(q)
        wait_until(lambda: sub.duplicates == 1)
        item.ack()
    assert left(address) == []


def test_what_has_no_id_is_never_a_duplicate(address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q) as sub:
        for _ in range(3):
            send(b"same")
        assert [take(q) for _ in range(3)] == [b"same"] * 3
        assert sub.duplicates == 0


def test_what_others_have_answered_is_a_duplicate_when_it_comes(address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q) as sub:
        sub.seen(["a", "c"])
        for known_as in "abc":
            send(id=known_as)
        assert take(q).received.id == "b"
        wait_until(lambda: sub.duplicates == 2)
    assert left(address) == ["b"]


@pytest.mark.slow
def test_what_was_given_back_or_thrown_away_is_put_again_when_it_comes_again(broker, address, send):
    q = queue.Queue()
    send(id="a")
    send(id="b")
    with ep.Subscriber(address, q) as sub:
        given_back = take(q)
        given_back.give_back()
        take(q)
        gc.collect()
        with away(broker):
            wait_until(lambda: not sub.is_connected)
        assert sorted((item.received.id, item.attempt) for item in (take(q), take(q))) == [("a", 2), ("b", 2)]


# Too often


@pytest.mark.slow
def test_what_nobody_could_answer_in_so_many_deliveries_is_a_dead_letter(broker, send, caplog):
    address, q = f"memory://{broker}/events?create=true&attempts=2", queue.Queue()
    send(id="a")
    for _ in range(2):
        with ep.Subscriber(address, q):
            take(q)
    with ep.Subscriber(address, q) as sub:
        wait_until(lambda: sub.dead_letters == 1)
        assert (sub.received, sub.rejected) == (0, {"exhausted": 1})
    assert dead_letters(address) == [("a", "delivered 3 times, and no receiver has answered it", "3")]
    (told,) = [message for message in caplog.messages if "rejected" in message]
    for part in ("'a'", str(place_of(address)), str(place_of(address).dead_letters), "ack()", "attempts=N"):
        assert part in told


@pytest.mark.slow
@pytest.mark.parametrize("raises", [False, True])
def test_who_wants_to_hear_of_what_was_delivered_too_often_rejects_it_himself(broker, send, raises, caplog):
    address, q, heard = f"memory://{broker}/events?create=true&attempts=1", queue.Queue(), queue.Queue()

    def exhausted(item):
        heard.put(item)
        if raises:
            raise SystemExit

    send(id="a")
    with ep.Subscriber(address, q):
        take(q)
    with ep.Subscriber(address, q, exhausted=exhausted) as sub:
        item = take(heard)
        assert (item.attempt, sub.received) == (2, 0)
        if raises:
            wait_until(lambda: sub.dead_letters == 1)
        else:
            item.reject("heard of")
    assert len(dead_letters(address)) == 1


# A broker that goes away


@pytest.mark.slow
def test_a_subscriber_is_there_again_when_the_broker_is_and_what_is_in_hand_is_not_put_again(
    broker, address, send, caplog
):
    q, told = queue.Queue(), []
    caplog.set_level(logging.WARNING, "epypes.transport")
    sub = ep.Subscriber(address, q)
    sub.on_connection = lambda *what: told.append(what)
    with sub:
        send(id="a")
        item = take(q)
        with away(broker):
            wait_until(lambda: not sub.is_connected)
            wait_until(lambda: "can't be reached" in sub.trouble)
        assert sub.wait_connected(WAIT_S)
        wait_until(lambda: sub.duplicates == 1)
        assert (q.empty(), item.attempt, sub.reconnects, sub.trouble) == (True, 2, 1, "")
        item.ack()
        wait_until(lambda: "is there again" in caplog.text)
    assert left(address) == []
    assert [is_connected for is_connected, _ in told] == [True, False, True]
    assert caplog.text.count("tried again until it is there") == 1


@pytest.mark.slow
def test_what_was_rejected_while_the_broker_was_away_is_a_dead_letter_all_the_same(broker, address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q) as sub:
        send(id="a")
        item = take(q)
        with away(broker):
            item.reject("too dark")
            wait_until(lambda: not sub.is_connected)
        wait_until(lambda: sub.duplicates == 1)
        # Once it was heard, it is not put aside again.
        channel = open_channel(address)
        channel.send((b"x",), id="a")
        wait_until(lambda: sub.duplicates == 2)
        channel.close()
        assert sub.dead_letters == 1
    assert dead_letters(address) == [("a", "too dark", "2")]
    assert left(address) == []


def test_a_broker_that_hangs_up_each_time_is_asked_less_and_less_often(address):
    pauses = []

    class Over(threading.Event):
        def wait(self, timeout):
            pauses.append(timeout)
            return False

    connection = Connection(place_of(address), 1, 1.0, lambda *what: None)
    for _ in range(8):
        connection.channel(Over())
        connection.works()
        connection.lose(BrokerError(address, "it has hung up"))
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]


@pytest.mark.slow
def test_a_publisher_sends_what_it_has_when_the_broker_is_there_again(broker, address):
    out = queue.Queue()
    with ep.Publisher(address, out) as pub:
        out.put(Envelope("e", id="a"))
        wait_until(lambda: pub.sent == 1)
        with away(broker):
            for known_as in "bcd":
                out.put(Envelope("e", id=known_as))
            wait_until(lambda: "can't be reached" in pub.trouble)
            assert not pub.is_connected
        wait_until(lambda: pub.sent == 4)
        assert (pub.reconnects, pub.rejected, pub.trouble) == (1, {}, "")
    assert left(address) == list("abcd")


@pytest.mark.slow
@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
def test_a_twin_that_has_nothing_to_do_knows_that_the_broker_is_away_and_is_back(make, broker, address):
    twin, told = make(address, queue.Queue()), []
    twin.on_connection = lambda *what: told.append(what)
    with twin:
        if make is ep.Subscriber:
            twin.pause()
        with away(broker):
            wait_until(lambda: not twin.is_connected)
            assert "the broker" in twin.trouble
        wait_until(lambda: twin.is_connected)
        assert (twin.trouble, twin.reconnects) == ("", 1)
        with away(broker):
            wait_until(lambda: twin.trouble)
    assert (twin.is_connected, twin.trouble) == (False, "")
    assert [is_connected for is_connected, _ in told] == [True, False, True, False]


def test_a_put_into_a_mailbox_returns_when_the_broker_has_confirmed(broker, address):
    out = ep.Mailbox("latest")
    with ep.Publisher(address, out) as pub:
        out.put(b"first")
        assert pub.sent == 1
        putting = threading.Thread(target=out.put, args=(b"second",))
        with away(broker):
            putting.start()
            wait_until(lambda: pub.trouble)
            assert (putting.is_alive(), pub.sent) == (True, 1)
        putting.join(WAIT_S)
        assert (putting.is_alive(), pub.sent) == (False, 2)


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: ep.Mailbox("block", 8), queue.Queue])
def test_a_publisher_that_is_stopped_while_the_broker_is_away_says_what_it_has_not_sent(broker, address, make):
    out, raised = make(), []

    def put():
        try:
            out.put(b"lost")
        except BrokerError as error:
            raised.append(error)

    pub = ep.Publisher(address, out).start()
    putting = threading.Thread(target=put)
    with away(broker):
        putting.start()
        wait_until(lambda: pub.trouble)
        begin_s = time.monotonic()
        pub.stop(0.2)
        assert time.monotonic() - begin_s < WAIT_S
        putting.join(WAIT_S)
        assert not putting.is_alive()
    assert pub.rejected == {"not sent": 1}
    assert len(raised) == isinstance(out, ep.Mailbox)
    assert "memory://" in str(raised or "memory://")
    assert threads() == []


def test_what_can_not_be_sent_raises_from_a_mailbox_and_is_counted(address):
    out = ep.Mailbox("block", 8)
    with ep.Publisher(address, out, max_message_bytes=100) as pub:
        with pytest.raises(MessageError, match="1,000 bytes"):
            out.put(b"x" * 1_000)
        with pytest.raises(MessageError, match="not int"):
            out.put(1)
        out.put(b"good")
        assert (pub.sent, pub.rejected) == (1, {"too large": 1, "no codec": 1})


def test_what_the_broker_will_never_take_is_told_and_the_next_one_is_sent(address, monkeypatch):
    from epypes.transport.channels.memory import MemoryChannel

    sends = MemoryChannel.send

    def send(self, frames, **options):
        if len(frames[0]) > 10:
            raise MessageError("too large", "the broker takes 10 bytes at most")
        sends(self, frames, **options)

    monkeypatch.setattr(MemoryChannel, "send", send)
    out = ep.Mailbox("block", 8)
    with ep.Publisher(address, out) as pub:
        with pytest.raises(MessageError, match="10 bytes at most"):
            out.put(b"x" * 11)
        out.put(b"good")
        assert (pub.sent, pub.rejected, pub.reconnects) == (1, {"too large": 1}, 0)


@pytest.mark.slow
def test_a_message_that_no_channel_can_send_does_not_keep_the_others(address, monkeypatch):
    out = queue.Queue()
    with ep.Publisher(address, out) as pub:
        send = memory.MemoryChannel.send

        def broken(self, frames, **options):
            if frames[0] == b"poison":
                raise TypeError("a header must be text")
            send(self, frames, **options)

        monkeypatch.setattr(memory.MemoryChannel, "send", broken)
        out.put(b"poison")
        out.put(b"good")
        wait_until(lambda: pub.sent == 1)
        assert pub.rejected == {"TypeError": 1}


@pytest.mark.slow
def test_who_puts_while_a_publisher_starts_waits_for_the_confirmation(broker, address):
    class Queue(queue.Queue):
        def hand_to(self, publish):
            with away(broker):
                other = threading.Thread(target=publish, args=(b"an answer",))
                other.start()
                other.join(0.3)
                self.is_confirmed = not other.is_alive()
            return lambda: None

    out = Queue()
    with ep.Publisher(address, out) as pub:
        assert not out.is_confirmed
        wait_until(lambda: pub.sent == 1)


def test_bytes_that_were_delivered_go_to_another_process_as_bytes(address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q):
        send(b"21.5 C")
        event = take(q)
        sent = pickle.loads(pickle.dumps(event))
        assert (sent, type(sent)) == (b"21.5 C", bytes)


def test_what_a_mailbox_has_kept_is_sent_at_the_start_whatever_it_is(address):
    out = ep.Mailbox("block", 8)
    out.put(1)
    out.put(b"good")
    with ep.Publisher(address, out) as pub:
        wait_until(lambda: (pub.sent, pub.rejected) == (1, {"no codec": 1}))


def test_what_is_sent_is_what_it_was_when_it_was_put(address):
    np = pytest.importorskip("numpy")
    from epypes.transport.outbox import Outbox

    image, told = np.zeros((100, 100), np.uint8), queue.Queue()
    outbox = Outbox(place_of(address))
    outbox.put(Envelope("e", {"image": image}), then=told.put)
    image[:] = 1
    outbox.start()
    assert take(told) is None
    outbox.stop()
    q = queue.Queue()
    with ep.Subscriber(address, q):
        assert not take(q).parts["image"].any()


def test_an_outbox_tells_what_became_of_everything_that_was_put(broker, address):
    from epypes.transport.outbox import Outbox

    outbox, told = Outbox(place_of(address)), []
    outbox.start()
    outbox.put((b"a", b"b"), id="1", headers={"h": "v"}, then=told.append)
    outbox.put(object(), then=told.append)
    assert outbox.wait_empty(WAIT_S)
    with away(broker):
        outbox.put(b"x", then=told.append)
        wait_until(lambda: outbox.trouble)
        outbox.stop(0.0)
    outbox.put(b"y", then=told.append)
    assert sorted(type(error).__name__ for error in told) == ["BrokerError", "BrokerError", "MessageError", "NoneType"]
    channel = open_channel(address)
    received = channel.receive(0.0)
    assert (received.frames, received.id, received.headers) == ((b"a", b"b"), "1", {"h": "v"})
    channel.close()


# Queues that are full


def test_nothing_is_dropped_when_the_queue_is_full(address, send):
    q = queue.Queue(1)
    with ep.Subscriber(address, q, prefetch=100) as sub:
        for number in range(20):
            send(id=str(number))
        wait_until(q.full)
        assert [take(q).received.id for _ in range(20)] == [str(number) for number in range(20)]
        assert sub.dropped == {}


def test_a_subscriber_whose_queue_is_full_stops_at_once_and_gives_back_what_did_not_fit(address, send):
    q = queue.Queue(1)
    for known_as in "abc":
        send(id=known_as)
    with ep.Subscriber(address, q) as sub:
        wait_until(q.full)
    assert sub.received == 1
    assert left(address) == ["a", "b", "c"]
    with sub:
        # The first one is in the queue since before.
        assert [take(q).received.id for _ in range(3)] == ["a", "b", "c"]


def test_what_a_queue_refuses_is_counted_and_put_aside(address, send):
    q = ep.Mailbox("fault")
    send(id="a")
    send(id="b")
    with ep.Subscriber(address, q) as sub:
        wait_until(lambda: sub.dead_letters)
        assert (sub.dropped, sub.received) == ({"MailboxOverflow": 1}, 1)
    assert [(known_as, "full" in reason) for known_as, reason, _ in dead_letters(address)] == [("b", True)]


def test_what_a_queue_does_not_take_because_it_has_ended_is_left_to_others(broker, address, send):
    class Ended(queue.Queue):
        def put(self, item, block=True, timeout=None):
            # As a Mailbox whose publisher is stopped, and a queue of Python 3.13 that was shut down.
            raise getattr(queue, "ShutDown", BrokerError(address, "the publisher is stopped"))

    send(id="a")
    with ep.Subscriber(address, Ended()) as sub:
        wait_until(lambda: sub.dropped)
        assert (sub.received, sub.dead_letters) == (0, 0)
    assert left(address) == ["a"]
    assert dead_letters(address) == []


@pytest.mark.slow
def test_a_subscriber_that_pauses_takes_nothing_and_what_is_in_hand_can_be_acknowledged(broker, address, send):
    q = queue.Queue()
    with ep.Subscriber(address, q) as sub:
        send(id="a")
        item = take(q)
        sub.pause()
        # Whatever it was about to take has been taken when this is over.
        with pytest.raises(queue.Empty):
            q.get(timeout=0.3)
        send(id="b")
        item.ack()
        assert sub.is_connected
        with pytest.raises(queue.Empty):
            q.get(timeout=0.3)
        with away(broker):
            wait_until(lambda: not sub.is_connected)
        assert sub.wait_connected(WAIT_S)
        # Nor for itself: others shall have it.
        with contextlib.closing(open_channel(address)) as other:
            assert other.receive(WAIT_S).id == "b"
        sub.resume()
        assert take(q).received.id == "b"
    assert left(address) == ["b"]


# Starting and stopping


@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
def test_a_start_fails_with_a_reason_when_the_broker_is_away_or_has_no_such_place(make, broker, address):
    twin = make(address, queue.Queue())
    with away(broker), pytest.raises(BrokerError, match="can't be reached"):
        twin.start()
    with pytest.raises(BrokerError, match="no queue 'nowhere'"):
        make(f"memory://{broker}/nowhere", queue.Queue()).start()
    assert threads() == []
    with twin:
        assert twin.is_connected


@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
def test_an_address_that_can_not_be_understood_is_refused_without_its_password(make):
    with pytest.raises(AddressError, match="'kafka' is not the beginning") as raised:
        make("kafka://me:secret@host/events", queue.Queue())
    assert "secret" not in str(raised.value)
    twin = make("amqp://me:secret@127.0.0.1/events", queue.Queue())
    assert "secret" not in repr(twin) + twin.address


@pytest.mark.parametrize("options", [{"acknowledge": "never"}, {"prefetch": 0}])
def test_a_subscriber_takes_no_options_that_mean_nothing(address, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        ep.Subscriber(address, queue.Queue(), **options)


@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
def test_a_twin_is_stopped_before_it_was_started_and_twice_and_from_any_thread(make, address):
    twin = make(address, queue.Queue())
    twin.stop()
    twin.start().start()
    assert "running" in repr(twin)
    stopping = [threading.Thread(target=twin.stop) for _ in range(3)]
    for thread in stopping:
        thread.start()
    for thread in stopping:
        thread.join(WAIT_S)
    twin.stop()
    assert ("stopped" in repr(twin), twin.is_connected, threads()) == (True, False, [])
    with twin:
        assert twin.wait_connected(WAIT_S)
    assert not twin.wait_connected(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
def test_a_twin_stops_in_time_though_the_broker_does_not_answer(make, broker, address, monkeypatch):
    is_asked, answers = threading.Event(), threading.Event()

    def silent(place, prefetch, timeout_s):
        is_asked.set()
        answers.wait(WAIT_S)
        raise BrokerError(address, "it does not answer")

    twin = make(address, queue.Queue()).start()
    monkeypatch.setattr(memory, "open_channel", silent)
    with away(broker):
        assert is_asked.wait(WAIT_S)
    began = time.monotonic()
    twin.stop(0.5)
    assert time.monotonic() - began < WAIT_S / 2
    assert not twin.is_connected
    answers.set()
    wait_until(lambda: threads() == [])


def test_a_publisher_sends_what_is_queued_before_it_stops(address):
    out = queue.Queue()
    with ep.Publisher(address, out) as pub:
        for _ in range(50):
            out.put(b"x")
    assert (pub.sent, len(left(address))) == (50, 50)


def test_a_subscriber_is_stopped_by_its_own_queue_and_by_what_it_calls(broker, address, send):
    class Stops(queue.Queue):
        def put(self, item, block=True, timeout=None):
            sub.stop()
            super().put(item, block, timeout)

    q = Stops()
    sub = ep.Subscriber(address, q).start()
    send(id="a")
    assert take(q).received.id == "a"
    wait_until(lambda: threads() == [])

    other = ep.Subscriber(address, queue.Queue())
    other.on_connection = lambda is_connected, reason: is_connected or other.stop()
    other.start()
    with away(broker):
        wait_until(lambda: threads() == [])
    other.stop()


def test_a_subscriber_whose_queue_does_not_return_says_so(address, send):
    is_put, go_on = threading.Event(), threading.Event()

    class Holds(queue.Queue):
        def put(self, item, block=True, timeout=None):
            is_put.set()
            go_on.wait(WAIT_S)

    sub = ep.Subscriber(address, Holds()).start()
    send(id="a")
    assert is_put.wait(WAIT_S)
    with pytest.raises(StillRunning, match="put"):
        sub.stop(0.05)
    # It is given back all the same.
    assert left(address) == ["a"]
    go_on.set()
    wait_until(lambda: threads() == [])


@pytest.mark.slow
@pytest.mark.parametrize("make", [ep.Publisher, ep.Subscriber])
@pytest.mark.parametrize("queues", [queue.Queue, lambda: ep.Mailbox("block", 8)])
def test_a_twin_that_is_left_running_is_warned_of_and_ended(make, queues, address):
    twins = [make(address, queues()).start()]
    with pytest.warns(ResourceWarning, match=f"{make.__name__} memory://.* was left running"):
        twins.clear()
    wait_until(lambda: threads() == [])


def test_nobody_waits_for_a_publisher_that_was_forgotten(broker, address):
    out, raised = ep.Mailbox("block", 8), queue.Queue()

    def put():
        try:
            out.put(b"x")
        except BrokerError as error:
            raised.put(error)

    pubs = [ep.Publisher(address, out).start()]
    putting = threading.Thread(target=put)
    with away(broker):
        putting.start()
        wait_until(lambda: pubs[0].trouble)
        with pytest.warns(ResourceWarning, match="left running"):
            pubs.clear()
        assert isinstance(take(raised), BrokerError)
    putting.join(WAIT_S)


SCRIPT = """
import queue, epypes as ep
from epypes.transport.channels.memory import away
out, q = ep.Mailbox("block", 8), queue.Queue()
pub = ep.Publisher("memory://b/q?create=true", out).start()
sub = ep.Subscriber("memory://b/q", q).start()
out.put(b"x")
q.get(timeout=60)
print("end", flush=True)
"""


@pytest.mark.slow
def test_the_interpreter_ends_with_twins_that_run():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, "end\n"), done.stderr


FORKS = """
import os, queue, sys, epypes as ep
out, plain, q = ep.Mailbox("block", 8), queue.Queue(), queue.Queue()
pubs = [ep.Publisher("memory://b/q?create=true", taken).start() for taken in (out, plain)]
sub = ep.Subscriber("memory://b/q", q).start()
out.put(b"x")
item = q.get(timeout=60)
pid = os.fork()
if pid == 0:
    try:
        out.put(b"lost")
        os._exit(1)
    except ep.errors.BrokerError:
        pass
    item.reject("it is the parent's")
    assert sub.dead_letters == 0
    for twin in (*pubs, sub):
        twin.stop()
        assert not twin.is_connected
    with sub, ep.Publisher("memory://c/q?create=true", queue.Queue()):
        pass
    os._exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
out.put(b"y")
assert q.get(timeout=60) == b"y"
item.ack()
for twin in (*pubs, sub):
    twin.stop()
print("fine")
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_child_has_no_running_twins_and_the_parents_go_on():
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "fine\n", done.stderr


# The paper's pipelines between them


def halves(x):
    if x % 10 == 7:
        raise ValueError(f"{x} is odd")
    return x / 2


@pytest.mark.slow
def test_every_event_is_answered_once_or_put_aside_though_the_broker_goes_away(broker):
    requests, answers = f"memory://{broker}/requests?create=true", f"memory://{broker}/answers?create=true"
    out, q_in, q_out, collected = queue.Queue(), queue.Queue(), ep.Mailbox("block", 8), queue.Queue()

    def f_out(view):
        return Envelope("half", {"half": view["halves"]}, id=view.event.id, correlation_id=view.event.id)

    def pipeline():
        return ep.FullPipeline(
            "half",
            ep.CompGraph.from_functions(halves),
            q_in,
            q_out,
            lambda event: {"x": event.parts["x"]},
            f_out,
        )

    found = {}
    with (
        ep.Publisher(requests, out) as robot,
        ep.Subscriber(requests, q_in) as sub,
        ep.Publisher(answers, q_out) as pub,
        ep.Subscriber(answers, collected) as collector,
        pipeline() as pipe,
    ):
        pipe.on_error = lambda failure: None
        for number in range(200):
            out.put(Envelope("request", {"x": number}, id=f"event {number}"))
        for wanted in (60, 120):
            while len(found) < wanted:
                answer = take(collected)
                found[answer.correlation_id] = answer.parts["half"]
                answer.ack()
            with away(broker):
                # The publisher notices it when it has something to send.
                wait_until(lambda: not (sub.is_connected or collector.is_connected))
        while len(found) < 180:
            answer = take(collected)
            assert answer.correlation_id not in found
            found[answer.correlation_id] = answer.parts["half"]
            answer.ack()
        wait_until(lambda: sub.dead_letters == 20)
        assert (robot.sent, sub.received, pub.sent, pipe.failed) == (200, 200, 180, 20)
    assert found == {f"event {number}": number / 2 for number in range(200) if number % 10 != 7}
    put_aside = {known_as: reason for known_as, reason, _ in dead_letters(requests)}
    assert put_aside == {
        f"event {number}": f"halves: ValueError: {number} is odd" for number in range(200) if number % 10 == 7
    }
    assert left(requests) == left(answers) == []


def test_an_answer_that_is_not_confirmed_leaves_its_event_to_be_delivered_again(broker):
    requests, answers = f"memory://{broker}a/requests?create=true", f"memory://{broker}b/answers?create=true"
    q_in, q_out = queue.Queue(), ep.Mailbox("block", 8)
    channel = open_channel(requests)
    graph = ep.CompGraph({"same": lambda x: x}, {"same": ("x", "y")})
    pub = ep.Publisher(answers, q_out).start()
    pipe = ep.FullPipeline("same", graph, q_in, q_out, lambda event: {"x": bytes(event)}, lambda view: view["y"])
    pipe.on_error = lambda failure: None
    with ep.Subscriber(requests, q_in), pipe:
        with away(f"{broker}b"):
            channel.send((b"x",), id="a")
            wait_until(lambda: pub.trouble)
            pub.stop(0.0)
            wait_until(lambda: pipe.failed == 1)
        assert left(requests) == []
    channel.close()
    assert (left(requests), dead_letters(requests)) == (["a"], [])


def test_an_event_that_a_newer_one_supersedes_is_put_aside(address, send):
    latest = ep.Mailbox("latest")
    for known_as in "ab":
        send(id=known_as)
    with ep.Subscriber(address, latest) as sub:
        wait_until(lambda: sub.received == 2)
        assert latest.get(timeout=WAIT_S).received.id == "b"
    assert dead_letters(address) == [("a", "superseded", "1")]
