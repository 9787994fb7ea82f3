"""What a Publisher and a Subscriber promise on every channel: over ZeroMQ's sockets and over brokers."""

from __future__ import annotations

import gc
import itertools
import queue
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from epypes.errors import BrokerError, MessageError, StillRunning
from epypes.pipeline import Mailbox
from epypes.transport import Publisher, Subscriber
from epypes.wire import EncodedEnvelope, Envelope, JustBytes
from tests.transport.peers import LOCAL, WAIT_S, threads, wait_until

_numbers = itertools.count()


@pytest.fixture(params=["zeromq", "memory"])
def address(request):
    """An address that one side opens first, and the other one may open after it."""
    return f"bind:{LOCAL}" if request.param == "zeromq" else f"memory://endpoints{next(_numbers)}/events?create=true"


def other_side(endpoint):
    """Return the address of what is opened second."""
    return endpoint.address if endpoint.address.startswith("memory:") else f"connect:{endpoint.address}"


@contextmanager
def joined(address, out=None, into=None, topic="", **options):
    """Give a publisher and a subscriber that are connected to each other."""
    into = queue.SimpleQueue() if into is None else into
    with (
        Subscriber(address, into, topic, acknowledge="received", **options) as sub,
        Publisher(other_side(sub), out, topic, **options) as pub,
    ):
        if address.startswith("bind:"):
            assert sub.wait_joined(WAIT_S)
        assert pub.wait_connected(WAIT_S)
        yield pub, sub


def take(q, count=1):
    return [q.get(timeout=WAIT_S) for _ in range(count)]


class Item:
    """A message whose own code does something when it is sent."""

    def __init__(self, act, content=b"x"):
        self._act, self._content = act, content

    def SerializeToString(self):
        self._act()
        return self._content


# -- what is sent -----------------------------------------------------------------------------------------------------


def test_encoded_envelopes_get_the_publishers_topic_and_numbers_and_their_values_are_not_touched(address):
    encoded = EncodedEnvelope.encode(Envelope("x", {"n": 1}, source="worker", id="a"), "elsewhere")
    into = queue.SimpleQueue()
    with joined(address, None, into, "cam1") as (pub, _):
        pub.send(encoded, id="a")
        pub.send(encoded, id="b")
        received = take(into, 2)
    assert [(each.sequence, each.source, each.parts["n"]) for each in received] == [(1, "worker", 1), (2, "worker", 1)]
    assert received[0].epoch > 0


def test_send_needs_no_queue_and_confirms_each_message_or_raises(address):
    into, outcomes = queue.SimpleQueue(), queue.SimpleQueue()
    with joined(address, None, into) as (pub, _):
        pub.send(Envelope("x", {"n": 1}), confirmed=outcomes.put)
        assert outcomes.get(timeout=WAIT_S) is None
        assert take(into)[0].parts["n"] == 1
        with pytest.raises(MessageError, match="not int"):
            pub.send(42, confirmed=outcomes.put)
    with pytest.raises(BrokerError):
        pub.send(b"late", confirmed=outcomes.put)
    assert outcomes.empty()
    assert pub.rejected == {"no codec": 1, "not sent": 1}


@pytest.mark.parametrize("make", [queue.Queue, lambda: Mailbox("block", 20)])
def test_items_that_can_not_be_sent_are_counted_and_the_next_one_is_sent(address, make):
    def lie():
        raise LookupError("no")

    out, into, raised = make(), queue.SimpleQueue(), []
    wrong = None, 42, Item(lie), JustBytes(), Envelope("x", {"no": object()}), bytes(10_001)
    with joined(address, out, into, max_message_bytes=10_000) as (pub, _):
        for item in (*wrong, Envelope("x", {"image": np.zeros(20_000, np.uint8)})):
            try:
                out.put(item)
            except (MessageError, LookupError) as error:
                raised.append(error)
        out.put(Envelope("good"))
        assert take(into)[0].sequence == 1
        assert pub.rejected == {"no codec": 3, "LookupError": 1, "incomplete": 1, "too large": 2}
        assert pub.sent == 1
    # A put into a mailbox waits for the confirmation of a broker; ZeroMQ has none.
    is_confirmed = isinstance(out, Mailbox) and address.startswith("memory:")
    assert len(raised) == (7 if is_confirmed else 0)


