"""A publisher to a broker sends everything once and in order, or says what it has not sent."""

from __future__ import annotations

import itertools
import queue
import threading
import time

import pytest

import epypes as ep
from epypes.errors import BrokerError, MessageError
from epypes.transport.memory import away, queued
from epypes.transport.publisher import Publisher
from epypes.transport.subscriber import Subscriber
from epypes.wire import EncodedEnvelope, Envelope, decode
from tests.transport.peers import WAIT_S, threads, wait_until

_numbers = itertools.count()


@pytest.fixture
def broker():
    return f"publisher{next(_numbers)}"


@pytest.fixture
def address(broker):
    return f"memory://{broker}/events?create=true"


def ids(address):
    return [message.id for message in queued(address)]


def bodies(address):
    return [b"".join(message.frames) for message in queued(address)]


def take(q):
    return q.get(timeout=WAIT_S)


def test_items_get_the_ids_of_their_envelopes_or_new_ones(address):
    out = queue.Queue()
    with Publisher(address, out, "cam1") as pub:
        out.put(Envelope("vision", {"x": 1}, id="a"))
        out.put(b"2019")
        wait_until(lambda: pub.sent == 2)
        assert (pub.is_connected, pub.trouble, pub.waiting) == (True, "", 0)
    first, second = queued(address)
    envelope = decode(first.frames)
    assert (first.id, envelope.sequence, envelope.parts["x"]) == ("a", 1, 1)
    assert len(second.id) == 32


def test_send_carries_id_and_headers(address):
    with Publisher(address) as pub:
        pub.send((b"a", b"b"), id="1", headers={"h": "v"})
        pub.send(EncodedEnvelope.encode(Envelope("e", id="2"), "elsewhere"))
        pub.send(EncodedEnvelope.encode(Envelope("e", id="2"), "elsewhere"), id="3")
    message, *others = queued(address)
    assert (message.frames, message.id, message.headers) == ((b"a", b"b"), "1", {"h": "v"})
    assert [each.id for each in others] == ["2", "3"]


def test_an_envelope_that_is_refused_takes_no_number(address):
    with Publisher(address) as pub:
        with pytest.raises(MessageError, match="a space at an end"):
            pub.send(Envelope("e"), id=" a ")
        pub.send(Envelope("e"), id="b")
    assert [decode(message.frames).sequence for message in queued(address)] == [1]


def test_what_is_sent_is_what_it_was_when_it_was_put(broker, address):
    np = pytest.importorskip("numpy")
    image = np.zeros((100, 100), np.uint8)
    with Publisher(address) as pub:
        with away(broker):
            wait_until(lambda: not pub.is_connected)
            pub.send(Envelope("e", {"image": image}))
            image[:] = 1
        wait_until(lambda: pub.sent == 1)
    assert not decode(queued(address)[0].frames).parts["image"].any()


@pytest.mark.slow
def test_what_is_put_during_an_outage_is_sent_in_order_afterwards(broker, address):
    out = queue.Queue()
    with Publisher(address, out) as pub:
        out.put(Envelope("e", id="a"))
        wait_until(lambda: pub.sent == 1)
        with away(broker):
            for known_as in "bcd":
                out.put(Envelope("e", id=known_as))
            wait_until(lambda: "can't be reached" in pub.trouble)
            assert not pub.is_connected
        wait_until(lambda: pub.sent == 4)
        assert (pub.reconnects, pub.rejected, pub.trouble) == (1, {}, "")
    assert ids(address) == list("abcd")


def test_a_put_into_a_mailbox_returns_when_the_broker_has_confirmed(broker, address):
    out = ep.Mailbox("latest")
    with Publisher(address, out) as pub:
        out.put(b"first")
        assert pub.sent == 1
        putting = threading.Thread(target=out.put, args=(b"second",))
        with away(broker):
            putting.start()
            wait_until(lambda: pub.waiting == 1)
            assert (putting.is_alive(), pub.sent) == (True, 1)
        putting.join(WAIT_S)
        assert (putting.is_alive(), pub.sent) == (False, 2)


