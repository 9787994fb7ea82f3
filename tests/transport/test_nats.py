"""NATS JetStream: what it alone promises, and the errors it gives; against a real server."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from uuid import uuid4

import nats as library
import pytest
from nats.aio.msg import Msg

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import parse_address
from tests.apart import apart
from tests.brokers.nats import PASSWORD, server
from tests.transport.channels import WAIT_S, Receiver, Sender, body
from tests.transport.peers import wait_until
from tests.transport.test_channels import impatient

__all__ = ["impatient"]
pytestmark = pytest.mark.slow


@pytest.fixture
def mortal():
    """A server that a test may end."""
    with server() as running:
        yield running


@pytest.fixture
def name():
    return f"tests.{uuid4().hex[:8]}"


@pytest.fixture
def opened(nats, name):
    """Open senders and receivers at a subject of the test's own."""
    made = []

    def make(kind, subject="", *, at=None, prefetch=8, timeout_s=WAIT_S, **options):
        address = (at or nats).address(subject or name, **{"create": True, **options})
        made.append(kind(address, prefetch=prefetch, timeout_s=timeout_s))
        return made[-1]

    yield make
    for one in made:
        one.channel.close(0.0)


@pytest.fixture
def by_hand(nats):
    """Do something with JetStream by nats-py, as another program does."""

    def do(work):
        async def live():
            client = await library.connect(f"nats://127.0.0.1:{nats.port}", user=nats.user, password=nats.password)
            try:
                return await work(client.jetstream())
            finally:
                await client.close()

        return apart(lambda: asyncio.run(live()))

    return do


def make_stream(name, *subjects, **settings):
    made = {"name": name.replace(".", "_"), "subjects": list(subjects or [name]), **settings}
    return lambda jetstream: jetstream.add_stream(**made)


@contextmanager
def program_that_says(greeting):
    """Give the port of a program that greets, and what it hears until the other side has gone."""
    heard = []

    def listen(other):
        connected, _ = other.accept()
        with connected:
            connected.sendall(greeting)
            while said := connected.recv(1_000):
                heard.append(said)

    with socket.create_server(("127.0.0.1", 0)) as other:
        thread = threading.Thread(target=listen, args=(other,), daemon=True)
        thread.start()
        yield other.getsockname()[1], heard
        thread.join(WAIT_S)
        assert not thread.is_alive()


def test_what_takes_long_is_not_delivered_again(impatient, opened):
    sender, worker, other = opened(Sender), opened(Receiver, prefetch=1), None
    sender.send(b"x")
    delivery = worker.next()
    other = opened(Receiver, prefetch=1)
    assert other.is_quiet(1.5)
    delivery.ack()
    sender.send(b"y")
    worker.channel.close()
    assert body(other.next()) == b"y"


def test_a_connection_over_which_nothing_can_be_kept_in_progress_is_lost_and_made_again(impatient, opened, monkeypatch):
    failures, in_progress = [library.errors.Error("no progress")], Msg.in_progress

    async def fail_once(message):
        if failures:
            raise failures.pop()
        await in_progress(message)

    monkeypatch.setattr(Msg, "in_progress", fail_once)
    sender, worker = opened(Sender), opened(Receiver)
    sender.send(b"x")
    worker.next()
    wait_until(lambda: worker.channel.reconnects == 1)
    worker.next().ack()


def test_the_last_of_a_window_comes_however_late_it_is_sent(impatient, opened):
    sender, receiver = opened(Sender), opened(Receiver, prefetch=4)
    for _ in range(3):
        sender.send(b"early")
        receiver.next()
    assert receiver.is_quiet(1.2)
    sender.send(b"late")
    assert body(receiver.next()) == b"late"


def test_an_event_that_was_sent_again_and_rejected_again_is_another_dead_letter(opened, name, by_hand):
    """Both have one id, within the time in which the server drops duplicates."""
    receiver = opened(Receiver)
    for text in (b"first", b"second"):
        by_hand(lambda jetstream, text=text: jetstream.publish(name, text, headers={"epypes-id": "7"}))
        receiver.next().reject("no")
    letters = opened(Receiver, f"{name}.dead").take(2)
    assert [(body(letter), letter.id) for letter in letters] == [(b"first", "7"), (b"second", "7")]


