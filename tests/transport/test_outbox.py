"""Who sends what waits: whoever puts it, or the outbox's own thread? And is nothing sent twice by both?"""

from __future__ import annotations

import itertools
import threading

import pytest

import epypes as ep
from epypes.errors import BrokerError
from epypes.transport.channels import memory, open_channel, place_of
from epypes.transport.outbox import Outbox
from tests.transport.peers import wait_until

WAIT_S = 60.0
_numbers = itertools.count()


@pytest.fixture
def broker():
    return f"outbox{next(_numbers)}"


@pytest.fixture
def address(broker):
    return f"memory://{broker}/events?create=true"


@pytest.fixture
def senders(monkeypatch):
    """The threads that have sent something, in order."""
    threads = []
    send = memory.MemoryChannel.send

    def sent(channel, frames, **options):
        send(channel, frames, **options)
        threads.append(threading.current_thread())

    monkeypatch.setattr(memory.MemoryChannel, "send", sent)
    return threads


def bodies(address):
    channel = open_channel(address, prefetch=1_000)
    found = []
    while (received := channel.receive(0.0)) is not None:
        found.append(bytes(received.frames[0]))
    channel.close()
    return found


def test_what_is_put_into_a_mailbox_is_sent_by_the_thread_that_puts_it(address, senders):
    mailbox = ep.Mailbox("block", 8)
    with ep.Publisher(address, mailbox):
        for number in range(3):
            mailbox.put(b"%d" % number)
    assert senders == [threading.current_thread()] * 3
    assert bodies(address) == [b"0", b"1", b"2"]


def test_what_many_threads_put_at_once_is_sent_once_each(address, senders):
    mailbox = ep.Mailbox("block", 8)
    with ep.Publisher(address, mailbox) as publisher:
        begin = threading.Barrier(4)

        def put(who):
            begin.wait(WAIT_S)
            for number in range(50):
                mailbox.put(b"%d %d" % (who, number))

        threads = [threading.Thread(target=put, args=(who,)) for who in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(WAIT_S)
        assert publisher.sent == 200
    assert len(senders) == 200
    found = bodies(address)
    for who in range(4):
        mine = [body for body in found if body.startswith(b"%d " % who)]
        assert mine == [b"%d %d" % (who, number) for number in range(50)]


def test_what_could_not_be_sent_by_who_put_it_is_sent_when_the_broker_is_there_again(broker, address, senders):
    mailbox = ep.Mailbox("block", 8)
    with ep.Publisher(address, mailbox) as publisher:
        putting = threading.Thread(target=mailbox.put, args=(b"x",))
        with memory.away(broker):
            putting.start()
            wait_until(lambda: not publisher.is_connected)
        putting.join(WAIT_S)
        assert not putting.is_alive()
    assert senders[-1] not in (putting, threading.current_thread())
    assert bodies(address) == [b"x"]


class _Watched:
    """A lock that tells when somebody waits for it."""

    def __init__(self):
        self._lock, self.is_wanted = threading.Lock(), threading.Event()

    def __getattr__(self, name):
        return getattr(self._lock, name)

    def __enter__(self):
        if self._lock.locked():
            self.is_wanted.set()
        self._lock.acquire()

    def __exit__(self, *_):
        self._lock.release()


@pytest.mark.slow
def test_what_the_outboxs_own_thread_has_meant_to_send_is_not_sent_again(address, monkeypatch):
    outbox = Outbox(place_of(address))
    outbox._turn = turn = _Watched()
    outbox.start()
    send = memory.MemoryChannel.send

    def slow(channel, frames, **options):
        assert turn.is_wanted.wait(WAIT_S), "the thread looks what waits from time to time"
        send(channel, frames, **options)

    monkeypatch.setattr(memory.MemoryChannel, "send", slow)
    outbox.put(b"x", waits=True)
    outbox.put(b"y")
    assert outbox.wait_empty(WAIT_S)
    outbox.stop()
    assert bodies(address) == [b"x", b"y"]


def test_who_is_told_while_his_thread_sends_can_put_more_and_does_not_wait_for_himself(address):
    mailbox, is_told = ep.Mailbox("block", 8), threading.Event()
    with ep.Publisher(address, mailbox) as publisher:

        def then(error):
            mailbox.put(b"second")
            is_told.set()

        publisher._outbox.put(b"first", then=then, waits=True)
        assert is_told.is_set()
        wait_until(lambda: publisher.sent == 2)
    assert bodies(address) == [b"first", b"second"]


def test_who_is_interrupted_while_he_sends_leaves_it_to_the_outboxs_own_thread(address, monkeypatch):
    send, interruptions = memory.MemoryChannel.send, [KeyboardInterrupt()]

    def interrupted(channel, frames, **options):
        if interruptions:
            raise interruptions.pop()
        send(channel, frames, **options)

    monkeypatch.setattr(memory.MemoryChannel, "send", interrupted)
    mailbox = ep.Mailbox("block", 8)
    with ep.Publisher(address, mailbox) as publisher:
        with pytest.raises(KeyboardInterrupt):
            mailbox.put(b"x")
        wait_until(lambda: publisher.sent == 1)
        assert publisher.reconnects == 1, "who knows in what state the interrupted channel was"
    assert bodies(address) == [b"x"]


def test_what_waits_goes_before_what_is_put_later_by_one_who_waits(broker, address):
    outbox = Outbox(place_of(address))
    outbox.start()
    errors = []
    with memory.away(broker):
        for number in range(3):
            outbox.put(b"%d" % number, then=errors.append)
        wait_until(lambda: not outbox.is_connected)
        outbox.put(b"3", then=errors.append, waits=True)
    wait_until(lambda: errors == [None] * 4)
    outbox.stop()
    assert bodies(address) == [b"0", b"1", b"2", b"3"]
    outbox.put(b"late", then=errors.append, waits=True)
    assert isinstance(errors[-1], BrokerError)