@pytest.mark.parametrize("make", [lambda: ep.Mailbox("block", 8), queue.Queue])
def test_a_publisher_that_is_stopped_during_an_outage_counts_what_it_has_not_sent(broker, address, make):
    out, raised = make(), []

    def put():
        try:
            out.put(b"lost")
        except BrokerError as error:
            raised.append(error)

    pub = Publisher(address, out).start()
    putting = threading.Thread(target=put)
    with away(broker):
        putting.start()
        wait_until(lambda: pub.waiting)
        begin_s = time.monotonic()
        pub.stop(0.2)
        assert time.monotonic() - begin_s < WAIT_S / 2
        putting.join(WAIT_S)
        assert not putting.is_alive()
    assert pub.rejected == {"not sent": 1}
    assert len(raised) == isinstance(out, ep.Mailbox)
    assert "memory://" in str(raised or "memory://")
    wait_until(lambda: threads() == [])


def test_a_confirmation_that_puts_more_does_not_wait_for_itself(address):
    out, is_put = ep.Mailbox("block", 8), threading.Event()

    def confirmed(error):
        out.put(b"second")
        is_put.set()

    with Publisher(address, out) as pub:
        pub.send(b"first", confirmed=confirmed)
        assert is_put.wait(WAIT_S)
        wait_until(lambda: pub.sent == 2)
    assert bodies(address) == [b"first", b"second"]


def test_a_publisher_that_has_nothing_to_do_notices_an_outage_and_can_be_stopped_by_its_listener(broker, address):
    pub, changes = Publisher(address, queue.Queue()), []
    pub.on_connection = lambda *change: changes.append(change)
    with pub:
        with away(broker):
            wait_until(lambda: not pub.is_connected)
            wait_until(lambda: "the broker" in pub.trouble)
        assert pub.wait_connected(WAIT_S)
        assert (pub.trouble, pub.reconnects) == ("", 1)
        pub.on_connection = lambda is_connected, reason: pub.stop()
        with away(broker):
            wait_until(lambda: "stopped" in repr(pub))
    assert (pub.is_connected, pub.trouble) == (False, "")
    assert [is_connected for is_connected, _ in changes] == [True, False, True]


def test_no_put_waits_for_a_publisher_that_was_forgotten(broker, address):
    out, raised = ep.Mailbox("block", 8), queue.Queue()

    def put():
        try:
            out.put(b"x")
        except BrokerError as error:
            raised.put(error)

    pubs = [Publisher(address, out).start()]
    putting = threading.Thread(target=put)
    with away(broker):
        putting.start()
        wait_until(lambda: pubs[0].waiting)
        with pytest.warns(ResourceWarning, match="left running"):
            pubs.clear()
        assert isinstance(take(raised), BrokerError)
    putting.join(WAIT_S)


# The paper's pipelines between them


def test_an_answer_that_is_not_confirmed_leaves_its_event_to_be_delivered_again(broker):
    requests, answers = f"memory://{broker}a/requests?create=true", f"memory://{broker}b/answers?create=true"
    q_in, q_out = queue.Queue(), ep.Mailbox("block", 8)
    graph = ep.CompGraph({"same": lambda x: x}, {"same": ("x", "y")})
    pub = Publisher(answers, q_out).start()
    pipe = ep.FullPipeline("same", graph, q_in, q_out, lambda event: {"x": bytes(event)}, lambda view: view["y"])
    pipe.on_error = lambda failure: None
    with Subscriber(requests, q_in) as sub, Publisher(requests) as robot, pipe, away(f"{broker}b"):
        robot.send(b"x", id="a")
        wait_until(lambda: pub.waiting)
        sub.pause()
        pub.stop(0.0)
        wait_until(lambda: pipe.failed == 1)
    assert ids(requests) == ["a"]