def test_a_pattern_of_subjects_is_received_from_and_not_sent_to(opened, name):
    opened(Sender, f"{name}.dead")
    receiver = opened(Receiver, f"{name}.in.*", dead=f"{name}.dead")
    opened(Sender, f"{name}.in.left").send(b"x")
    assert body(receiver.next()) == b"x"
    with pytest.raises(MessageError, match="stands for many subjects: name the one"):
        opened(Sender, f"{name}.in.*", dead=f"{name}.dead").send(b"x")
    with pytest.raises(BrokerError, match="name the dead-letter queue, by dead=SUBJECT"):
        opened(Receiver, f"{name}.in.*")


def test_a_message_of_another_program_is_one_frame(opened, name, by_hand):
    receiver = opened(Receiver)
    by_hand(lambda jetstream: jetstream.publish(name, b"hello", headers={"Nats-Msg-Id": "9"}))
    delivery = receiver.next()
    assert (body(delivery), delivery.id, dict(delivery.headers)) == (b"hello", "9", {})


def test_a_message_whose_sizes_do_not_fit_comes_without_frames(opened, name, by_hand):
    receiver = opened(Receiver)
    by_hand(lambda jetstream: jetstream.publish(name, b"hello", headers={"epypes-frames": "7,nine"}))
    delivery = receiver.next()
    assert delivery.frames == ()
    assert "7,nine" in delivery.headers["epypes-error"]


def test_a_consumer_that_is_for_something_else_is_an_error(opened, name, by_hand):
    from nats.js.api import ConsumerConfig

    opened(Sender)
    other = ConsumerConfig(durable_name="epypes", deliver_subject="elsewhere")
    by_hand(lambda jetstream: jetstream.add_consumer(name.replace(".", "_"), other))
    with pytest.raises(BrokerError, match="is no pull consumer with explicit acknowledgements"):
        opened(Receiver)


def test_what_is_sent_again_with_its_id_is_kept_once(opened):
    sender, receiver = opened(Sender), opened(Receiver)
    for text in (b"x", b"x"):
        sender.send(text, id="same")
    sender.send(b"y", id="other")
    assert [body(delivery) for delivery in receiver.take(2)] == [b"x", b"y"]


def test_one_stream_may_keep_events_answers_and_dead_letters_of_one_id(opened, name, by_hand):
    by_hand(make_stream(name, f"{name}.>"))
    queues = {"in": b"bad", "out": b"bad as well"}
    for queue, text in queues.items():
        options = {"group": queue, "create": False, "dead": f"{name}.dead"}
        receiver = opened(Receiver, f"{name}.{queue}", **options)
        opened(Sender, f"{name}.{queue}", **options).send(text, id="1")
        receiver.next().reject("no")
    letters = opened(Receiver, f"{name}.dead", create=False).take(2)
    assert {body(letter) for letter in letters} == set(queues.values())
    with pytest.raises(BrokerError, match=r"consumer 'in' .* is for .*\.in\. Add &group=NAME"):
        opened(Receiver, f"{name}.out", group="in", create=False, dead=f"{name}.dead")


def test_a_connection_without_a_user_is_refused(nats):
    with pytest.raises(BrokerError, match="refuses a connection without a user"):
        Sender(f"nats://127.0.0.1:{nats.port}/a")
    assert PASSWORD not in str(parse_address(nats.address("a")))


def test_a_subject_or_dead_letters_that_no_stream_keeps_are_an_error(opened, name, by_hand):
    with pytest.raises(BrokerError, match=rf"No stream at .* keeps the subject '{name}'.*create=true"):
        opened(Receiver, create=False)
    by_hand(make_stream(name))
    with pytest.raises(BrokerError, match=rf"keeps the subject '{name}\.dead'"):
        opened(Receiver, create=False)


def test_a_server_without_jetstream_is_an_error_for_queues_alone(opened):
    with server(jetstream=False) as plain:
        with pytest.raises(BrokerError, match=r"JetStream is off there.*nats-server -js"):
            opened(Sender, "a", at=plain)
        sender = Sender(plain.address("a", kind="broadcast"))
        sender.send(b"x")
        sender.channel.close()


