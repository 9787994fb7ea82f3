from __future__ import annotations

import asyncio
import logging
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import uuid
from contextlib import closing, contextmanager
from time import monotonic

import pytest

import epypes as ep
from epypes.errors import BrokerError, MessageError
from epypes.transport.channels import open_channel, place_of
from epypes.transport.channels.jetstream import places
from epypes.transport.channels.jetstream.pulls import EXPIRES_S, Pulls
from tests.apart import apart
from tests.brokers.nats import MAX_PAYLOAD, PASSWORD, is_installed, server

pytestmark = pytest.mark.skipif(
    not is_installed(), reason="nats-server is not installed on this machine: sh .ci/brokers"
)
WAIT_S = 60.0


@pytest.fixture(scope="module")
def broker():
    with server() as running:
        yield running


@pytest.fixture
def mortal():
    """A server that a test may end."""
    with server() as running:
        yield running


@pytest.fixture
def name():
    return f"tests.{uuid.uuid4().hex[:8]}"


@pytest.fixture
def opened(broker, name):
    """Opens a channel to a place of the test's own; all are closed in the end."""
    channels = []

    def open_(subject="", *, at=None, prefetch=1, timeout_s=WAIT_S, **options):
        address = (at or broker).address(subject or name, **{"create": True, **options})
        channels.append(open_channel(address, prefetch=prefetch, timeout_s=timeout_s))
        return channels[-1]

    yield open_
    for channel in channels:
        channel.close()


def by_hand(broker, work):
    """Return what a coroutine returns that uses the library alone, as another program does."""
    import nats

    async def live():
        client = await nats.connect(f"nats://127.0.0.1:{broker.port}", user=broker.user, password=broker.password)
        try:
            return await work(client)
        finally:
            await client.close()

    return apart(lambda: asyncio.run(live()))


@contextmanager
def who_says(greeting):
    """Give the port of a program that greets who connects, and what it is told until that one has gone."""
    heard = []

    def listen(other):
        connected, _ = other.accept()
        with connected:
            connected.sendall(greeting)
            while told := connected.recv(1_000):
                heard.append(told)

    with socket.create_server(("127.0.0.1", 0)) as other:
        thread = threading.Thread(target=listen, args=(other,), daemon=True)
        thread.start()
        yield other.getsockname()[1], heard
        thread.join(WAIT_S)
        assert not thread.is_alive()


def kept(broker, stream):
    async def count(client):
        return (await client.jetstream().stream_info(stream)).state.messages

    return by_hand(broker, count)


def until(holds):
    end_s = monotonic() + WAIT_S
    while not holds():
        assert monotonic() < end_s


def frames_of(item):
    return [bytes(frame) for frame in item.frames]


@pytest.mark.parametrize("frames", [[b"one"], [b""], [b"a", b"", b"ccc"], [memoryview(b"seen"), b"x" * 1_000_000]])
def test_what_is_sent_arrives_with_its_id_and_headers(opened, frames):
    sender, receiver = opened(), opened()
    sender.send(frames, id="äöü/1", headers={"kind": "tüst"})
    item = receiver.receive(WAIT_S)
    assert frames_of(item) == [bytes(frame) for frame in frames]
    assert (item.id, item.attempt, item.headers["kind"]) == ("äöü/1", 1, "tüst")


def test_what_is_acknowledged_is_gone(opened, broker, name):
    channel = opened()
    channel.send([b"x"])
    channel.receive(WAIT_S).ack()
    channel.close()
    assert kept(broker, name.replace(".", "_")) == 0


def test_nothing_is_received_where_nothing_was_sent(opened):
    assert opened().receive(0) is None


@pytest.mark.slow
def test_each_message_of_a_queue_goes_to_one_receiver(opened):
    sender, first, second = opened(), opened(prefetch=3), opened(prefetch=100)
    for number in range(10):
        sender.send([b"%d" % number])
    got = [first.receive(WAIT_S) for _ in range(3)]
    assert first.receive(0.1) is None, "It holds as many as it may."
    got += [second.receive(WAIT_S) for _ in range(7)]
    assert sorted(frames_of(item) for item in got) == [[b"%d" % number] for number in range(10)]
    got[0].ack()
    sender.send([b"more"])
    assert {first.receive(0.1) or second.receive(WAIT_S)}


