"""Peers that are made to do harm: they are dropped, and honest peers go on (failures 74, 75 and 78)."""

from __future__ import annotations

import itertools
import os
import queue
import threading

import numpy as np
import psutil
import pytest
import zmq

from epypes.errors import StillRunning
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope, encode
from tests.transport import zmtp
from tests.transport.peers import LOCAL, PUBLISHER, line_of, process, publish, wait_until

WAIT_S = 60.0
MB = 1024**2

# Prints its address, and then the type of each envelope that it receives.
BOUND = """
import queue, sys
from epypes.transport import ZMQSubscriber
received = queue.SimpleQueue()
with ZMQSubscriber("tcp://127.0.0.1:*", received, bind=True, max_message_bytes=int(sys.argv[1])) as sub:
    print(sub.address, flush=True)
    while True:
        print(received.get().type, flush=True)
"""


def resident_bytes(started) -> int:
    return psutil.Process(started.pid).memory_info().rss


def send_until_dropped(peer, pieces) -> int:
    """Return how many bytes went out before the peer was dropped."""
    sent = 0
    try:
        for piece in pieces:
            peer.sendall(piece)
            sent += len(piece)
    except ConnectionError:
        return sent
    assert zmtp.is_dropped(peer)
    return sent


def subscriptions(count, size):
    for number in range(count):
        yield zmtp.frame(b"\x01%010d" % number + os.urandom(size - 10))


@pytest.mark.slow
def test_20000_subscriptions_of_one_client_do_not_eat_the_publishers_memory_and_others_join():
    with process(PUBLISHER, LOCAL) as publisher:
        address = line_of(publisher)
        before = resident_bytes(publisher)
        with zmtp.connected(address, b"SUB") as peer:
            send_until_dropped(peer, subscriptions(20_000, 1_000))
        into = queue.SimpleQueue()
        with ZMQSubscriber(address, into, "t") as honest:
            assert honest.wait_joined(WAIT_S)
            publish(publisher, 3)
            assert [into.get(timeout=WAIT_S).parts["n"] for _ in range(3)] == [1, 2, 3]
        # They took 1.9 GB.
        assert resident_bytes(publisher) - before < 500 * MB


def test_a_client_with_more_subscriptions_than_are_allowed_is_dropped(caplog):
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out, "t") as pub, ZMQSubscriber(pub.address, into, "t") as honest:
        assert honest.wait_joined(WAIT_S)
        with zmtp.connected(pub.address, b"SUB") as peer:
            send_until_dropped(peer, subscriptions(1_100, 12))
        out.put(Envelope("after"))
        assert into.get(timeout=WAIT_S).type == "after"
    assert "dropped a peer: it holds too many subscriptions" in caplog.text


def test_a_subscription_that_is_longer_than_any_topic_drops_the_client():
    with ZMQPublisher(LOCAL, queue.SimpleQueue()) as pub, zmtp.connected(pub.address, b"SUB") as peer:
        peer.sendall(zmtp.frame(b"\x01" + bytes(4_000)))
        assert zmtp.is_dropped(peer)


def test_a_thousand_subscriptions_of_an_honest_client_are_kept(peer):
    out = queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub:
        subscriber = peer(zmq.SUB, sndhwm=2_000, rcvtimeo=int(WAIT_S * 1_000))
        for number in range(1_000):
            subscriber.subscribe(b"topic %d/" % number)
        subscriber.connect(pub.address)
        # They are sent in the order of their bytes.
        last = max(b"topic %d/" % number for number in range(1_000))
        while not subscriber.poll(20):
            out.put((last, b"are you there?"))
        assert subscriber.recv_multipart() == [last, b"are you there?"]


