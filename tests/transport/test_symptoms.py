"""Each test has a symptom that users of other systems have reported, and shows that it does not occur here."""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
import threading
import time
import zlib

import numpy as np
import pytest
import zmq

import epypes as ep
from epypes.pipeline import Mailbox
from epypes.run import Failure
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope
from tests.transport.peers import LOCAL, PUBLISHER, WAIT_S, line_of, process, publish, wait_until

# Answers what it hears, on a socket of its own.
ECHO = """
import queue, sys
from epypes.transport import ZMQPublisher, ZMQSubscriber
asked = queue.SimpleQueue()
with ZMQSubscriber(sys.argv[1], asked, bind=True) as sub, ZMQPublisher(sys.argv[2], asked) as pub:
    print(sub.address, pub.address, flush=True)
    sys.stdin.read()
"""

# Sends a lot to a subscriber that does not read, and ends by a signal.
STUFFED = """
import queue, signal, sys, threading
from epypes.transport import ZMQPublisher
def end(number, frame):
    raise SystemExit
signal.signal(signal.SIGTERM, end)
out = queue.SimpleQueue()
with ZMQPublisher("tcp://127.0.0.1:*", out) as pub:
    print(pub.address, flush=True)
    assert pub.wait_for_subscriber(60)
    for _ in range(300):
        out.put(bytes(1_000_000))
    print("stuffed", flush=True)
    # Again and again: a signal that comes right before a wait without an end would never be handled.
    while True:
        threading.Event().wait(0.05)
"""

SUBSCRIBER = """
import queue, sys
from epypes.transport import ZMQSubscriber
into = queue.SimpleQueue()
with ZMQSubscriber(sys.argv[1], into) as sub:
    assert sub.wait_joined(60)
    print("joined", flush=True)
    sys.stdin.read()
"""


@pytest.mark.slow
def test_a_subscriber_that_computes_is_not_deaf_after_the_publisher_restarts():
    into, sent, last = queue.SimpleQueue(), 0, None
    with process(PUBLISHER, LOCAL) as first:
        address = line_of(first)
        sub = ZMQSubscriber(address, into, "t").start()
        assert sub.wait_joined(WAIT_S)
        publish(first, 30)
        wait_until(lambda: sub.received == 30)
    with sub, process(PUBLISHER, address) as second:
        assert line_of(second) == address
        end_s = time.monotonic() + WAIT_S
        # What is published before the subscriber has connected again goes to nobody; then 40 more.
        while last is None or sent < last:
            assert time.monotonic() < end_s
            publish(second, 1)
            sent += 1
            if last is None and sub.received > 30:
                last = sent + 40
            # The consumer computes all the while: this thread is the only one that takes from its queue.
            busy_until_s = time.perf_counter() + 0.02
            while time.perf_counter() < busy_until_s:
                np.linalg.norm(np.ones((50, 50)))
        wait_until(lambda: sub.received + sum(sub.lost.values()) == 30 + sent)
        received = [into.get().parts["n"] for _ in range(sub.received)][30:]
        assert received == [*range(sent + 1 - len(received), sent + 1)]