def test_what_a_closed_receiver_held_comes_to_another_at_once(opened, monkeypatch):
    # Longer than the test waits: the server does not wait for the acknowledgement of what was given back.
    monkeypatch.setattr(places, "_SHARED", places._SHARED.evolve(ack_wait=10 * WAIT_S))
    sender, first, second = opened(), opened(prefetch=4), opened()
    for number in range(4):
        sender.send([b"%d" % number], id=str(number))
    until(lambda: first.receive(0.1))
    first.close()
    items = []
    while len(items) < 4:
        items.append(second.receive(WAIT_S))
        items[-1].ack()
    assert {(item.id, item.attempt) for item in items} == {(str(number), 2) for number in range(4)}


@pytest.fixture
def impatient(monkeypatch):
    """Intervals of the connection that are shorter than a user's, so that the tests of them are."""
    for name, value in (
        ("places._SHARED", places._SHARED.evolve(ack_wait=1.0)),
        ("pulls.EXPIRES_S", 1.0),
        ("link._BEAT_S", 0.5),
        ("link._SILENCE_S", 3.0),
    ):
        monkeypatch.setattr(f"epypes.transport.channels.jetstream.{name}", value)


@pytest.mark.slow
def test_what_a_killed_receiver_held_comes_again_soon(impatient, opened, broker, name):
    # Receiving decides how long the server waits for an acknowledgement.
    first = opened()
    assert first.receive(0.0) is None
    first.close()
    opened().send([b"x"], id="1")
    code = f"""
import time
from epypes.transport.channels import open_channel
channel = open_channel({broker.address(name)!r})
print(channel.receive({WAIT_S}).attempt, flush=True)
time.sleep(100)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"1\n"
        other.kill()
    item = opened().receive(WAIT_S)
    assert (item.id, item.attempt) == ("1", 2)


@pytest.mark.slow
def test_what_is_worked_on_for_long_does_not_come_again(impatient, opened):
    sender, worker, other = opened(), opened(), opened()
    sender.send([b"x"])
    item = worker.receive(WAIT_S)
    assert other.receive(2.5) is None
    item.ack()
    assert worker.receive(0.2) is None
    sender.send([b"y"])
    assert other.receive(WAIT_S), "It has asked again meanwhile, more than once."


def test_what_is_rejected_is_put_aside_with_the_reason(opened, name):
    sender, receiver = opened(), opened()
    sender.send([b"a", b"bc"], id="7", headers={"kind": "test"})
    receiver.receive(WAIT_S).reject("it has\ntwo lines")
    receiver.close()
    dead = opened(f"{name}.dead").receive(WAIT_S)
    assert frames_of(dead) == [b"a", b"bc"]
    assert (dead.id, dead.attempt, dead.headers["kind"]) == ("7", 1, "test")
    assert dead.headers["epypes-reason"] == "it has two lines"
    assert (dead.headers["epypes-from"], dead.headers["epypes-attempts"]) == (name, "1")
    assert opened().receive(0.1) is None


def test_an_event_that_failed_is_put_aside_again_when_it_was_sent_again(opened, broker, name):
    """Both have one id, within the time in which the server forgets what it has already."""
    channel = opened()
    for body in (b"first", b"second"):
        told = {"epypes-id": "7", "Nats-Expected-Stream": name.replace(".", "_")}
        by_hand(broker, lambda client, body=body, told=told: client.jetstream().publish(name, body, headers=told))
        channel.receive(WAIT_S).reject("no")
    dead = opened(f"{name}.dead", prefetch=2)
    items = [dead.receive(WAIT_S) for _ in range(2)]
    assert [(frames_of(item), item.id) for item in items] == [([b"first"], "7"), ([b"second"], "7")]


def test_a_pattern_of_subjects_is_received_from_and_not_sent_to(opened, name):
    opened(f"{name}.dead")
    receiver = opened(f"{name}.in.*", dead=f"{name}.dead")
    opened(f"{name}.in.left").send([b"x"])
    assert frames_of(receiver.receive(WAIT_S)) == [b"x"]
    with pytest.raises(MessageError, match="stands for many subjects: name the one"):
        receiver.send([b"x"])
    with pytest.raises(BrokerError, match="say where dead letters go"):
        opened(f"{name}.in.*")


def test_dead_letters_go_where_they_are_asked_for(opened, name):
    channel = opened(dead=f"{name}.aside")
    channel.send([b"x"])
    channel.receive(WAIT_S).reject("no")
    assert opened(f"{name}.aside").receive(WAIT_S).headers["epypes-reason"] == "no"


@pytest.mark.slow
def test_the_first_word_on_a_message_counts(opened, name):
    channel = opened()
    channel.send([b"x"])
    item = channel.receive(WAIT_S)
    item.ack()
    item.reject("too late")
    assert opened(f"{name}.dead").receive(0.2) is None


def test_a_message_of_another_program_is_one_frame(opened, broker, name):
    channel = opened()
    by_hand(broker, lambda client: client.jetstream().publish(name, b"hello", headers={"Nats-Msg-Id": "9"}))
    item = channel.receive(WAIT_S)
    assert (frames_of(item), item.id, dict(item.headers)) == ([b"hello"], "9", {})


def test_a_message_whose_sizes_do_not_fit_comes_without_frames_and_says_so(opened, broker, name):
    channel = opened()
    by_hand(broker, lambda client: client.jetstream().publish(name, b"hello", headers={"epypes-frames": "7,nine"}))
    item = channel.receive(WAIT_S)
    assert item.frames == ()
    assert "7,nine" in item.headers["epypes-error"]


def test_a_subscriber_that_may_not_receive_fails_at_its_start(opened, broker, name):
    from nats.js.api import ConsumerConfig

    opened()
    other = ConsumerConfig(durable_name="epypes", deliver_subject="elsewhere")
    stream = name.replace(".", "_")
    by_hand(broker, lambda client: client.jetstream().add_consumer(stream, other))
    subscriber, told = ep.Subscriber(broker.address(name), queue.Queue()), []
    subscriber.on_connection = lambda *what: told.append(what)
    with pytest.raises(BrokerError, match="does not wait to be asked"):
        subscriber.start()
    assert told == []
    assert not subscriber.is_connected


@pytest.mark.slow
def test_what_is_sent_again_with_its_id_is_kept_once(opened):
    channel = opened()
    for _ in range(2):
        channel.send([b"x"], id="same")
    channel.receive(WAIT_S).ack()
    assert channel.receive(0.2) is None


def test_one_stream_may_keep_events_answers_and_dead_letters_of_one_id(opened, broker, name):
    async def make(client):
        await client.jetstream().add_stream(name=name.replace(".", "_"), subjects=[f"{name}.>"])

    by_hand(broker, make)
    places = {
        place: opened(f"{name}.{place}", group=place, create=False, dead=f"{name}.dead") for place in ("in", "out")
    }
    for channel in places.values():
        channel.send([b"x"], id="1")
    places["in"].receive(WAIT_S).reject("bad")
    places["out"].receive(WAIT_S).reject("bad as well")
    dead = opened(f"{name}.dead", create=False)
    assert dead.receive(WAIT_S).id == "1"
    with pytest.raises(BrokerError, match=r"consumer 'in' .* is for .*\.in\. Add &group=NAME"):
        opened(f"{name}.out", group="in", create=False, dead=f"{name}.dead").receive(0)


@pytest.mark.parametrize(
    ("credentials", "text"),
    [("epypes:wrong@", "refuses the user 'epypes' with this password"), ("", "refuses who has no user and password")],
)
def test_refused_credentials_are_said_without_the_password(broker, credentials, text):
    with pytest.raises(BrokerError, match=text) as caught:
        open_channel(f"nats://{credentials}127.0.0.1:{broker.port}/a", timeout_s=WAIT_S)
    assert "wrong" not in str(caught.value)


def test_a_subject_that_no_stream_keeps_is_an_error(opened, name):
    with pytest.raises(BrokerError, match=rf"No stream at .* keeps the subject '{name}'.*create=true"):
        opened(create=False)


def test_dead_letters_that_no_stream_keeps_are_an_error(opened, broker, name):
    async def make(client):
        await client.jetstream().add_stream(name=name.replace(".", "_"), subjects=[name])

    by_hand(broker, make)
    with pytest.raises(BrokerError, match=rf"keeps the subject '{name}\.dead'"):
        opened(create=False)


@pytest.mark.slow
def test_a_server_without_jetstream_is_an_error_for_queues_alone(opened):
    with server(jetstream=False) as plain:
        with pytest.raises(BrokerError, match=r"JetStream is off there.*nats-server -js"):
            opened("a", at=plain)
        opened("a", at=plain, kind="broadcast").send([b"x"])


def test_nobody_at_the_port_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BrokerError, match=r"can't be reached: nobody listens there"):
        open_channel(f"nats://127.0.0.1:{port}/a", timeout_s=WAIT_S)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("greeting", "text"),
    [(b"HTTP/1.1 400 Bad Request\r\n\r\n", "is no NATS server"), (b"", "no NATS server has answered within 0.5 s")],
)
def test_a_port_of_another_program_is_an_error(greeting, text):
    with who_says(greeting) as (port, _), pytest.raises(BrokerError, match=text):
        open_channel(f"nats://127.0.0.1:{port}/a", timeout_s=0.5)


@pytest.mark.parametrize("subject", ["two words", "a..b", ".a", "a.", "a>b"])
def test_a_name_that_can_not_be_a_subject_is_an_error(opened, subject):
    with pytest.raises(BrokerError, match="is no subject of NATS"):
        opened(subject.replace(" ", "%20"))


def test_a_message_larger_than_the_server_takes_is_refused_and_the_next_one_is_sent(opened):
    channel = opened()
    with pytest.raises(MessageError, match=r"8,388,608 at most. Raise max_payload") as caught:
        channel.send([bytes(MAX_PAYLOAD)], id="large")
    assert caught.value.reason == "too large"
    channel.send([bytes(MAX_PAYLOAD - 1_000)], id="fits")
    assert channel.receive(WAIT_S).id == "fits"


def test_what_a_stream_refuses_is_said(opened, broker, name):
    async def make(client):
        settings = {"max_msgs": 1, "discard": "new", "max_msg_size": 1_000}
        await client.jetstream().add_stream(name=name.replace(".", "_"), subjects=[name, f"{name}.dead"], **settings)

    by_hand(broker, make)
    channel = opened(create=False)
    with pytest.raises(MessageError, match="message size exceeds") as caught:
        channel.send([bytes(2_000)])
    assert caught.value.reason == "too large"
    channel.send([b"x"])
    with pytest.raises(BrokerError, match="maximum messages exceeded"):
        channel.send([b"y"])


def test_a_header_that_can_not_be_one_is_refused(opened):
    with pytest.raises(MessageError, match="can't be the name of a header"):
        opened().send([b"x"], headers={"a: b": "c"})


def test_a_broadcast_goes_to_all_who_listen_and_is_not_kept(opened):
    sender, first, second = (opened(kind="broadcast") for _ in range(3))
    sender.send([b"too early"])
    assert first.receive(0) is second.receive(0) is None
    sender.send([b"a", b"b"], id="1")
    for listener in (first, second):
        item = listener.receive(WAIT_S)
        assert (frames_of(item), item.id, item.attempt) == ([b"a", b"b"], "1", 0)
        item.ack()
        assert listener.receive(0) is None


@pytest.mark.slow
def test_every_receiver_of_a_log_gets_all_of_it_in_one_order(opened):
    first, second = opened(kind="log"), opened(kind="log")
    for number in range(600):
        (first, second)[number % 2].send([b"%d" % number], id=str(number))
    late = opened(kind="log")
    for channel in (first, second, late):
        assert [channel.receive(WAIT_S).id for _ in range(600)] == [str(number) for number in range(600)]
        assert channel.receive(0) is None


@pytest.mark.slow
@pytest.mark.parametrize("method", ["send", "receive"])
def test_a_server_that_is_killed_is_an_error_at_once_and_keeps_what_it_confirmed(opened, mortal, method):
    channel = opened("a", at=mortal)
    channel.send([b"kept"], id="1")
    channel.receive(WAIT_S)

    def use():
        for number in range(1_000_000):
            channel.send([b"x"], id=f"more{number}") if method == "send" else channel.receive(WAIT_S)

    threading.Timer(0.2, lambda: mortal.stop(at_once=True)).start()
    with pytest.raises(BrokerError, match="is over: the server has closed it, or has gone away"):
        use()
    with pytest.raises(BrokerError):
        channel.send([b"x"])
    with pytest.raises(BrokerError):
        channel.receive(WAIT_S)
    channel.close()
    until(lambda: mortal.process is None)
    mortal.start()
    receiver = opened("a", at=mortal, prefetch=1_000_000)
    until(lambda: receiver.receive(WAIT_S).id == "1")


@pytest.mark.slow
def test_a_server_that_says_nothing_is_noticed(impatient, opened, mortal):
    sender, receiver = opened("a", at=mortal, timeout_s=1.0), opened("a", at=mortal)
    receiver.receive(0)
    mortal.process.send_signal(signal.SIGSTOP)
    try:
        with pytest.raises(BrokerError, match="has not confirmed a message within 1 s. It may have it"):
            sender.send([bytes(5_000_000)])
        with pytest.raises(BrokerError, match="nothing was heard of the server"):
            receiver.receive(WAIT_S)
        sender.close()
        receiver.close()
    finally:
        mortal.process.send_signal(signal.SIGCONT)


def test_a_stream_that_is_deleted_meanwhile_is_an_error(opened, broker, name):
    sender, receiver = opened(), opened()
    receiver.receive(0)
    by_hand(broker, lambda client: client.jetstream().delete_stream(name.replace(".", "_")))
    with pytest.raises(BrokerError, match="the stream is gone"):
        receiver.receive(WAIT_S)
    with pytest.raises(BrokerError, match="No stream at .* keeps what is sent there any more"):
        sender.send([b"x"])


@pytest.mark.slow
def test_who_waits_for_a_message_hears_that_the_channel_was_closed(opened):
    channel = opened()
    threading.Timer(0.2, channel.close).start()
    with pytest.raises(BrokerError, match="it was closed"):
        channel.receive(WAIT_S)
    channel.close()
    with pytest.raises(BrokerError, match="it was closed"):
        channel.send([b"x"])


def test_a_closed_channel_leaves_no_thread(opened, name):
    channel = opened()
    channel.send([b"x"])
    item = channel.receive(WAIT_S)
    channel.close()
    item.ack()
    assert not [thread for thread in threading.enumerate() if name in thread.name]


@pytest.mark.slow
def test_the_library_prints_and_logs_nothing(mortal):
    code = f"""
