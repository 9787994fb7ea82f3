"""What every channel promises: the same sentences for all brokers, on real servers, and for peers without a broker."""

from __future__ import annotations

import contextlib
import os
import queue as stdlib_queue
import signal
import socket
import threading
from collections import Counter
from time import monotonic
from uuid import uuid4

import pytest

from epypes.errors import AddressError, BrokerError, MessageError
from epypes.transport import memory
from epypes.transport.address import open_channel, parse_address
from epypes.transport.channel import ChannelOptions
from tests.brokers import mosquitto as mosquitto_servers
from tests.brokers import nats as nats_servers
from tests.transport.channels import PEERS, WAIT_S, OfPeers, Receiver, Sender, body, join
from tests.transport.peers import line_of, process, wait_until


@pytest.fixture
def impatient(monkeypatch):
    """NATS waits for less time than for a user."""
    for interval, value_s in {"ACK_WAIT_S": 1.0, "_REQUEST_S": 1.0, "_PING_S": 0.5, "_PROGRESS_S": 0.25}.items():
        monkeypatch.setattr(f"epypes.transport.brokers.nats.{interval}", value_s)


KILLED = """
import os, sys, threading
from epypes.transport.address import open_channel
from epypes.transport.channel import ChannelOptions
held = []
def hold(delivery):
    held.append(delivery)
    if len(held) == int(sys.argv[2]):
        os.write(1, b"holds\\n")
open_channel(sys.argv[1], ChannelOptions(prefetch=int(sys.argv[2]))).open(hold)
os.write(1, b"open\\n")
threading.Event().wait()
"""


class InThisProcess:
    """The broker in this process, with the same methods as the servers."""

    name, password, has_written = "memory", "secret", True

    def __init__(self):
        self._host, self._away = uuid4().hex, None

    def address(self, name, **options):
        query = "&".join(f"{key}={str(value).lower()}" for key, value in options.items())
        return f"memory://{self._host}/{name}?{query}"

    def stop(self, *, at_once=False):
        self._away = memory.away(self._host)
        self._away.__enter__()

    def start(self):
        self._away.__exit__(None, None, None)


@pytest.fixture(scope="module")
def within():
    return InThisProcess()


