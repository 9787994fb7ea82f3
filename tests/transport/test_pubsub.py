"""What is put into a publisher's queue comes out of a subscriber's, and out of a 2019 peer's socket."""

from __future__ import annotations

import queue
from time import monotonic

import numpy as np
import pytest
import zmq

from epypes.errors import AddressError, MessageError
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope, JustBytes, encode
from tests.transport.peers import wait_until

LOCAL = "tcp://127.0.0.1:*"
WAIT_S = 60.0


def test_an_envelope_with_an_image_arrives_as_it_was():
    image = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)
    out, into = queue.Queue(), queue.Queue()
    with ZMQPublisher(LOCAL, out, "cam1") as pub, ZMQSubscriber(pub.address, into, "cam1") as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Envelope("frame", {"image": image}, source="cam1"))
        envelope = into.get(timeout=WAIT_S)
    assert np.array_equal(envelope.parts["image"], image)
    assert not envelope.parts["image"].flags.writeable
    assert (envelope.sequence, envelope.source) == (1, "cam1")
    assert 0 < envelope.epoch < envelope.published_ns


@pytest.mark.parametrize("starts", [3, pytest.param(50, marks=pytest.mark.soak)])
def test_many_starts_lose_no_first_messages_once_they_have_joined(starts):
    for _ in range(starts):
        out, into = queue.Queue(), queue.Queue()
        with ZMQPublisher(LOCAL, out, "cam1") as pub, ZMQSubscriber(pub.address, into, "cam1") as sub:
            assert sub.wait_joined(WAIT_S)
            for number in range(50):
                out.put(Envelope("x", {"n": number}))
            assert [into.get(timeout=WAIT_S).parts["n"] for _ in range(50)] == list(range(50))
            assert sub.lost == {}
            assert sub.rejected == {}


def test_topic_cam1_does_not_get_cam10():
    address = "tcp://127.0.0.1:*"
    out1, out10, into = queue.Queue(), queue.Queue(), queue.Queue()
    with ZMQSubscriber(address, into, "cam1", bind=True) as sub:
        one = ZMQPublisher(sub.address, out1, "cam1", bind=False)
        ten = ZMQPublisher(sub.address, out10, "cam10", bind=False)
        with one, ten:
            assert sub.wait_joined(WAIT_S, publishers=2)
            out10.put(Envelope("ten"))
            wait_until(lambda: ten.sent == 1)
            out1.put(Envelope("one"))
            assert into.get(timeout=WAIT_S).type == "one"
    assert into.empty()


@pytest.mark.parametrize("make", [queue.Queue, queue.SimpleQueue])
def test_bytes_and_protobuf_messages_arrive_as_bytes(make):
    out, into = make(), make()
    message = JustBytes(contents=b"\0\1", id="7")
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        for item in (b"one", bytearray(b"two"), memoryview(b"three"), message, b""):
            out.put(item)
        received = [into.get(timeout=WAIT_S) for _ in range(5)]
    assert received == [b"one", b"two", b"three", message.SerializeToString(), b""]
    assert {type(item) for item in received} == {bytes}


def test_a_peer_of_2019_gets_exactly_one_frame_and_nothing_of_a_join(peer):
    out, into = queue.Queue(), queue.Queue()
    with ZMQPublisher(LOCAL, out) as pub:
        socket = peer(zmq.SUB)
        socket.subscribe(b"")
        socket.connect(pub.address)
        assert pub.wait_for_subscriber(WAIT_S)
        # Another of ours joins meanwhile, several times.
        for _ in range(3):
            with ZMQSubscriber(pub.address, into) as sub:
                assert sub.wait_joined(WAIT_S)
        out.put(JustBytes(contents=b"x"))
        assert socket.recv_multipart() == [b"\x0a\x01x"]


def test_a_peer_of_2019_gets_nothing_of_subscribers_that_leave_while_they_join(peer):
    out = queue.Queue()
    with ZMQPublisher(LOCAL, out) as pub:
        socket = peer(zmq.SUB)
        socket.subscribe(b"")
        socket.connect(pub.address)
        assert pub.wait_for_subscriber(WAIT_S)
        # Each asks again when it has an answer, and leaves at once: often before the second one is sent.
        for number in range(500):
            topic = b"\xff\xffepypes/join/%032x" % number
            leaving = peer(zmq.SUB)
            leaving.subscribe(topic)
            leaving.connect(pub.address)
            deadline_s = monotonic() + WAIT_S
            is_answered = False
            while not is_answered:
                assert monotonic() < deadline_s
                is_answered = bool(leaving.poll(200))
                leaving.unsubscribe(topic)
                leaving.subscribe(topic)
            leaving.close()
        out.put(b"x")
        assert socket.recv_multipart() == [b"x"]


def test_a_publisher_of_2019_is_understood(peer):
    socket = peer(zmq.XPUB)
    socket.bind("tcp://127.0.0.1:*")
    into = queue.Queue()
    with ZMQSubscriber(socket.last_endpoint.decode(), into) as sub:
        # The empty topic comes first, as ZeroMQ sends subscriptions in the order of their bytes.
        assert socket.recv() == b"\x01"
        socket.send(b"one frame")
        assert into.get(timeout=WAIT_S) == b"one frame"
        assert not sub.wait_joined(0.01)