import threading
from epypes.errors import BrokerError
from epypes.transport.channels import open_channel
channels = [open_channel({mortal.address("a", create=True)!r}) for _ in range(2)]
channels[0].send([b"x"])
channels[1].receive(60)
print("ready", flush=True)
for channel in channels:
    try:
        while True:
            channel.receive(60)
    except BrokerError:
        print("lost", flush=True)
channels[0].close()
try:
    open_channel({mortal.address("a")!r})
except BrokerError:
    print("away")
"""
    command = [sys.executable, "-X", "dev", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "ready\n"
        mortal.stop(at_once=True)
        out, told = other.communicate(timeout=WAIT_S)
    assert out.split() == ["lost", "lost", "away"]
    # What asyncio itself finds slow on a busy machine, in its developers' mode.
    assert not re.sub(r"Executing <.*> took .* seconds\n", "", told)


def test_a_server_that_talks_nonsense_is_lost_without_a_word_from_the_library(caplog):
    info = b'INFO {"server_id":"x","version":"2.9.10","max_payload":1000}\r\nPONG\r\n-ERR \r\n'

    def use(port):
        with closing(open_channel(f"nats://127.0.0.1:{port}/a?kind=broadcast", timeout_s=WAIT_S)) as channel:
            channel.receive(WAIT_S)

    with who_says(info) as (port, _), pytest.raises(BrokerError, match="is over: the server has closed it"):
        use(port)
    assert not caplog.records


def test_who_sends_to_elsewhere_unencrypted_is_told_once_who_can_read_it(caplog):
    with caplog.at_level(logging.WARNING, "epypes.transport"):
        for _ in range(2):
            with pytest.raises(BrokerError, match="can't be reached"):
                open_channel("nats://192.0.2.1/a", timeout_s=0.1)
    assert [record.message.count("can read along") for record in caplog.records] == [1]


@pytest.mark.slow
def test_an_encrypted_server_is_checked_by_the_named_certificates(opened, certificates):
    with server(tls=(certificates / "cert.pem", certificates / "key.pem")) as encrypted:
        channel = opened("a", at=encrypted, ca=certificates / "ca.pem")
        channel.send([b"x" * 100_000], id="1")
        assert channel.receive(WAIT_S).id == "1"
        channel.close()
        with pytest.raises(BrokerError, match=r"can't be trusted: .*\?ca=FILE"):
            opened("a", at=encrypted)
        with pytest.raises(BrokerError, match="can't be read from /nowhere"):
            opened("a", at=encrypted, ca="/nowhere")


def test_a_server_that_does_not_encrypt_gets_no_password(certificates):
    info = b'INFO {"server_id":"x","version":"2.9.10","auth_required":true,"max_payload":1000}\r\n'
    with who_says(info) as (port, heard), pytest.raises(BrokerError, match="can't be trusted: it does not encrypt"):
        open_channel(f"tls://epypes:secret@127.0.0.1:{port}/a?ca={certificates / 'ca.pem'}", timeout_s=60)
    assert b"secret" not in b"".join(heard)


def test_a_receiver_asks_for_no_more_than_it_has_room_for():
    pulls = Pulls(8)
    assert pulls.wanted(0, 0.0) == (1, 8)
    assert pulls.wanted(0, 0.0) == (0, 0)
    for _ in range(8):
        pulls.came()
    assert pulls.wanted(held=5, now_s=0.1) == (0, 0), "Not for less than half of the room."
    assert pulls.wanted(held=4, now_s=0.1) == (2, 4)
    pulls.ended(2, pending=4)
    assert pulls.wanted(held=4, now_s=0.2) == (3, 4)
    assert pulls.wanted(held=0, now_s=0.2) == (4, 4)


def test_who_holds_more_than_half_of_what_he_may_asks_for_the_rest_now_and_then():
    pulls = Pulls(8)
    assert pulls.wanted(5, 0.0) == (0, 0)
    assert pulls.wanted(5, 0.0, is_due=True) == (1, 3)
    assert pulls.wanted(5, 0.1, is_due=True) == (0, 0)


@pytest.mark.slow
def test_who_waits_for_as_many_as_he_may_hold_gets_them_however_late_the_last_is_sent(impatient, opened):
    sender, receiver = opened(), opened(prefetch=4)
    for _ in range(3):
        sender.send([b"early"])
        assert receiver.receive(WAIT_S)
    assert receiver.receive(3.0) is None
    sender.send([b"late"])
    assert frames_of(receiver.receive(WAIT_S)) == [b"late"]


def test_what_may_be_held_for_a_while_is_asked_for_one_by_one():
    pulls = Pulls(8)
    assert pulls.wanted(8, 0.0) == (0, 0)
    pulls.more = 1
    assert pulls.wanted(8, 0.0) == (1, 1)
    pulls.came()
    assert pulls.wanted(9, 0.1) == (0, 0)
    assert pulls.wanted(8, 0.1) == (2, 1)


def test_a_request_that_the_server_never_ended_is_given_up():
    pulls = Pulls(1)
    pulls.wanted(0, 0.0)
    assert pulls.wanted(0, EXPIRES_S) == (0, 0)
    assert pulls.wanted(0, EXPIRES_S + 2) == (2, 1)


def test_the_password_is_nowhere_in_the_place(broker):
    assert PASSWORD not in str(place_of(broker.address("a")))