@pytest.mark.slow
def test_an_unfinished_multipart_message_does_not_eat_the_subscribers_memory_and_others_are_heard():
    with process(BOUND, str(8 * MB)) as subscriber:
        address = line_of(subscriber)
        before = resident_bytes(subscriber)
        with zmtp.connected(address, b"PUB") as peer:
            part = zmtp.frame(bytes(MB), zmtp.MORE)
            send_until_dropped(peer, itertools.chain([zmtp.frame(b"/", zmtp.MORE)], itertools.repeat(part, 3_000)))
        with zmq.Context() as context, context.socket(zmq.XPUB) as honest:
            honest.rcvtimeo = int(WAIT_S * 1_000)
            honest.linger = 0
            honest.connect(address)
            assert honest.recv() == b"\x01"
            honest.send_multipart(encode(Envelope("after")))
            assert line_of(subscriber) == "after"
        # It took 3 GB.
        assert resident_bytes(subscriber) - before < 1_000 * MB


@pytest.mark.slow
def test_a_sender_of_more_than_one_message_may_hold_is_kept_as_long_as_its_messages_end(peer):
    into = queue.SimpleQueue()
    image = np.zeros(MB, np.uint8)
    with ZMQSubscriber(LOCAL, into, bind=True, max_message_bytes=2 * MB) as sub:
        sender = peer(zmq.XPUB, sndhwm=1_000)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        frames = encode(Envelope("image", {"image": image}))
        for _ in range(200):
            sender.send_multipart(frames)
        for _ in range(200):
            assert into.get(timeout=WAIT_S).parts["image"].nbytes == MB
        assert sub.rejected == {}


def test_a_client_of_a_protocol_that_names_no_connection_is_dropped_and_others_stay(caplog):
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    # ZMTP 2.0: signature, revision, socket type SUB, an empty identity, and the subscription.
    old = b"\xff" + bytes(7) + b"\x01\x7f" + b"\x01\x02" + b"\x00\x00" + b"\x00\x04\x01abc"
    with ZMQPublisher(LOCAL, out, "t") as pub, ZMQSubscriber(pub.address, into, "t") as honest:
        assert honest.wait_joined(WAIT_S)
        with zmtp.connection(pub.address) as peer:
            peer.sendall(old)
            assert zmtp.is_dropped(peer)
        out.put(Envelope("after"))
        assert into.get(timeout=WAIT_S).type == "after"
    assert "older than ZMTP 3.0" in caplog.text


def test_many_bad_messages_make_a_few_log_lines_and_each_is_counted(peer, caplog):
    into = queue.SimpleQueue()
    with ZMQSubscriber(LOCAL, into, bind=True) as sub:
        sender = peer(zmq.XPUB)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        for _ in range(900):
            sender.send_multipart([b"/", b"\xff" * 1_000])
        sender.send_multipart(encode(Envelope("good")))
        assert into.get(timeout=WAIT_S).type == "good"
        assert sub.rejected == {"no envelope": 900}
    # One, and another every five seconds.
    assert len(caplog.records) < 20


def test_a_bad_message_that_is_long_makes_a_short_log_line(peer, caplog):
    with ZMQSubscriber(LOCAL, queue.SimpleQueue(), bind=True) as sub:
        sender = peer(zmq.XPUB)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        sender.send_multipart([b"/", encode(Envelope("x", {"n" * MB: {1}}))[1][:-1] + b"\x7f"])
        wait_until(lambda: sub.rejected, WAIT_S)
    assert all(len(record.message) < 2_000 for record in caplog.records)


def test_messages_that_a_slow_subscriber_loses_are_noticed_by_the_publisher_and_the_others_get_all(caplog):
    out, into = Mailbox(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out, "t", high_water_mark=20) as pub,
        ZMQSubscriber(pub.address, into, "t") as fast,
        zmtp.connected(pub.address, b"SUB") as slow,
    ):
        assert fast.wait_joined(WAIT_S)
        slow.sendall(zmtp.frame(b"\x01"))
        sent = 0
        # It reads nothing: the kernel's buffers fill up, and then the publisher's queue.
        while not pub.slow_subscribers:
            out.put(Envelope("frame", {"image": np.zeros(MB, np.uint8)}, source="camera"))
            sent += 1
            assert into.get(timeout=WAIT_S).sequence == sent
        assert pub.sent == sent
        assert fast.lost == {}
    assert sum("too slow" in record.message for record in caplog.records) == 1