def test_a_publisher_knows_when_the_last_subscriber_has_gone():
    with ZMQPublisher(LOCAL, queue.Queue()) as pub:
        assert not pub.wait_for_subscriber(0.0)
        with ZMQSubscriber(pub.address, queue.Queue(), "a"), ZMQSubscriber(pub.address, queue.Queue(), "a"):
            assert pub.wait_for_subscriber(WAIT_S)
        wait_until(lambda: not pub.wait_for_subscriber(0.0))


def test_a_refused_oversized_message_names_its_size_and_the_limit(caplog):
    out = queue.Queue()
    with ZMQPublisher(LOCAL, out, max_message_bytes=1_000) as pub:
        out.put(bytes(1_500))
        wait_until(lambda: pub.rejected["too large"] == 1)
    assert "1,500 bytes; the limit is 1,000" in caplog.text


def test_a_full_queue_drops_and_counts_and_never_blocks():
    out, into = queue.Queue(), queue.Queue(maxsize=2)
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        for _ in range(5):
            out.put(b"x")
        wait_until(lambda: sub.dropped["queue full"] == 3)
        assert sub.received == 2


def test_loss_is_visible_as_gaps_of_a_source(peer):
    into = queue.Queue()
    with ZMQSubscriber(LOCAL, into, bind=True) as sub:
        socket = peer(zmq.XPUB)
        socket.connect(sub.address)
        assert socket.recv() == b"\x01"
        for source, sequence in (("a", 5), ("b", 1), ("a", 6), ("a", 9), ("b", 2), ("a", 10), ("b", 4)):
            socket.send_multipart(encode(Envelope("x", source=source, epoch=1, sequence=sequence)))
        for _ in range(7):
            into.get(timeout=WAIT_S)
        assert sub.lost == {("a", 1): 2, ("b", 1): 1}


def test_two_sources_of_one_publisher_are_no_loss():
    out, into = queue.Queue(), queue.Queue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        for source in ("left", "right", "left", "right"):
            out.put(Envelope("x", source=source))
        numbers = [into.get(timeout=WAIT_S).sequence for _ in range(4)]
        assert numbers == [1, 1, 2, 2]
        assert sub.lost == {}


def test_ipc_and_inproc_work_as_tcp_does(tmp_path):
    for address in (f"ipc://{tmp_path}/s", "inproc://here"):
        for _ in range(2):
            out, into = queue.Queue(), queue.Queue()
            with ZMQPublisher(address, out) as pub, ZMQSubscriber(address, into) as sub:
                assert sub.wait_joined(WAIT_S)
                out.put(b"x")
                assert into.get(timeout=WAIT_S) == b"x"
                assert pub.address == address


@pytest.mark.parametrize("kind", [ZMQPublisher, ZMQSubscriber])
def test_a_port_in_use_is_named_with_a_way_out(kind):
    with ZMQPublisher(LOCAL, queue.Queue()) as pub:
        port = pub.address.rpartition(":")[2]
        with pytest.raises(AddressError, match=rf"port {port} of 127\.0\.0\.1 is in use.*another") as caught:
            kind(pub.address, queue.Queue(), bind=True).start()
        assert caught.value.address == pub.address


@pytest.mark.parametrize("bind", [True, False])
def test_a_malformed_address_is_an_address_error(bind):
    for address in ("", "127.0.0.1:5555", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "nope://x"):
        with pytest.raises(AddressError):
            ZMQPublisher(address, queue.Queue(), bind=bind).start()


def test_an_address_of_another_machine_is_an_address_error():
    with pytest.raises(AddressError, match="no such address"):
        ZMQPublisher("tcp://192.0.2.1:5555", queue.Queue(), insecure=True).start()


def test_a_topic_that_is_none_is_refused_at_once():
    for kind in (ZMQPublisher, ZMQSubscriber):
        with pytest.raises(MessageError):
            kind(LOCAL, queue.Queue(), "t" * 2_000)


def test_undecoded_messages_are_put_as_they_came_and_their_losses_are_counted(peer):
    into = queue.Queue()
    with ZMQSubscriber(LOCAL, into, bind=True, undecoded=True) as sub:
        socket = peer(zmq.XPUB)
        socket.connect(sub.address)
        assert socket.recv() == b"\x01"
        socket.send_multipart([b"no", b"envelope"])
        socket.send_multipart(encode(Envelope("x", source="s" * 2_000, epoch=1, sequence=1)))
        for sequence in (5, 7):
            socket.send_multipart(encode(Envelope("x", source="a", epoch=1, sequence=sequence)))
        garbage, endless, first, second = (into.get(timeout=WAIT_S) for _ in range(4))
        assert (garbage.envelope, [*map(bytes, garbage.frames)]) == (None, [b"no", b"envelope"])
        assert (endless.envelope, endless.error.reason, first.error) == (None, "bad source", None)
        assert garbage.error is not None
        assert [first.envelope.sequence, second.envelope.sequence] == [5, 7]
        assert sub.lost == {("a", 1): 1}
        first.ack()


def test_what_arrives_while_a_subscriber_is_paused_is_dropped_and_shows_as_a_gap():
    out, into = Mailbox(), queue.Queue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into, heartbeat_s=3_600) as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Envelope("x", source="a"))
        assert into.get(timeout=WAIT_S).sequence == 1
        sub.pause()
        paused_s = monotonic()
        out.put(Envelope("x", source="a"))
        wait_until(lambda: sub.last_heard_s < monotonic() - paused_s)
        sub.resume()
        out.put(Envelope("x", source="a"))
        item = into.get(timeout=WAIT_S)
        assert item.sequence == 3
        assert list(sub.lost.values()) == [1]
