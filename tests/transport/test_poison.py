"""A peer that sends nonsense stops no subscriber, and each of its messages is counted."""

from __future__ import annotations

import queue
import random
from collections import Counter

import numpy as np
import pytest
import zmq

from epypes.errors import MessageError
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope, decode, encode
from tests.wire.mutants import mutate_description, mutate_frames

WAIT_S = 60.0
# Fewer than what a socket keeps, so that none is lost on the way.
BATCH = 500


@pytest.fixture
def poisoner():
    """A socket of a peer that sends what it likes to a subscriber, and the way to connect it."""
    context = zmq.Context()
    context.linger = 0
    socket = context.socket(zmq.XPUB)
    socket.rcvtimeo = int(WAIT_S * 1000)

    def connect(address: str) -> zmq.Socket:
        socket.connect(address)
        assert socket.recv() == b"\x01"
        return socket

    yield connect
    socket.close(linger=0)
    context.term()


def sample() -> list[bytes]:
    parts = {
        "image": np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3),
        "depth": np.ones((30, 40), "<u2"),
        "mask": np.eye(20, dtype=bool),
        "names": np.array(["left", "right"]),
        "points": [(1.5, 2), {"size": np.float32(3)}, None],
        "jpeg": b"\xff\xd8" + bytes(500),
    }
    envelope = Envelope("edges", parts, source="cam1", epoch=1, attributes={"exposure": 0.5}, timings={"blur": 100})
    return [bytes(frame) for frame in encode(envelope, "cam1", inline_below=64)]


def expected_of(frames: list[bytes]) -> str | type:
    """What the decoder makes of frames: a reason, or the type of what is put."""
    if len(frames) == 1:
        return bytes
    try:
        decode(frames)
    except MessageError as error:
        return error.reason
    return Envelope


def until_good(into):
    """Yield what arrives before the envelope that ends a batch."""
    while not (isinstance(item := into.get(timeout=WAIT_S), Envelope) and item.type == "good"):
        yield item


@pytest.mark.slow
@pytest.mark.parametrize("count", [1_000, pytest.param(100_000, marks=pytest.mark.soak)])
def test_each_broken_message_through_a_socket_is_counted_and_the_next_good_one_arrives(poisoner, caplog, count):
    rng, good = random.Random(35), sample()
    expected: Counter[str | type] = Counter()
    arrived: Counter[str | type] = Counter()
    into = queue.SimpleQueue()
    caplog.set_level("ERROR", "epypes.transport")
    with ZMQSubscriber("tcp://127.0.0.1:*", into, bind=True) as sub:
        socket = poisoner(sub.address)
        for start in range(0, count, BATCH):
            for number in range(start, start + BATCH):
                mutation = mutate_description if number % 3 == 0 else mutate_frames
                # ZeroMQ knows no message without frames.
                frames = mutation(good, rng) or [b""]
                expected[expected_of(frames)] += 1
                socket.send_multipart(frames)
            socket.send_multipart(encode(Envelope("good")))
            arrived.update(map(type, until_good(into)))
        assert sub.received == sum(arrived.values()) + count // BATCH
        assert sub.rejected == {reason: n for reason, n in expected.items() if isinstance(reason, str)}
        assert arrived == {kind: n for kind, n in expected.items() if isinstance(kind, type)}
        assert sum(sub.rejected.values()) + sum(arrived.values()) == count
        assert not sub.dropped
    assert len(sub.rejected) >= 12, "many kinds of broken messages were tried"
    assert not caplog.records, "no reader failed"


@pytest.mark.parametrize("undecoded", [False, True])
def test_of_a_message_of_too_many_or_too_large_frames_none_is_kept_and_the_next_one_arrives(poisoner, undecoded):
    into = queue.SimpleQueue()
    with ZMQSubscriber("tcp://127.0.0.1:*", into, bind=True, max_message_bytes=100_000, undecoded=undecoded) as sub:
        socket = poisoner(sub.address)
        socket.send_multipart([b"/", *[bytes(90_000)] * 20])
        socket.send_multipart([b"/", *[b""] * 5_000])
        socket.send_multipart(encode(Envelope("good")))
        item = into.get(timeout=WAIT_S)
        assert len(item.frames) == 2 if undecoded else item.type == "good"
        assert sub.rejected == {"too large": 1, "too many frames": 1}


def test_false_answers_to_a_join_are_counted_if_they_are_none_and_bounded_if_they_are(poisoner):
    into = queue.SimpleQueue()
    with ZMQSubscriber("tcp://127.0.0.1:*", into, bind=True) as sub:
        context = zmq.Context()
        # Otherwise the garbage collector waits for ever for what was not sent when this test fails.
        context.linger = 0
        socket = context.socket(zmq.XPUB)
        socket.connect(sub.address)
        topics = [socket.recv()[1:] for _ in range(2)]
        join = max(topics)
        socket.send_multipart([join, bytes(100_000)])
        for number in range(2_000):
            socket.send_multipart([join, number.to_bytes(16, "little")])
            # Not more at once than a socket keeps.
            if number % BATCH == 0:
                socket.send_multipart(encode(Envelope("good")))
                assert into.get(timeout=WAIT_S).type == "good"
        assert sub.rejected.total() == 1
        assert sub.wait_joined(WAIT_S, publishers=100)
        assert not sub.wait_joined(0.0, publishers=1_000)
        socket.close(linger=0)
        context.term()


def test_a_source_with_an_endless_name_is_rejected_on_both_sides(poisoner):
    into, out = queue.SimpleQueue(), Mailbox()
    with ZMQSubscriber("tcp://127.0.0.1:*", into, bind=True) as sub:
        socket = poisoner(sub.address)
        socket.send_multipart(encode(Envelope("x", source="s" * 2_000, sequence=1, epoch=1)))
        socket.send_multipart(encode(Envelope("x", source="s" * 1_024, sequence=1, epoch=1)))
        assert len(into.get(timeout=WAIT_S).source) == 1_024
        assert sub.rejected == {"bad source": 1}
    with ZMQPublisher("tcp://127.0.0.1:*", out) as pub:
        out.put(Envelope("x", source="s" * 2_000))
        assert pub.rejected == {"bad source": 1}