@pytest.mark.slow
def test_large_messages_are_not_decoded_on_the_io_thread_and_the_order_is_kept(peer):
    class Noting:
        def __init__(self):
            self.items = queue.SimpleQueue()

        def put(self, item, *, block):
            self.items.put((item.type, threading.current_thread().name))

    noting = Noting()
    with ZMQSubscriber(LOCAL, noting, bind=True) as sub:
        sender = peer(zmq.XPUB)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        values = {"values": {str(number): number for number in range(20_000)}}
        for _ in range(10):
            sender.send_multipart(encode(Envelope("large", values)))
            sender.send_multipart(encode(Envelope("small")))
        arrived = [noting.items.get(timeout=WAIT_S) for _ in range(20)]
        assert [kind for kind, _ in arrived] == ["large", "small"] * 10
        assert not [thread for kind, thread in arrived if kind == "large" and thread == "epypes-io"]
        assert sub.received == 20
        assert sub.rejected == {}
        sender.send_multipart(encode(Envelope("last")))
        assert noting.items.get(timeout=WAIT_S)[0] == "last"


def test_large_messages_that_come_faster_than_they_are_decoded_are_dropped_beyond_a_bound_and_counted(peer):
    class Held:
        def __init__(self):
            self.go_on, self.items = threading.Event(), []

        def put(self, item, *, block):
            assert self.go_on.wait(WAIT_S)
            self.items.append(item.id)

    held = Held()
    with ZMQSubscriber(LOCAL, held, bind=True, max_message_bytes=2 * MB) as sub:
        sender = peer(zmq.XPUB)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        for number in range(5):
            large = Envelope("large", {"bytes": bytes(600_000)}, id=str(number))
            sender.send_multipart(encode(large, inline_below=MB))
        wait_until(lambda: sub.rejected == {"too many at once": 2})
        held.go_on.set()
        wait_until(lambda: held.items == ["0", "1", "2"])
        sender.send_multipart(encode(Envelope("small", id="5")))
        wait_until(lambda: held.items[-1] == "5")


def test_a_large_message_for_which_the_system_has_no_thread_is_counted_and_the_next_one_is_taken(peer, monkeypatch):
    start, failures, into = threading.Thread.start, ["can't start new thread"], queue.SimpleQueue()

    def fail_once(thread):
        if thread.name == "epypes-decoding" and failures:
            raise RuntimeError(failures.pop())
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", fail_once)
    with ZMQSubscriber(LOCAL, into, bind=True, max_message_bytes=2 * MB) as sub:
        sender = peer(zmq.XPUB)
        sender.connect(sub.address)
        assert sender.recv() == b"\x01"
        for known_as in "ab":
            sender.send_multipart(encode(Envelope("e", {"b": bytes(1_500_000)}, id=known_as), inline_below=2 * MB))
        assert into.get(timeout=WAIT_S).id == "b"
        assert sub.rejected == {"no thread": 1}


def test_stop_waits_for_the_message_that_is_being_decoded_and_nothing_comes_after_it(peer):
    class Held:
        def __init__(self):
            self.began, self.go_on, self.taken = threading.Event(), threading.Event(), 0

        def put(self, item, *, block):
            self.began.set()
            assert self.go_on.wait(WAIT_S)
            self.taken += 1

    held = Held()
    sub = ZMQSubscriber(LOCAL, held, bind=True).start()
    sender = peer(zmq.XPUB)
    sender.connect(sub.address)
    assert sender.recv() == b"\x01"
    for _ in range(3):
        sender.send_multipart(encode(Envelope("large", {"text": "a" * 100_000})))
    assert held.began.wait(WAIT_S)
    with pytest.raises(StillRunning):
        sub.stop(timeout_s=0.05)
    held.go_on.set()
    wait_until(lambda: not [thread for thread in threading.enumerate() if thread.name == "epypes-decoding"], WAIT_S)
    assert held.taken == 1
