"""What subscribers and publishers promise over middleware without a broker."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading

import numpy as np
import pytest

from epypes.errors import BrokerError
from epypes.pipeline import Mailbox
from epypes.transport import Player, Publisher, Recorder, Subscriber
from epypes.transport.address import open_channel, parse_address
from epypes.transport.channel import ERROR_REASON, ChannelOptions
from epypes.transport.peers.channel import PeerChannel, PeerSession
from epypes.wire import Envelope
from tests.transport.channels import ABSENT_S, PEERS, WAIT_S, OfPeers, Receiver, Sender, body, join
from tests.transport.peers import PEER_PUBLISHER, line_of, process, publish, wait_until

STUCK = """
import os, sys, threading
from epypes.transport import Subscriber
class Stuck:
    def put(self, item, **more):
        os.write(1, b"took\\n")
        threading.Event().wait()
with Subscriber(sys.argv[1], Stuck()) as sub:
    assert sub.wait_joined(60)
    os.write(1, b"joined\\n")
    threading.Event().wait()
"""
LEFT_OPEN = """
import sys
from epypes.transport import Publisher, Subscriber
class Printing:
    def put(self, item, **more):
        print(item)
subscriber, publisher = Subscriber(sys.argv[1], Printing()).start(), Publisher(sys.argv[1]).start()
assert subscriber.wait_joined(60) and publisher.wait_for_subscriber(60)
for _ in range(1_000):
    publisher.send(bytes(10))