@pytest.mark.slow
def test_idle_publisher_subscriber_and_loop_take_under_half_a_percent_of_a_core():
    script = """
import queue, sys, threading, time
import epypes as ep
cg = ep.CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")})
asked, out = queue.SimpleQueue(), queue.SimpleQueue()
pipe = ep.FullPipeline("p", cg, asked, out, lambda event: {"x": 1}, lambda view: b"y")
with ep.ZMQPublisher("tcp://127.0.0.1:*", out) as pub, ep.ZMQSubscriber(pub.address, asked) as sub, pipe:
    assert sub.wait_joined(60)
    shares = []
    # To wake up takes up to three times as long where other processes are busy: the quietest of some times counts.
    while not shares or (min(shares) >= 0.005 and len(shares) < 6):
        cpu, wall = time.process_time(), time.perf_counter()
        threading.Event().wait(2.5)
        shares.append((time.process_time() - cpu) / (time.perf_counter() - wall))
sys.exit(0 if min(shares) < 0.005 else f"{min(shares):.2%}")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_caller_does_not_wait_for_ever_for_a_server_that_was_killed_and_is_served_after_its_restart():
    out, answers = queue.SimpleQueue(), queue.SimpleQueue()
    with process(ECHO, LOCAL, LOCAL) as server:
        addresses = line_of(server).split()
        pub, sub = ZMQPublisher(addresses[0], out, bind=False).start(), ZMQSubscriber(addresses[1], answers).start()
        assert sub.wait_joined(WAIT_S)
        assert pub.wait_for_subscriber(WAIT_S)
        out.put(b"1")
        assert answers.get(timeout=WAIT_S) == b"1"
        server.kill()
        server.wait()
        out.put(b"2")
        wait_until(lambda: sub.is_stale)
        assert answers.empty()
    with process(ECHO, *addresses) as server, pub, sub:
        assert line_of(server).split() == addresses
        assert sub.wait_joined(WAIT_S, publishers=2)
        out.put(b"3")
        # What was sent meanwhile may be answered as well.
        for answer in iter(lambda: answers.get(timeout=WAIT_S), b"3"):
            assert answer == b"2"


@pytest.mark.slow
def test_an_output_buffer_that_is_used_again_at_once_does_not_tear_a_thousand_frames():
    buffer, out, into = np.zeros((300, 400), np.uint8), Mailbox(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out, high_water_mark=2_000) as pub,
        ZMQSubscriber(pub.address, into, high_water_mark=2_000) as sub,
    ):
        assert sub.wait_joined(WAIT_S)
        for number in range(1_000):
            buffer[:] = number % 251
            buffer[0, :8] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
            checksum = zlib.crc32(buffer)
            out.put(Envelope("x", {"image": buffer, "crc": checksum}))
            buffer[:] = 255
        for _ in range(1_000):
            event = into.get(timeout=WAIT_S)
            assert zlib.crc32(event.parts["image"]) == event.parts["crc"]
        assert sub.lost == {}


def test_a_function_that_returns_the_same_buffer_again_does_not_tear_frames_on_their_way():
    buffer = np.zeros((300, 400), np.uint8)

    def draw(number):
        buffer[:] = number % 251
        return buffer

    cg = ep.CompGraph({"draw": draw}, {"draw": ("number", "image")})
    asked, out, into = queue.SimpleQueue(), Mailbox(), queue.SimpleQueue()
    pipe = ep.FullPipeline(
        "p", cg, asked, out, lambda number: {"number": number}, lambda view: Envelope("x", {"image": view["image"]})
    )
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub, pipe:
        assert sub.wait_joined(WAIT_S)
        for number in range(200):
            asked.put(number)
        for number in range(200):
            assert (into.get(timeout=WAIT_S).parts["image"] == number % 251).all()


def test_an_array_that_nobody_can_change_is_sent_without_a_copy_and_whole():
    image, out, into = np.arange(1_000_000, dtype=np.int32), Mailbox(), queue.SimpleQueue()
    image.flags.writeable = False
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Envelope("x", {"image": image[100:]}))
        assert np.array_equal(into.get(timeout=WAIT_S).parts["image"], image[100:])


@pytest.mark.parametrize("starts", [20, pytest.param(500, marks=pytest.mark.soak)])
def test_many_starts_and_stops_crash_nothing(starts):
    out = Mailbox()
    for number in range(starts):
        with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, queue.SimpleQueue()):
            out.put(b"%d" % number)
    assert out.empty()


class Spy:
    """Records which threads use which sockets."""

    def __init__(self) -> None:
        self.inside: dict[int, int] = {}
        self.shared: list[str] = []
        self.strangers: list[str] = []

    def on(self, name: str):
        real = getattr(zmq.Socket, name)

        def spying(socket, *args, **kwargs):
            me = threading.get_ident()
            if self.inside.setdefault(id(socket), me) != me:
                self.shared.append(name)
            if name in {"bind", "connect", "close"} and threading.current_thread().name != "epypes-io":
                self.strangers.append(name)
            try:
                return real(socket, *args, **kwargs)
            finally:
                self.inside.pop(id(socket), None)

        return spying


def test_no_socket_is_ever_used_by_two_threads_at_once(monkeypatch):
    spy = Spy()
    for name in ("send", "recv", "get", "setsockopt", "bind", "connect", "close"):
        monkeypatch.setattr(zmq.Socket, name, spy.on(name))
    out, into = Mailbox(), queue.SimpleQueue()
    # None is dropped however seldom the I/O thread gets its turn.
    kept = {"high_water_mark": 2_000}
    with ZMQPublisher(LOCAL, out, **kept) as pub, ZMQSubscriber(pub.address, into, heartbeat_s=0.002, **kept) as sub:
        assert sub.wait_joined(WAIT_S)
        threads = [threading.Thread(target=lambda: [out.put(b"x") for _ in range(300)]) for _ in range(4)]
        for thread in threads:
            thread.start()
        # Subscriptions come and go on the same socket meanwhile.
        for _ in range(10):
            with ZMQSubscriber(pub.address, queue.SimpleQueue()) as other:
                assert other.wait_joined(WAIT_S)
        for _ in range(1_200):
            into.get(timeout=WAIT_S)
        for thread in threads:
            thread.join(WAIT_S)
    assert spy.shared == []
    assert spy.strangers == []


@pytest.mark.slow
def test_a_process_with_a_peer_that_does_not_read_exits_once_the_drain_time_is_over():
    with process(STUFFED) as stuffed, process(SUBSCRIBER, line_of(stuffed)) as peer:
        assert line_of(peer) == "joined"
        peer.send_signal(signal.SIGSTOP)
        assert line_of(stuffed) == "stuffed"
        stuffed.send_signal(signal.SIGTERM)
        # Draining the queue into the socket takes 5 s at most, closing the socket 1 s.
        assert stuffed.wait(timeout=60) == 0


@pytest.mark.slow
def test_a_subscriber_that_is_stopped_or_killed_does_not_block_the_others():
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out, high_water_mark=10) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        with process(SUBSCRIBER, pub.address) as dead, process(SUBSCRIBER, pub.address) as killed:
            assert [line_of(dead), line_of(killed)] == ["joined"] * 2
            dead.send_signal(signal.SIGSTOP)
            killed.kill()
            for number in range(200):
                out.put(Envelope("x", {"n": number, "image": np.zeros(500_000, np.uint8)}))
                assert into.get(timeout=WAIT_S).parts["n"] == number
        assert sub.lost == {}


def test_failures_are_not_starved_by_images():
    data, events = queue.SimpleQueue(), queue.SimpleQueue()
    images, failures = Mailbox("latest"), queue.SimpleQueue()
    ended = threading.Event()

    def overload() -> None:
        while not ended.is_set():
            data.put(Envelope("frame", {"image": np.zeros(1_000_000, np.uint8)}))
            # Ahead of the socket, but not of the memory.
            while data.qsize() > 20 and not ended.is_set():
                ended.wait(0.0005)

    with (
        ZMQPublisher(LOCAL, data, "data", high_water_mark=20) as pub,
        ZMQPublisher(LOCAL, events, "failures") as event_pub,
        ZMQSubscriber(pub.address, images, "data", high_water_mark=20) as sub,
        ZMQSubscriber(event_pub.address, failures, "failures") as event_sub,
    ):
        assert sub.wait_joined(WAIT_S)
        assert event_sub.wait_joined(WAIT_S)
        source = threading.Thread(target=overload, daemon=True)
        source.start()
        wait_until(lambda: sub.received > 20)
        for number in range(200):
            events.put(Failure("detect", (), {}, ValueError("bad"), str(number)))
        arrived = [failures.get(timeout=60).correlation_id for _ in range(200)]
        ended.set()
        source.join(WAIT_S)
        assert arrived == [str(number) for number in range(200)]
        assert event_sub.lost == {}