@pytest.mark.parametrize("subject", ["two words", "a..b", ".a", "a.", "a>b"])
def test_a_name_that_can_not_be_a_subject_is_an_error(opened, subject):
    with pytest.raises(BrokerError, match="is no subject of NATS"):
        opened(Sender, subject.replace(" ", "%20"))


def test_what_a_stream_refuses_is_an_error_or_waits(opened, name, by_hand, caplog):
    settings = {"max_msgs": 1, "discard": "new", "max_msg_size": 1_000}
    by_hand(make_stream(name, name, f"{name}.dead", **settings))
    sender, outcomes = opened(Sender, create=False), []
    with pytest.raises(MessageError, match="message size exceeds") as refused:
        sender.send(bytes(2_000))
    assert refused.value.reason == "too large"
    sender.send(b"x")
    sender.channel.send([b"y"], confirmed=outcomes.append)
    wait_until(lambda: "maximum messages exceeded" in caplog.text, WAIT_S)
    by_hand(lambda jetstream: jetstream.purge_stream(name.replace(".", "_")))
    wait_until(lambda: outcomes == [None], WAIT_S)


def test_a_header_that_can_not_be_one_is_refused(opened):
    with pytest.raises(MessageError, match="can't be the name of a header"):
        opened(Sender).send(b"x", headers={"a: b": "c"})


def test_a_silent_server_is_lost_and_the_message_is_confirmed_when_it_goes_on(impatient, opened, mortal):
    sender, receiver = opened(Sender, "a", at=mortal), opened(Receiver, "a", at=mortal)
    outcomes = []
    mortal.process.send_signal(signal.SIGSTOP)
    try:
        sender.channel.send([bytes(5_000_000)], id="1", confirmed=outcomes.append)
        wait_until(lambda: not sender.channel.is_connected and not receiver.channel.is_connected, WAIT_S)
    finally:
        mortal.process.send_signal(signal.SIGCONT)
    assert receiver.next().id == "1"
    wait_until(lambda: outcomes == [None], WAIT_S)


def test_a_stream_that_is_deleted_is_named_and_made_again_if_the_address_says_so(opened, name, by_hand, caplog):
    receiver = opened(Receiver)
    by_hand(lambda jetstream: jetstream.delete_stream(name.replace(".", "_")))
    wait_until(lambda: "the stream is gone, or the consumer" in caplog.text, WAIT_S)
    opened(Sender).send(b"x")
    assert body(receiver.next()) == b"x"


def test_the_client_prints_and_logs_nothing_and_the_channel_reports_an_outage_once(mortal):
    code = f"""
import threading
from epypes.transport.address import open_channel
from epypes.transport.channel import ChannelOptions
changed = threading.Semaphore(0)
def report(is_connected, reason):
    print(is_connected, flush=True)
    changed.release()
channels = [open_channel({mortal.address("a", create=True)!r}, ChannelOptions(on_connection=report)) for _ in range(2)]
channels[0].open(None)
channels[1].open(lambda delivery: delivery.ack())
for _ in range(4):
    changed.acquire()
"""
    command = [sys.executable, "-X", "dev", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() + other.stdout.readline() == "True\nTrue\n"
        mortal.stop(at_once=True)
        out, said = other.communicate(timeout=WAIT_S)
    assert out.split() == ["False", "False"]
    # What asyncio itself finds slow on a busy machine, in its developers' mode.
    said = re.sub(r"Executing <.*> took .* seconds\n", "", said)
    assert said.count("which is tried again until it is connected") == said.count("\n") == 2


def test_a_server_that_talks_nonsense_is_an_error(caplog):
    info = b'INFO {"server_id":"x","version":"2.9.10","max_payload":1000}\r\n-ERR nonsense\r\n'
    with program_that_says(info) as (port, _), pytest.raises(BrokerError, match="what answers there is no NATS server"):
        Sender(f"nats://127.0.0.1:{port}/a?kind=broadcast")
    assert not caplog.records


def test_a_server_that_does_not_encrypt_gets_no_password(certificates):
    info = b'INFO {"server_id":"x","version":"2.9.10","auth_required":true,"max_payload":1000}\r\n'
    with program_that_says(info) as (port, heard), pytest.raises(BrokerError, match="it does not encrypt"):
        Sender(f"tls://epypes:secret@127.0.0.1:{port}/a?ca={certificates / 'ca.pem'}")
    assert b"secret" not in b"".join(heard)
