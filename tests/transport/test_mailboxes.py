"""What is put into a Mailbox is sent within put, on any thread."""

from __future__ import annotations

import os
import queue
import threading

import pytest

from epypes.errors import StillRunning
from epypes.pipeline import Mailbox
from epypes.run import Failure
from epypes.transport import ZMQPublisher, ZMQSubscriber
from tests.transport.peers import LOCAL, WAIT_S


@pytest.mark.parametrize("policy", ["latest", "block"])
def test_nothing_is_dropped_since_nothing_waits(policy):
    out, into = Mailbox(policy), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        for number in range(200):
            out.put(b"%d" % number)
            assert pub.sent == number + 1
        assert [int(into.get(timeout=WAIT_S)) for _ in range(200)] == list(range(200))
    assert out.dropped == {}


def test_it_is_sent_on_the_thread_that_puts_and_no_thread_waits_in_the_mailbox():
    threads = []

    class Item:
        def SerializeToString(self):
            threads.append(threading.current_thread())
            return b"x"

    out = Mailbox()
    with ZMQPublisher(LOCAL, out):
        out.put(Item())
        assert threads == [threading.current_thread()]
        assert not [thread for thread in threading.enumerate() if thread.name == "epypes-publisher"]


def test_an_item_that_another_items_own_code_puts_is_refused_and_the_other_one_is_sent():
    out, into = Mailbox(), queue.SimpleQueue()

    class Item:
        def SerializeToString(self):
            out.put(b"inner")
            return b"outer"

    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Item())
        out.put(b"next")
        assert [into.get(timeout=WAIT_S) for _ in range(2)] == [b"outer", b"next"]
        assert pub.rejected == {"nested": 1}


def test_a_confirmation_may_put_the_next_item():
    out, into = Mailbox(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        pub.send(b"1", confirmed=lambda error: out.put(b"2"))
        assert [into.get(timeout=WAIT_S) for _ in range(2)] == [b"1", b"2"]


def test_two_publishers_can_not_share_a_mailbox_and_the_second_leaves_no_socket():
    out = Mailbox()
    with ZMQPublisher(LOCAL, out):
        second = ZMQPublisher(LOCAL, out)
        with pytest.raises(ValueError, match="Give each publisher its own"):
            second.start()
        assert "stopped" in repr(second)
    with second:
        out.put(b"x")
        assert second.sent == 1


def test_a_queue_that_holds_up_the_io_thread_does_not_hold_up_what_is_sent_and_is_named_at_the_stop():
    let_go, entered = threading.Event(), threading.Event()

    class Stuck(queue.Queue):
        def put(self, item, block=True, timeout=None):
            entered.set()
            let_go.wait(60)

    out = Mailbox()
    pub = ZMQPublisher(LOCAL, out).start()
    with ZMQSubscriber(pub.address, Stuck()) as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(b"x")
        assert entered.wait(WAIT_S)
        for _ in range(100):
            out.put(b"y")
        assert pub.sent == 101
        with pytest.raises(StillRunning, match="put"):
            pub.stop(timeout_s=0.1)
        let_go.set()
        pub.stop()


def test_a_taker_that_waits_in_get_is_woken_up_when_items_are_handed_over():
    mailbox, taken = Mailbox("block", 1), []
    mailbox.put(1)
    putter = threading.Thread(target=mailbox.put, args=(2,))
    putter.start()
    end = mailbox.hand_to(taken.append)
    putter.join(WAIT_S)
    mailbox.put(3)
    end()
    mailbox.put(4)
    assert taken == [1, 2, 3]
    assert mailbox.get(timeout=0) == 4


def test_a_forked_child_neither_uses_its_parents_socket_nor_hangs():
    out, into = Mailbox(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(WAIT_S)
        child = os.fork()
        if child == 0:
            out.put(b"of the child")
            os._exit(0 if pub.rejected == {"not sent": 1} else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        out.put(b"of the parent")
        assert into.get(timeout=WAIT_S) == b"of the parent"


@pytest.mark.parametrize("make", [Mailbox, queue.SimpleQueue])
def test_a_failure_is_published_as_its_event(make):
    out, into = make(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out, "failures") as pub, ZMQSubscriber(pub.address, into, "failures") as sub:
        assert sub.wait_joined(WAIT_S)
        out.put(Failure("detect", ("image", "keypoints"), {}, ValueError("no corners"), "7", 2, "vision"))
        event = into.get(timeout=WAIT_S)
    assert (event.type, event.source, event.correlation_id, event.sequence) == ("epypes.failure", "vision", "7", 1)
    assert (event.failure.function, event.failure.message, event.failure.attempt) == ("detect", "no corners", 2)
