"""A subscriber distinguishes a publisher that has stopped from one that is idle."""

from __future__ import annotations

import queue
import signal
import threading

import pytest
import zmq

from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope
from tests.transport.peers import LOCAL, PUBLISHER, WAIT_S, line_of, process, publish, wait_until

pytestmark = pytest.mark.slow  # each waits for heartbeats


class Changes:
    """The changes that on_stale was called with."""

    def __init__(self) -> None:
        self.seen: queue.SimpleQueue = queue.SimpleQueue()

    def __call__(self, is_stale: bool) -> None:
        self.seen.put(is_stale)


def test_a_stopped_publisher_is_reported_stale_and_recovers():
    changes, into = Changes(), queue.SimpleQueue()
    with process(PUBLISHER, LOCAL) as peer, ZMQSubscriber(line_of(peer), into, "t", heartbeat_s=0.5) as sub:
        sub.on_stale = changes
        assert sub.wait_joined(WAIT_S)
        publish(peer, 1)
        assert into.get(timeout=WAIT_S).parts["n"] == 1
        assert not sub.is_stale
        peer.send_signal(signal.SIGSTOP)
        assert changes.seen.get(timeout=WAIT_S) is True
        assert sub.is_stale
        peer.send_signal(signal.SIGCONT)
        assert changes.seen.get(timeout=WAIT_S) is False
        publish(peer, 1)
        assert into.get(timeout=WAIT_S).parts["n"] == 2
        assert not sub.is_stale
        assert sub.lost == {}


def test_an_idle_publisher_is_not_stale():
    changes = Changes()
    with ZMQPublisher(LOCAL, queue.SimpleQueue()) as pub:
        with ZMQSubscriber(pub.address, queue.SimpleQueue(), heartbeat_s=0.5) as sub:
            sub.on_stale = changes
            assert sub.wait_joined(WAIT_S)
            with pytest.raises(queue.Empty):
                changes.seen.get(timeout=1.7)
            assert sub.last_heard_s < 1.5
        assert sub.last_heard_s is None


def test_a_publisher_that_has_ended_is_stale_until_another_comes():
    changes = Changes()
    out = queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub:
        address = pub.address
        sub = ZMQSubscriber(address, queue.SimpleQueue(), heartbeat_s=0.05).start()
        sub.on_stale = changes
        assert sub.wait_joined(WAIT_S)
    with sub:
        assert changes.seen.get(timeout=WAIT_S) is True
        with ZMQPublisher(address, out):
            assert changes.seen.get(timeout=WAIT_S) is False


def test_a_subscriber_that_never_met_a_publisher_waits_and_is_not_stale():
    changes = Changes()
    with ZMQSubscriber(LOCAL, queue.SimpleQueue(), bind=True, heartbeat_s=0.02) as sub:
        sub.on_stale = changes
        with ZMQPublisher(LOCAL, queue.SimpleQueue()) as pub:
            other = ZMQSubscriber(pub.address, queue.SimpleQueue(), heartbeat_s=0.05).start()
            assert other.wait_joined(WAIT_S)
        # The same thread checks both.
        with other:
            wait_until(lambda: other.is_stale)
        assert changes.seen.empty()
        assert sub.last_heard_s is None


def test_an_on_stale_that_raises_is_logged_and_the_input_goes_on(caplog):
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub:
        address = pub.address
        sub = ZMQSubscriber(address, into, heartbeat_s=0.05).start()
        sub.on_stale = lambda is_stale: 1 / 0
        assert sub.wait_joined(WAIT_S)
    with sub:
        wait_until(lambda: sub.is_stale)
        with ZMQPublisher(address, out) as pub:
            wait_until(lambda: not sub.is_stale)
            out.put(b"x")
            assert into.get(timeout=WAIT_S) == b"x"
    assert "on_stale itself failed" in caplog.text


def test_a_peer_of_2019_sees_nothing_of_heartbeats():
    context = zmq.Context()
    context.linger = 0
    out = queue.SimpleQueue()
    try:
        with ZMQPublisher(LOCAL, out) as pub:
            plain = context.socket(zmq.SUB)
            plain.subscribe(b"")
            plain.connect(pub.address)
            assert pub.wait_for_subscriber(WAIT_S)
            with ZMQSubscriber(pub.address, queue.SimpleQueue(), heartbeat_s=0.02) as sub:
                assert sub.wait_joined(WAIT_S)
                assert not plain.poll(400)
                out.put(b"x")
                assert plain.recv_multipart() == [b"x"]
    finally:
        context.destroy(linger=0)


def test_nothing_is_lost_while_heartbeats_are_asked_for():
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out, "t") as pub,
        ZMQSubscriber(pub.address, into, "t", heartbeat_s=0.002) as sub,
    ):
        assert sub.wait_joined(WAIT_S)
        for number in range(300):
            out.put(Envelope("x", {"n": number}))
            assert into.get(timeout=WAIT_S).parts["n"] == number
            # Silence between, long enough to be asked about now and then.
            threading.Event().wait(0.003 if number % 10 == 0 else 0)
        assert sub.lost == {}