def at(*names):
    """Return the parameters of a fixture: a server takes a second or more to start."""
    return [name if name == "within" else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(params=at("within", "rabbitmq", "nats", "mosquitto"))
def peer(request):
    """Each of the brokers in turn."""
    return request.getfixturevalue(request.param)


counting = pytest.mark.parametrize("peer", at("within", "rabbitmq", "nats"), indirect=True)


@pytest.fixture
def queue(peer, name):
    return peer.address(name, create=True)


@pytest.fixture(params=[*at("within", "rabbitmq", "nats", "mosquitto"), *PEERS])
def carrier(request):
    """Each of the brokers in turn, and each middleware without one."""
    return OfPeers(request.param) if request.param in PEERS else request.getfixturevalue(request.param)


@pytest.fixture
def place(carrier, name):
    return carrier.address(name, create=True)


def attempts(peer, count):
    """Return what a delivery says of its attempt: MQTT does not count, and without a broker there is none."""
    return 0 if peer.name == "mosquitto" or isinstance(peer, OfPeers) else count


FRAMES = {
    "one": [b"one"],
    "many": [b"%d" % number for number in range(40)],
    "of 0 bytes": [b""],
    "some of 0 bytes": [b"", b"a", b"", b""],
    "1 MB": [bytes(range(256)) * 4096],
    "views of 1 MB": [b"head", memoryview(bytes(1 << 20))],
}


def test_frames_arrive_as_they_were_sent_and_can_not_be_changed(place, opened):
    receiver, sender = opened(Receiver, place), opened(Sender, place)
    join(sender, receiver)
    for kind, frames in FRAMES.items():
        sender.send(*frames)
        delivery = receiver.next()
        assert [bytes(frame) for frame in delivery.frames] == [bytes(frame) for frame in frames], kind
        assert all(memoryview(frame).readonly for frame in delivery.frames), kind
        delivery.ack()


def test_id_and_headers_come_along_if_there_are_any(carrier, place, opened):
    sender, receiver = opened(Sender, place), opened(Receiver, place, prefetch=2)
    join(sender, receiver)
    sender.send(b"a", b"b", id="event 1: grün", headers={"epypes-x": "grün, 1"})
    delivery = receiver.next()
    assert (delivery.id, delivery.attempt) == ("event 1: grün", attempts(carrier, 1))
    assert delivery.headers == {"epypes-x": "grün, 1"}
    sender.send(b"a")
    delivery = receiver.next()
    assert (delivery.id, dict(delivery.headers)) == ("", {})


ODD = ["\r\nMore: 1", "a\nb", " a", "a ", "\x1b[31m", "\ud800", "\uffff", "a\0"]


def test_what_would_not_arrive_as_it_is_is_refused_and_the_next_goes_out(place, opened):
    sender, receiver = opened(Sender, place), opened(Receiver, place, prefetch=100)
    join(sender, receiver)
    for text in ODD:
        with pytest.raises(MessageError, match="can't be sent"):
            sender.send(b"a", id=text)
        with pytest.raises(MessageError, match="can't be sent"):
            sender.send(b"a", headers={"epypes-x": text})
    for frames in ([], [b""] * 1_027):
        with pytest.raises(MessageError, match="1 to 1,026 frames"):
            sender.send(*frames)
    for headers in ({"epypes-x": "x" * 120_000}, {"x" * 300 + ":": "x"}):
        with contextlib.suppress(MessageError):
            sender.send(b"a", headers=headers)
            receiver.next().ack()
    sender.send(*[b""] * 1_026, id="good")
    assert len(receiver.next().frames) == 1_026


def test_a_message_over_the_limit_of_the_channel_is_refused(place, opened):
    sender = opened(Sender, place, max_message_bytes=1_000)
    with pytest.raises(MessageError) as refused:
        sender.send(bytes(1_001))
    assert refused.value.reason == "too large"
    sender.send(bytes(1_000))


@pytest.mark.parametrize("is_early", [True, False], ids=["before", "after"])
def test_what_is_sent_before_or_after_the_consumer_came_arrives_in_order(queue, opened, is_early):
    made = opened(Sender, queue) if is_early else opened(Receiver, queue, prefetch=8)
    sender = made if is_early else opened(Sender, queue)
    for number in range(100):
        sender.channel.send([b"%d" % number])
    wait_until(lambda: sender.channel.waiting == 0, WAIT_S)
    receiver = opened(Receiver, queue, prefetch=8) if is_early else made
    for number in range(100):
        delivery = receiver.next()
        assert body(delivery) == b"%d" % number
        delivery.ack()


def test_close_sends_what_was_accepted(place, opened):
    sender, receiver, outcomes = opened(Sender, place), opened(Receiver, place, prefetch=100), []
    join(sender, receiver)
    for number in range(100):
        sender.channel.send([b"%d" % number], confirmed=outcomes.append)
    sender.channel.close(WAIT_S)
    assert outcomes == [None] * 100
    assert {body(delivery) for delivery in receiver.take(100)} == {b"%d" % number for number in range(100)}
    with pytest.raises(BrokerError, match="closed"):
        sender.channel.send([b"late"])


def test_the_first_verdict_is_final(queue, opened, name):
    sender, receiver = opened(Sender, queue), opened(Receiver, queue, prefetch=1)
    sender.send(b"a")
    delivery = receiver.next()
    delivery.ack()
    delivery.reject("too late")
    delivery.nack()
    sender.send(b"b")
    assert body(receiver.next()) == b"b"
    receiver.channel.close()
    assert body(opened(Receiver, queue).next()) == b"b"


def test_what_was_not_acknowledged_is_delivered_again_to_another_and_counted(peer, queue, opened):
    opened(Sender, queue).send(b"a", b"", id="x", headers={"k": "v"})
    for attempt in (1, 2, 3):
        # NATS takes a delivery back that it tries on the request of a consumer that has just closed.
        receiver = opened(Receiver, queue, prefetch=1)
        delivery = receiver.next()
        assert (delivery.attempt, delivery.id, body(delivery)) == (attempts(peer, attempt), "x", b"a|")
        assert delivery.headers["k"] == "v"
        receiver.channel.close()


def test_a_nack_has_it_delivered_again(peer, queue, opened):
    receiver = opened(Receiver, queue)
    opened(Sender, queue).send(b"a", b"b", id="x", headers={"k": "v"})
    receiver.next().nack()
    again = receiver.next()
    assert (again.attempt, again.id, body(again)) == (attempts(peer, 2), "x", b"a|b")
    assert again.headers == {"k": "v"}


def test_what_was_delivered_and_never_taken_comes_to_another(queue, opened):
    first, sender = opened(Receiver, queue, prefetch=10), opened(Sender, queue)
    for number in range(10):
        sender.send(b"%d" % number)
    first.next()
    first.channel.close()
    came = [body(delivery) for delivery in opened(Receiver, queue, prefetch=10).take(10)]
    assert sorted(came) == [b"%d" % number for number in range(10)]


def test_what_a_killed_consumer_held_is_delivered_again(queue, opened, impatient):
    sender = opened(Sender, queue)
    # The first consumer of a queue decides how long NATS waits for an acknowledgement.
    opened(Receiver, queue).channel.close()
    with process(KILLED, queue, "2") as consumer:
        assert line_of(consumer) == "open"
        for number in range(4):
            sender.send(b"%d" % number)
        assert line_of(consumer) == "holds"
        consumer.send_signal(signal.SIGKILL)
        consumer.wait()
    receiver, came = opened(Receiver, queue, prefetch=4), set()
    while len(came) < 4:
        delivery = receiver.next()
        came.add(body(delivery))
        delivery.ack()
    assert came == {b"%d" % number for number in range(4)}


# The broker in this process ends with it.
test_what_a_killed_consumer_held_is_delivered_again = pytest.mark.parametrize(
    "peer", at("rabbitmq", "nats", "mosquitto"), indirect=True
)(test_what_a_killed_consumer_held_is_delivered_again)


def test_what_is_rejected_is_in_the_dead_letter_queue_with_its_reason(peer, queue, opened, name):
    receiver, sender = opened(Receiver, queue), opened(Sender, queue)
    sender.send(b"a", b"b", id="x", headers={"k": "v"})
    receiver.next().reject("it is no picture:\r\n\0 grün \x1b[31m\ud800\uffff")
    letters = opened(Receiver, parse_address(queue).dead_letters)
    letter = letters.next()
    assert (letter.id, body(letter)) == ("x", b"a|b")
    expected = {"epypes-reason": "it is no picture: grün [31m?", "epypes-from": name, "k": "v"}
    expected["epypes-attempts"] = str(attempts(peer, 1))
    assert {key: letter.headers[key] for key in expected} == expected
    letter.ack()
    sender.send(b"next")
    assert body(receiver.next()) == b"next"


def test_no_more_are_delivered_than_the_prefetch_window_until_one_is_settled(queue, opened):
    sender, receiver = opened(Sender, queue), opened(Receiver, queue, prefetch=3)
    for number in range(6):
        sender.send(b"%d" % number)
    held = receiver.take(3)
    assert receiver.is_quiet()
    held[1].ack()
    receiver.next()
    held[0].reject("no")
    receiver.next()
    assert receiver.is_quiet()


def test_a_paused_channel_delivers_nothing_and_what_it_had_delivered_can_be_acknowledged(queue, opened):
    sender, receiver = opened(Sender, queue), opened(Receiver, queue, prefetch=2)
    sender.send(b"a")
    held = receiver.next()
    receiver.channel.pause()
    sender.send(b"b")
    assert receiver.is_quiet()
    held.ack()
    receiver.channel.resume()
    assert body(receiver.next()) == b"b"


def test_a_handler_may_wait_and_the_broker_keeps_the_rest(queue, opened):
    room, taken = threading.Semaphore(0), []

    def take(delivery):
        room.acquire(timeout=WAIT_S)
        taken.append(body(delivery))
        delivery.ack()

    channel = open_channel(queue, ChannelOptions(prefetch=2, timeout_s=WAIT_S))
    channel.open(take)
    sender = opened(Sender, queue)
    for number in range(10):
        sender.send(b"%d" % number)
    assert taken == []
    room.release(10)
    wait_until(lambda: len(taken) == 10, WAIT_S)
    channel.close()
    assert taken == [b"%d" % number for number in range(10)]


def test_a_handler_that_fails_has_the_message_delivered_again(queue, opened, caplog):
    taken = stdlib_queue.SimpleQueue()

    def take(delivery):
        taken.put(delivery)
        if delivery.id == "a" and caplog.text.count("could not be taken") == 0:
            raise RuntimeError("a bug")
        delivery.ack()

    channel = open_channel(queue, ChannelOptions(timeout_s=WAIT_S))
    channel.open(take)
    opened(Sender, queue).send(b"a", id="a")
    assert [taken.get(timeout=WAIT_S).id for _ in range(2)] == ["a", "a"]
    channel.close()
    assert "could not be taken" in caplog.text


def test_consumers_of_a_queue_share_it(queue, opened):
    receivers = [opened(Receiver, queue, prefetch=4) for _ in range(3)]
    sender, came = opened(Sender, queue), Counter()
    for number in range(60):
        sender.channel.send([b"a"], id=f"{number}")
    end_s, share = monotonic() + WAIT_S, [0, 0, 0]
    while len(came) < 60 and monotonic() < end_s:
        for index, receiver in enumerate(receivers):
            if not receiver.arrived.empty():
                delivery = receiver.next()
                came[delivery.id] += 1
                share[index] += 1
                delivery.ack()
    assert came == Counter(f"{number}" for number in range(60))
    assert all(share)


def test_a_message_is_settled_from_any_thread(queue, opened):
    sender, receiver = opened(Sender, queue), opened(Receiver, queue, prefetch=20)
    for _ in range(20):
        sender.send(b"a")
    threads = [threading.Thread(target=delivery.ack) for delivery in receiver.take(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    receiver.channel.close()
    sender.send(b"last")
    assert body(opened(Receiver, queue).next()) == b"last"


def test_a_broadcast_reaches_all_that_are_connected_and_is_not_kept(carrier, name, opened):
    address = carrier.address(name, kind="broadcast", create=True)
    sender = opened(Sender, address)
    sender.send(b"too early")
    receivers = [opened(Receiver, address) for _ in range(3)]
    join(sender, *receivers)
    for number in range(100):
        sender.channel.send([b"%d" % number, b""], id=f"{number}")
    for receiver in receivers:
        came = receiver.take(100)
        assert [body(delivery) for delivery in came] == [b"%d|" % number for number in range(100)]
        for delivery in came:
            delivery.ack()
    assert opened(Receiver, address).is_quiet()


# MQTT has no log: the newest message, and those that come, which test_mqtt.py tries.
@counting
def test_a_log_is_read_by_all_from_the_first_in_the_same_order(peer, name, opened):
    address = peer.address(name, kind="log", create=True)
    early = opened(Receiver, address)
    senders = [opened(Sender, address) for _ in range(3)]
    for number in range(300):
        senders[number % 3].channel.send([b"%d" % number])
    orders = [[body(delivery) for delivery in receiver.take(300)] for receiver in (early, opened(Receiver, address))]
    assert orders[0] == orders[1]
    assert len(set(orders[0])) == 300


def test_a_queue_that_is_not_there_is_an_error_without_the_password(peer, name, caplog):
    address = peer.address(name)
    channel = open_channel(address, ChannelOptions(timeout_s=WAIT_S))
    outcomes = []
    try:
        channel.open(None)
        # MQTT finds out when a message is sent, and tries again until there is a consumer.
        channel.send([b"a"], confirmed=outcomes.append)
        wait_until(lambda: "create=true" in caplog.text, WAIT_S)
    except BrokerError as error:
        outcomes.append(error)
    finally:
        channel.close(0.0)
    refused = f"{outcomes[0]} {caplog.text}"
    assert name in refused
    assert "create=true" in refused
    assert (parse_address(address).password or "nothing") not in refused


def test_a_broker_that_goes_away_and_comes_back_gets_and_keeps_every_message_but_those_of_a_channel_that_ended(
    peer, name, opened, impatient
):
    queue = peer.address(name, create=True)
    changes, outcomes, unsent, ended = [], [], [], opened(Sender, queue)
    receiver = opened(Receiver, queue, prefetch=2, on_connection=lambda *change: changes.append(change))
    sender = opened(Sender, queue)
    sender.send(b"kept", id="kept")
    held = receiver.next()
    for number in range(50):
        sender.channel.send([bytes(1000)], id=f"{number}", confirmed=outcomes.append)
    wait_until(lambda: len(outcomes) == 50 and peer.has_written, WAIT_S)
    peer.stop(at_once=True)
    try:
        wait_until(lambda: not receiver.channel.is_connected and not sender.channel.is_connected, WAIT_S)
        assert receiver.channel.trouble
        # Nothing is heard of it: the message is delivered again.
        held.ack()
        for number in range(50, 100):
            sender.channel.send([bytes(1000)], id=f"{number}", confirmed=outcomes.append)
        with pytest.raises(BrokerError):
            Sender(queue, timeout_s=5.0)
        # The end of a channel is bounded.
        ended.channel.send([b"a"], confirmed=unsent.append)
        began_s = monotonic()
        ended.channel.close(0.2)
        ended.channel.close(0.2)
        assert monotonic() - began_s < WAIT_S / 2
        assert "was not sent" in str(unsent[0])
    finally:
        peer.start()
    wait_until(lambda: receiver.channel.is_connected and sender.channel.is_connected, WAIT_S)
    came, end_s = set(), monotonic() + 2 * WAIT_S
    wanted = {"kept", *map(str, range(100))}
    while not wanted <= came and monotonic() < end_s:
        delivery = receiver.next()
        came.add(delivery.id)
        delivery.ack()
    assert wanted <= came
    wait_until(lambda: len(outcomes) == 100, WAIT_S)
    assert outcomes == [None] * 100
    assert [is_connected for is_connected, _ in changes] == [True, False, True]
    assert (receiver.channel.reconnects, sender.channel.reconnects) == (1, 1)
    assert (receiver.channel.trouble, sender.channel.waiting) == ("", 0)


def test_closed_channels_leave_no_thread_behind(place):
    def use():
        sender, receiver = Sender(place), Receiver(place)
        join(sender, receiver)
        sender.send(b"a")
        receiver.next().ack()
        sender.channel.close()
        receiver.channel.abandon()

    use()
    wait_until(lambda: not [thread for thread in threading.enumerate() if "epypes" in thread.name], WAIT_S)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_can_not_use_the_channels_of_its_parent_and_does_not_disturb_them(queue, opened):
    sender, receiver = opened(Sender, queue), opened(Receiver, queue)
    sender.send(b"a")
    delivery = receiver.next()
    child = os.fork()
    if child == 0:
        status = 1
        with contextlib.suppress(BaseException):
            delivery.ack()
            sender.channel.close()
            receiver.channel.close()
            try:
                sender.channel.send([b"from the child"])
            except BrokerError:
                own = Sender(queue)
                own.send(b"of the child")
                own.channel.close()
                status = 0
        os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert body(receiver.next()) == b"of the child"
    sender.send(b"b")
    assert body(receiver.next()) == b"b"


# The queue of the broker in this process is not the child's.
test_a_forked_child_can_not_use_the_channels_of_its_parent_and_does_not_disturb_them = pytest.mark.parametrize(
    "peer", at("rabbitmq", "nats", "mosquitto"), indirect=True
)(test_a_forked_child_can_not_use_the_channels_of_its_parent_and_does_not_disturb_them)


def test_a_full_prefetch_window_that_is_not_acknowledged_is_warned_of_once(within, name, opened, monkeypatch, caplog):
    monkeypatch.setattr("epypes.transport.brokers.channel.STALLED_S", 0.05)
    queue = within.address(name, create=True)
    receiver, sender = opened(Receiver, queue, prefetch=2), opened(Sender, queue)
    for _ in range(3):
        sender.send(b"a")
    receiver.take(2)
    wait_until(lambda: "prefetch limit reached: 2 unacknowledged messages" in caplog.text, WAIT_S)


@pytest.fixture(params=at("rabbitmq", "nats", "mosquitto"))
def server(request):
    """Each of the real servers."""
    return request.getfixturevalue(request.param)


def test_refused_credentials_are_an_error_that_names_where_the_password_was_read(server, name, tmp_path):
    address, file = parse_address(server.address(name)), tmp_path / "password"
    file.write_text("wrong")
    for user, option, way_out in (
        ("", f"?password_file={file}", f"read from {file}"),
        (":wrong", "", "?password_file=PATH"),
    ):
        with pytest.raises(BrokerError, match="refuses") as refused:
            Sender(f"{address.scheme}://{address.user}{user}@{address.host}:{address.port}/{name}{option}")
        assert way_out in str(refused.value)
        assert "wrong" not in str(refused.value)


def test_a_broker_that_is_not_there_is_an_error(server, name):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    scheme = parse_address(server.address(name)).scheme
    with pytest.raises(BrokerError, match=f"{port}.*Connection refused"):
        Sender(f"{scheme}://127.0.0.1:{port}/{name}")
    with pytest.raises(BrokerError, match="no host is called 'nobody.invalid'"):
        Sender(f"{scheme}://nobody.invalid/{name}")


@pytest.mark.parametrize(
    "says",
    [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        *(pytest.param(more, marks=pytest.mark.soak) for more in (b"", bytes(1000), b"\xff" * 1000)),
    ],
)
def test_a_port_of_another_program_is_an_error(server, name, says):
    scheme = parse_address(server.address(name)).scheme

    def answer(listening):
        connected, _ = listening.accept()
        with connected, contextlib.suppress(ConnectionError):
            connected.sendall(says)
            while connected.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listening:
        talking = threading.Thread(target=answer, args=(listening,))
        talking.start()
        with pytest.raises(BrokerError, match="did not answer within|does not speak|is no"):
            Sender(f"{scheme}://127.0.0.1:{listening.getsockname()[1]}/{name}", timeout_s=0.5)
        talking.join(WAIT_S)
        assert not talking.is_alive()


def test_a_message_larger_than_the_broker_takes_is_refused_and_the_next_goes_out(server, name, opened):
    address = server.address(name, create=True)
    sender, receiver = opened(Sender, address), opened(Receiver, address)
    with pytest.raises(MessageError) as refused:
        sender.send(bytes(20 * 1024 * 1024))
    assert refused.value.reason == "too large"
    sender.send(b"a")
    assert body(receiver.next()) == b"a"


@pytest.fixture(params=at("rabbitmq", "nats", "mosquitto"))
def encrypted(request, certificates):
    """Each of the real servers, with encryption: a function that gives addresses of it."""
    if request.param == "rabbitmq":
        rabbitmq = request.getfixturevalue("rabbitmq")
        yield lambda name, **options: rabbitmq.address(name, scheme="amqps", **options)
        return
    module = {"nats": nats_servers, "mosquitto": mosquitto_servers}[request.param]
    with module.server(tls=(certificates / "cert.pem", certificates / "key.pem")) as server:
        yield server.address


# paho leaves the socket of a handshake that fails to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_an_encrypted_broker_is_checked_by_its_certificate(encrypted, certificates, name, opened, tmp_path):
    address = encrypted(name, create=True, ca=certificates / "ca.pem")
    receiver = opened(Receiver, address)
    opened(Sender, address).send(b"secret" * 100_000)
    assert body(receiver.next()) == b"secret" * 100_000
    with pytest.raises(BrokerError, match=r"can't be trusted.*\?ca=FILE"):
        Sender(encrypted(name))
    with pytest.raises(BrokerError, match="can't be read from .*nowhere"):
        Sender(encrypted(name, ca=tmp_path / "nowhere"))


def test_an_unencrypted_broker_on_another_machine_is_warned_of_once(server, name, opened, caplog):
    # Resolved to 127.0.0.1, which its name does not show.
    address = server.address(name, create=True).replace("@127.0.0.1", "@127.1")
    assert not parse_address(address).is_on_this_machine
    for _ in range(2):
        opened(Sender, address)
    assert caplog.text.count("not encrypted: every machine on the way can read") == 1


def test_an_address_of_an_unknown_scheme_is_an_error():
    with pytest.raises(AddressError, match="carrier-pigeon"):
        open_channel("carrier-pigeon://127.0.0.1/events")