print("end")
"""


class Held(PeerSession):
    """A session whose middleware is the test; it opens when it may."""

    def __init__(self, on_stale=None):
        self.may_open, self.sent = threading.Event(), []
        super().__init__(parse_address("dds://7/held"), ChannelOptions(on_stale=on_stale))

    def open(self, is_receiver):
        assert self.may_open.wait(WAIT_S)

    def send(self, frames, id, headers):  # noqa: A002 - as the method that it overrides
        self.sent.append(bytes(frames[0]))

    def close(self, timeout_s):
        pass


@pytest.fixture(params=PEERS)
def place(request, name):
    """An address of each middleware in turn."""
    return OfPeers(request.param).address(name)


def joined(subscriber, publisher):
    assert subscriber.wait_joined(WAIT_S)
    assert publisher.wait_for_subscriber(WAIT_S)


def test_an_image_arrives_at_the_subscribers_of_its_topic_with_its_number(place):
    image = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)
    left, right, out = queue.Queue(), queue.Queue(), Mailbox("drop_oldest", 8)
    with (
        Subscriber(place, left, "cam/left", ordered=True) as of_left,
        Subscriber(place, right, "cam/right") as of_right,
        Publisher(place, out, "cam/left") as publisher,
    ):
        joined(of_left, publisher)
        joined(of_right, publisher)
        assert (of_left.is_stale, of_left.is_connected, publisher.is_connected) == (False, True, True)
        for _ in range(3):
            out.put(Envelope("frame", {"image": image}, source="camera"))
        came = [left.get(timeout=WAIT_S) for _ in range(3)]
        assert [envelope.sequence for envelope in came] == [1, 2, 3]
        assert np.array_equal(came[0].parts["image"], image)
        assert not came[0].parts["image"].flags.writeable
        assert (publisher.sent, of_left.received, sum(of_left.lost.values())) == (3, 3, 0)
        assert of_left.last_heard_s < WAIT_S
        assert right.empty()


def test_what_a_full_queue_and_a_paused_subscriber_do_not_take_is_counted(place):
    small = queue.Queue(1)
    with Subscriber(place, small) as subscriber, Publisher(place) as publisher:
        joined(subscriber, publisher)
        for _ in range(5):
            publisher.send(Envelope("x", source="s"))
        wait_until(lambda: subscriber.dropped["queue full"] == 4)
        assert small.get(timeout=WAIT_S).sequence == 1
        subscriber.pause()
        publisher.send(Envelope("x", source="s"))
        with pytest.raises(queue.Empty):
            small.get(timeout=ABSENT_S)
        subscriber.resume()
        publisher.send(Envelope("x", source="s"))
        assert small.get(timeout=WAIT_S).sequence == 7
        assert [*subscriber.lost.values()] == [1]


def test_a_handler_that_fails_or_is_far_behind_loses_messages_which_are_counted(place, opened, monkeypatch, caplog):
    monkeypatch.setattr("epypes.transport.peers.channel.MOST_BACKLOG_BYTES", 1_000_000)
    room, taken = threading.Semaphore(0), []

    def take(delivery):
        taken.append(delivery.headers.get(ERROR_REASON) or len(delivery.frames[0]))
        room.acquire(timeout=WAIT_S)
        if len(taken) == 1:
            raise RuntimeError("a bug")

    channel = open_channel(place, ChannelOptions())
    channel.open(take)
    sender = opened(Sender, place)
    assert sender.channel.subscriptions.wait(WAIT_S)
    sender.send(b"first")
    wait_until(lambda: taken)
    for _ in range(10):
        sender.send(bytes(300_000))
    wait_until(lambda: channel.dropped == 7)
    room.release(100)
    wait_until(lambda: len(taken) == 11)
    channel.close()
    assert sorted(taken, key=str) == [300_000] * 3 + [5] + ["too many at once"] * 7
    assert "could not be taken" in caplog.text


def test_a_subscriber_is_stale_while_its_killed_publisher_is_gone(place):
    arrived, changes = queue.Queue(), queue.SimpleQueue()
    subscriber = Subscriber(place, arrived)
    subscriber.on_stale = changes.put

    def publish_and_be_killed():
        with process(PEER_PUBLISHER, place) as other:
            assert line_of(other) == "joined"
            publish(other, 2)
            assert [arrived.get(timeout=WAIT_S).parts["n"] for _ in range(2)] == [1, 2]
            assert subscriber.wait_joined(WAIT_S)
            other.kill()

    with subscriber:
        publish_and_be_killed()
        assert changes.get(timeout=WAIT_S) is True
        assert subscriber.is_stale
        publish_and_be_killed()
        assert changes.get(timeout=WAIT_S) is False
        assert changes.get(timeout=WAIT_S) is True
        assert (subscriber.received, subscriber.lost) == (4, {})


def test_a_subscriber_that_is_stuck_stopped_and_killed_holds_up_no_other(place, opened):
    sender, receiver = opened(Sender, place), opened(Receiver, place)
    with process(STUCK, place) as other:
        assert line_of(other) == "joined"
        join(sender, receiver)
        sender.send(b"a")
        assert (body(receiver.next()), line_of(other)) == (b"a", "took")
        other.send_signal(signal.SIGSTOP)
        for number in range(30):
            sender.send(bytes(1_000_000), b"%d" % number)
            assert bytes(receiver.next().frames[1]) == b"%d" % number
    sender.send(b"after it")
    assert body(receiver.next()) == b"after it"


def test_a_process_that_ends_with_open_channels_ends_in_bounded_time(place):
    with process(LEFT_OPEN, place) as other:
        printed, _ = other.communicate(timeout=WAIT_S)
        assert "end" in printed
        assert other.returncode == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_does_not_disturb_the_channels_of_its_parent(place, opened):
    sender, receiver = opened(Sender, place), opened(Receiver, place)
    join(sender, receiver)
    child = os.fork()
    if child == 0:
        status = 1
        with contextlib.suppress(BaseException):
            sender.channel.close()
            receiver.channel.close()
            try:
                sender.channel.send([b"from the child"])
            except BrokerError:
                # It opens one of its own, or gets an error at once that says why it can't.
                with contextlib.suppress(BrokerError):
                    Sender(place).channel.close()
                status = 0
        os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    sender.send(b"b")
    assert body(receiver.next()) == b"b"


def test_what_was_recorded_is_played_again(place, tmp_path):
    file, arrived = tmp_path / "messages.mcap", queue.Queue()
    with Publisher(place) as publisher:
        recorder = Recorder(place, file, messages=3).start()
        assert recorder.wait_joined(WAIT_S)
        for number in range(3):
            publisher.send(Envelope("x", {"n": number}, source="s"))
        assert recorder.wait(WAIT_S)
        recorder.stop()
    with Subscriber(place, arrived) as subscriber, Player(file, place, speed=0):
        assert [arrived.get(timeout=WAIT_S).parts["n"] for _ in range(3)] == [0, 1, 2]
        assert subscriber.lost == {}


def test_the_last_message_of_a_publisher_may_come_after_the_news_that_it_has_gone():
    changes, arrived = queue.SimpleQueue(), queue.SimpleQueue()
    session = Held(changes.put)
    session.may_open.set()
    channel = PeerChannel(session, session.options)
    channel.open(arrived.put)
    channel.publishers.set_count(1)
    channel.publishers.set_count(0)
    channel.deliver([b"late"])
    assert arrived.get(timeout=WAIT_S).frames == [b"late"]
    assert channel.publishers.is_stale
    assert (changes.get(timeout=WAIT_S), changes.empty()) == (True, True)
    channel.publishers.set_count(1)
    assert changes.get(timeout=WAIT_S) is False
    channel.close()


def test_a_channel_that_is_not_open_yet_or_any_more_sends_nothing():
    session = Held()
    channel = PeerChannel(session, session.options)
    opening = threading.Thread(target=channel.open, args=[None])
    opening.start()
    with pytest.raises(BrokerError, match="not open"):
        channel.send([b"early"])
    session.may_open.set()
    opening.join(WAIT_S)
    channel.send([b"a"])
    channel.close()
    with pytest.raises(BrokerError, match="is closed"):
        channel.send([b"late"])
    assert session.sent == [b"a"]