def test_what_many_threads_put_is_sent_once_each_in_the_order_of_the_thread(address):
    out, into = Mailbox("block", 1), queue.SimpleQueue()
    with joined(address, out, into, high_water_mark=10_000) as (pub, _):

        def put_all(name):
            for number in range(100):
                out.put(Envelope("x", {"of": name, "n": number, "data": np.full(3_000, number, np.int32)}))

        putting = [threading.Thread(target=put_all, args=(name,)) for name in "abcd"]
        for thread in putting:
            thread.start()
        received = take(into, 400)
        for thread in putting:
            thread.join(WAIT_S)
        assert pub.sent == 400
    assert [event.sequence for event in received] == list(range(1, 401))
    for name in "abcd":
        assert [event.parts["n"] for event in received if event.parts["of"] == name] == list(range(100))
    assert all((event.parts["data"] == event.parts["n"]).all() for event in received)


def test_what_is_queued_at_the_stop_is_still_sent(address):
    out, into = queue.Queue(), queue.SimpleQueue()
    with joined(address, out, into) as (pub, _):
        for number in range(300):
            out.put(b"%d" % number)
        pub.stop()
        assert pub.sent == 300
        assert [int(item) for item in take(into, 300)] == list(range(300))


def test_what_a_mailbox_has_kept_is_sent_at_the_start_and_what_it_gets_after_the_stop_is_kept(address):
    out = Mailbox("drop_oldest", 8)
    out.put(1)
    out.put(b"before")
    with Publisher(address, out) as pub:
        wait_until(lambda: (pub.sent, pub.rejected) == (1, {"no codec": 1}))
    out.put(b"after")
    assert out.get(timeout=0) == b"after"


# -- starting and stopping --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Publisher, Subscriber])
def test_stop_works_before_start_and_twice_and_from_any_thread_and_start_works_again(address, kind):
    made = kind(address, queue.Queue())
    made.stop()
    made.start().start()
    assert "running" in repr(made)
    stopping = [threading.Thread(target=made.stop) for _ in range(5)]
    for thread in stopping:
        thread.start()
    for thread in stopping:
        thread.join(WAIT_S)
        assert not thread.is_alive()
    made.stop()
    assert ("stopped" in repr(made), made.is_connected) == (True, False)
    with made:
        assert made.wait_connected(WAIT_S)
    wait_until(lambda: threads() == [])


def test_stop_works_from_the_threads_that_put_and_take_and_from_an_items_own_code(address):
    class Stops(queue.Queue):
        def put(self, item, block=True, timeout=None):
            sub.stop()
            super().put(item, block, timeout)

        def get(self, block=True, timeout=None):
            if stops_in_get:
                pub.stop()
            return super().get(block, timeout)

    out, into, stops_in_get = Mailbox("block", 8), Stops(), []
    with joined(address, out, into) as (pub, sub):
        out.put(b"x")
        wait_until(lambda: "stopped" in repr(sub))
        out.put(Item(pub.stop)) if address.startswith("bind:") else pub.stop()
        assert "stopped" in repr(pub)
    stops_in_get.append(True)
    with Publisher(address, Stops()) as pub:
        wait_until(lambda: "stopped" in repr(pub))
    wait_until(lambda: threads() == [])


def test_a_put_that_does_not_return_is_named(address):
    is_put, go_on = threading.Event(), threading.Event()

    class Holds(queue.Queue):
        def put(self, item, block=True, timeout=None):
            is_put.set()
            go_on.wait(WAIT_S)

    out = queue.Queue()
    with joined(address, out, Holds()) as (_, sub):
        out.put(b"x")
        assert is_put.wait(WAIT_S)
        with pytest.raises(StillRunning, match="put"):
            sub.stop(0.05)
        go_on.set()
    wait_until(lambda: threads() == [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "make"), [(Publisher, queue.Queue), (Publisher, lambda: Mailbox("block", 8)), (Subscriber, queue.Queue)]
)
def test_one_that_is_left_running_is_warned_of_and_ended(address, kind, make):
    made = [kind(address, make()).start()]
    known_as = made[0].address
    with pytest.warns(ResourceWarning, match=f"{kind.__name__} .*left running"):  # noqa: PT031  the last reference goes inside
        made.clear()
        gc.collect()
    wait_until(lambda: threads() == [])
    with kind(known_as if known_as.startswith("memory:") else f"bind:{known_as}", make()):
        pass


ENDS = """
import queue, sys
from epypes.pipeline import Mailbox
from epypes.transport import Publisher, Subscriber
out, into = Mailbox("block", 8), queue.Queue()
sub = Subscriber(sys.argv[1], into, "t").start()
pub = Publisher(sub.address if "memory" in sub.address else "connect:" + sub.address, out, "t").start()
if "memory" not in sub.address:
    assert sub.wait_joined(60)
out.put(b"x")
print("end", flush=True)
"""


@pytest.mark.slow
def test_a_script_that_stops_nothing_ends_with_a_warning(address):
    command = [sys.executable, "-W", "always::ResourceWarning", "-c", ENDS, address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert (done.returncode, done.stdout) == (0, "end\n"), done.stderr
    assert "Traceback" not in done.stderr
