"""Signals, and code of the user that wants to end the process, leave the sockets in order."""

from __future__ import annotations

import queue
import subprocess
import sys

import numpy as np
import pytest

from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import Envelope
from tests.transport.peers import LOCAL, WAIT_S, wait_until

# Prints what happened after some hundred signals that came in the midst of puts.
RAISING_HANDLER = """
import queue, random, signal, threading
import numpy as np
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher
from epypes.wire import Envelope
rng, armed, interrupts = random.Random(1), False, 0
image = np.zeros(10_000, np.uint8)

def interrupt(number, frame):
    if armed:
        raise KeyboardInterrupt

signal.signal(signal.SIGALRM, interrupt)
out = Mailbox()
with ZMQPublisher("tcp://127.0.0.1:*", out) as pub:
    while interrupts < 400:
        try:
            armed = True
            signal.setitimer(signal.ITIMER_REAL, rng.uniform(5e-6, 60e-6))
            for _ in range(20):
                out.put(b"x")
            armed = False
        except KeyboardInterrupt:
            armed = False
            interrupts += 1
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    before = pub.sent
    other = threading.Thread(target=out.put, args=(b"y",), daemon=True)
    other.start()
    other.join(60)
    print("sent" if pub.sent > before else "stuck", flush=True)
"""


class Ending:
    """An item that wants to end the process."""

    def SerializeToString(self):
        raise SystemExit(3)


@pytest.mark.slow
def test_a_signal_in_the_midst_of_a_put_leaves_the_publisher_usable():
    done = subprocess.run([sys.executable, "-c", RAISING_HANDLER], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["sent"], done.stdout + done.stderr


@pytest.mark.parametrize("begun", [1, 4])
def test_a_message_that_is_interrupted_before_or_between_its_frames_does_not_spoil_the_next(begun, caplog):
    out, into = Mailbox(), queue.SimpleQueue()
    payloads = {name: np.zeros((100, 100), np.uint8) for name in "abc"}

    def interrupt(frame, event, argument):
        """As Ctrl+C would, when so many frames are being sent."""
        if frame.f_code.co_name == "send" and "zmq" in frame.f_code.co_filename:
            sends.append(frame)
            if len(sends) == begun:
                raise KeyboardInterrupt

    sends = []
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        before = sys.gettrace()
        sys.settrace(interrupt)
        try:
            with pytest.raises(KeyboardInterrupt):
                out.put(Envelope("x", payloads, id="1"))
        finally:
            sys.settrace(before)
        for number in "23":
            out.put(Envelope("x", payloads, id=number))
        assert [into.get(timeout=WAIT_S).id for _ in "23"] == ["2", "3"]
        assert sub.rejected.total() == 1
        assert pub.sent == 2
        assert pub.rejected == {"KeyboardInterrupt": 1}
        assert "rejected an item" not in caplog.text


def test_an_item_that_wants_to_end_the_process_ends_no_bridge_and_is_counted():
    out, into = queue.Queue(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Ending())
        out.put(b"next")
        assert into.get(timeout=WAIT_S) == b"next"
        assert pub.rejected == {"SystemExit": 1}


def test_an_item_put_into_a_mailbox_that_wants_to_end_the_process_is_counted_and_raises_from_put():
    out = Mailbox()
    with ZMQPublisher(LOCAL, out) as pub:
        with pytest.raises(SystemExit):
            out.put(Ending())
        out.put(b"next")
        assert (pub.sent, pub.rejected) == (1, {"SystemExit": 1})


def test_a_queue_whose_get_wants_to_end_the_process_is_counted_as_failed():
    failed = []

    class Taken(queue.SimpleQueue):
        def get(self, block=True, timeout=None):
            if not failed:
                failed.append(True)
                raise SystemExit(3)
            return super().get(block, timeout)

    out = Taken()
    with ZMQPublisher(LOCAL, out) as pub:
        out.put(b"x")
        wait_until(lambda: pub.sent == 1)
        assert pub.rejected == {"queue failed": 1}


def test_a_queue_whose_put_wants_to_end_the_process_is_counted_and_the_other_sockets_live():
    class Full:
        def put(self, item, block=True):
            raise SystemExit(3)

    out, into = Mailbox(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out) as pub,
        ZMQSubscriber(pub.address, Full()) as bad,
        ZMQSubscriber(pub.address, into) as good,
    ):
        assert bad.wait_joined(WAIT_S)
        assert good.wait_joined(WAIT_S)
        for _ in range(5):
            out.put(b"x")
            assert into.get(timeout=WAIT_S) == b"x"
        wait_until(lambda: bad.dropped.total() == 5)
        assert bad.dropped == {"SystemExit": 5}
        assert bad.received == 0


def test_an_on_stale_that_wants_to_end_the_process_ends_no_io_thread():
    called = []

    def end(is_stale):
        called.append(is_stale)
        raise SystemExit(3)

    into = queue.SimpleQueue()
    pub = ZMQPublisher(LOCAL, Mailbox()).start()
    with ZMQSubscriber(pub.address, into, heartbeat_s=0.02) as sub:
        sub.on_stale = end
        assert sub.wait_joined(WAIT_S)
        pub.stop()
        wait_until(lambda: called == [True])
        out = Mailbox()
        with ZMQPublisher(LOCAL, out) as other, ZMQSubscriber(other.address, into) as listener:
            assert listener.wait_joined(WAIT_S)
            out.put(b"x")
            assert into.get(timeout=WAIT_S) == b"x"
