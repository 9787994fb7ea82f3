"""What was started can be stopped: twice, from any thread, in bounded time; and the process ends."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time

import pytest
import zmq

from epypes.errors import AddressError, StillRunning
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.transport.address import open_channel
from tests.transport.peers import threads, wait_until

LOCAL = "tcp://127.0.0.1:*"
WAIT_S = 60.0


@pytest.mark.slow
def test_the_same_port_can_be_bound_at_once_after_a_stop():
    with ZMQPublisher(LOCAL, queue.Queue()) as pub:
        address = pub.address
    for kind in [ZMQPublisher, ZMQSubscriber] * 10:
        with kind(address, queue.Queue(), bind=True) as made:
            assert made.address == address


@pytest.mark.slow
def test_a_stop_does_not_wait_for_its_time_out():
    durations = []
    for _ in range(10):
        with ZMQPublisher(LOCAL, queue.Queue()) as pub, ZMQSubscriber(pub.address, queue.Queue()) as sub:
            assert sub.wait_joined(WAIT_S)
            before = time.perf_counter()
            pub.stop()
            durations.append(time.perf_counter() - before)
    # Generous: the time-out is 5 s.
    assert sorted(durations)[5] < 2.5


def test_a_channel_that_is_closed_is_not_connected():
    channel = open_channel(LOCAL)
    channel.open(None)
    assert channel.is_connected
    channel.close()
    assert not channel.is_connected


def test_what_was_sent_arrives_even_if_the_last_socket_is_closed_at_once():
    context = zmq.Context()
    context.linger = 0
    peer = context.socket(zmq.SUB)
    peer.subscribe(b"")
    peer.rcvtimeo = int(WAIT_S * 1000)
    out = queue.Queue()
    with ZMQPublisher(LOCAL, out) as pub:
        peer.connect(pub.address)
        assert pub.wait_for_subscriber(WAIT_S)
        for _ in range(50):
            out.put(bytes(200_000))
    try:
        assert {len(peer.recv()) for _ in range(50)} == {200_000}
    finally:
        context.destroy(linger=0)


def test_a_producer_that_goes_on_does_not_keep_it_from_stopping():
    class Endless(queue.Queue):
        def get(self, block=True, timeout=None):
            return b"x"

    pub = ZMQPublisher(LOCAL, Endless()).start()
    before = time.perf_counter()
    pub.stop(timeout_s=0.2)
    assert time.perf_counter() - before < WAIT_S / 2
    assert threads() == []


def test_a_publisher_can_be_stopped_by_the_queue_of_a_subscriber():
    done = threading.Event()

    class StopsThePublisher(queue.Queue):
        def put(self, item, block=True, timeout=None):
            pub.stop(timeout_s=WAIT_S)
            done.set()

    out = queue.Queue()
    pub = ZMQPublisher(LOCAL, out)
    with pub, ZMQSubscriber(pub.address, StopsThePublisher()) as sub:
        assert sub.wait_joined(WAIT_S)
        before = time.perf_counter()
        out.put(b"x")
        assert done.wait(WAIT_S)
        pub.stop(timeout_s=WAIT_S)
        assert time.perf_counter() - before < WAIT_S / 2
    assert threads() == []


# Opens and stops publishers while threads connect and leave. In a process of its own: libzmq waits with the GIL held.
VISITED = """
import queue, threading, zmq
from epypes.transport import ZMQPublisher
context, address, is_over = zmq.Context(), [None], threading.Event()

def visit():
    while not is_over.is_set():
        with context.socket(zmq.SUB) as visitor:
            visitor.linger = 0
            if address[0]:
                visitor.connect(address[0])
            is_over.wait(0.0005)

threads = [threading.Thread(target=visit) for _ in range(4)]
for thread in threads:
    thread.start()
for _ in range(40):
    with ZMQPublisher("tcp://127.0.0.1:*", queue.SimpleQueue()) as pub:
        address[0] = pub.address
        is_over.wait(0.003)
is_over.set()
for thread in threads:
    thread.join()
"""


@pytest.mark.slow
def test_peers_that_come_and_go_do_not_keep_it_from_stopping():
    subprocess.run([sys.executable, "-c", VISITED], check=True, timeout=WAIT_S)


@pytest.mark.slow
def test_a_queue_that_never_returns_is_named_and_the_port_is_free():
    let_go = threading.Event()

    class Stuck(queue.Queue):
        def get(self, block=True, timeout=None):
            let_go.wait(60)
            raise queue.Empty

    pub = ZMQPublisher(LOCAL, Stuck()).start()
    address = pub.address
    with pytest.raises(StillRunning, match="get"):
        pub.stop(timeout_s=0.1)
    with ZMQPublisher(address, queue.Queue()):
        pass
    let_go.set()
    pub.stop()
    assert threads() == []


def test_a_broken_queue_is_counted_and_does_not_end_the_thread():
    class Broken(queue.Queue):
        failures = 3

        def get(self, block=True, timeout=None):
            if self.failures:
                self.failures -= 1
                raise OSError("gone")
            return super().get(block, timeout)

    out = Broken()
    with ZMQPublisher(LOCAL, out) as pub:
        out.put(b"x")
        wait_until(lambda: pub.sent == 1)
    assert pub.rejected == {"queue failed": 3}
    assert pub.sent == 1


def test_one_io_thread_serves_every_socket_and_ends_with_the_last():
    made = [ZMQPublisher(LOCAL, queue.Queue()).start() for _ in range(4)]
    made += [ZMQSubscriber(pub.address, queue.Queue()).start() for pub in made]
    try:
        assert len([thread for thread in threads() if thread.name == "epypes-io"]) == 1
        assert all(thread.daemon for thread in threads())
    finally:
        for one in made:
            one.stop()
    assert threads() == []


def run(script: str, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *options, "-c", script], capture_output=True, text=True, timeout=60, cwd=os.getcwd()
    )


START_BOTH = """
import queue, time
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.transport.address import open_channel
out, into = queue.Queue(), queue.Queue()
pub = ZMQPublisher("tcp://127.0.0.1:*", out, "t").start()
sub = ZMQSubscriber(pub.address, into, "t").start()
assert sub.wait_joined(60)
"""


@pytest.mark.slow
def test_a_forked_child_starts_an_io_thread_of_its_own():
    script = (
        START_BOTH
        + """
import os
child = os.fork()
if child == 0:
    pub.stop(); sub.stop()
    with ZMQPublisher("tcp://127.0.0.1:*", out) as mine, ZMQSubscriber(mine.address, into) as other:
        ok = other.wait_joined(60)
    os._exit(0 if ok else 1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
out.put(b"t/ still works")
assert into.get(timeout=60) == b"t/ still works"
sub.stop(); pub.stop()
"""
    )
    done = run(script, "-W", "ignore::DeprecationWarning")
    assert done.returncode == 0, done.stderr


def test_importing_transport_does_not_import_zmq():
    assert run("import sys, epypes.transport; sys.exit('zmq' in sys.modules)").returncode == 0


def test_a_start_that_fails_leaves_nothing_running():
    with pytest.raises(AddressError):
        ZMQPublisher("tcp://127.0.0.1:99999", queue.Queue()).start()
    for thread in threads():
        thread.join(WAIT_S)
    assert threads() == []
