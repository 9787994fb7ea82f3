"""Does every broker keep what the seam promises? The same sentences for all of them, on real servers."""

from __future__ import annotations

import contextlib
import itertools
import queue as queues
import socket
import threading
import traceback
from time import monotonic
from uuid import uuid4

import pytest

import epypes as ep
from epypes.errors import AddressError, BrokerError, MessageError
from epypes.transport.channels import memory, open_channel, place_of
from epypes.transport.channels.jetstream import places
from tests.brokers.traffic import remove
from tests.transport.peers import wait_until

WAIT_S = 60.0
ABSENT_S = 0.3


class InThisProcess:
    """The double, as the servers are: it can be stopped and started."""

    name, password, has_written = "memory", "secret", True

    def __init__(self):
        self._host, self._away = uuid4().hex, None

    def address(self, name, **options):
        told = "&".join(f"{key}={str(value).lower()}" for key, value in options.items())
        return f"memory://{self._host}/{name}?{told}"

    def stop(self, *, at_once=False):
        self._away = memory.away(self._host)
        self._away.__enter__()

    def start(self):
        self._away.__exit__(None, None, None)


@pytest.fixture(scope="module")
def within():
    return InThisProcess()


def at(*names):
    """Parameters of a fixture: a server takes a second or more to start."""
    return [name if name == "within" else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(params=at("within", "rabbitmq", "nats", "mosquitto"))
def peer(request):
    """Each of those behind the seam that keep messages."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def opened():
    """Opens channels, and closes them."""
    made = []

    def make(address, **options):
        made.append(open_channel(address, timeout_s=WAIT_S, **options))
        return made[-1]

    yield make
    for channel in made:
        channel.close()


@pytest.fixture
def name():
    return f"test-{uuid4().hex[:12]}"


@pytest.fixture
def queue(peer, name):
    return peer.address(name, create=True)


def bodies(received):
    return [bytes(frame) for frame in received.frames]


def next_of(channel, timeout_s=WAIT_S):
    received = channel.receive(timeout_s)
    assert received is not None, "nothing has come"
    return received


def all_of(channel, count):
    return [next_of(channel) for _ in range(count)]


FRAMES = {
    "one": [b"one"],
    "many": [b"%d" % number for number in range(40)],
    "of 0 bytes": [b""],
    "some of 0 bytes": [b"", b"a", b"", b""],
    "1 MB": [bytes(range(256)) * 4096],
    "views of 1 MB": [b"head", memoryview(bytes(1 << 20))],
}


@pytest.mark.parametrize("frames", FRAMES.values(), ids=FRAMES)
def test_what_is_sent_is_received(queue, opened, frames):
    sender, receiver = opened(queue), opened(queue)
    sender.send(frames)
    received = next_of(receiver)
    assert bodies(received) == [bytes(frame) for frame in frames]
    received.ack()


def test_what_is_received_can_not_be_changed(queue, opened):
    opened(queue).send([b"a", b"b"])
    assert all(memoryview(frame).readonly for frame in next_of(opened(queue)).frames)


def test_id_and_headers_come_along(queue, opened):
    opened(queue).send([b"a", b"b"], id="event 1: grün", headers={"epypes-x": "grün, 1"})
    received = next_of(opened(queue))
    assert received.id == "event 1: grün"
    assert received.headers == {"epypes-x": "grün, 1"}


ODD = ["\r\nMore: 1", "a\nb", " a", "a ", "\x1b[31m", "\ud800", "\uffff", "a\0"]


def test_what_would_not_arrive_as_it_is_can_not_be_sent_and_the_next_goes_out(queue, opened):
    sender, receiver = opened(queue), opened(queue)
    assert receiver.receive(0.0) is None
    for text in ODD:
        with pytest.raises(MessageError, match="can't be sent"):
            sender.send([b"a"], id=text)
        with pytest.raises(MessageError, match="can't be sent"):
            sender.send([b"a"], headers={"epypes-x": text})
    for frames in ([], [b""] * 1_027):
        with pytest.raises(MessageError, match="1 to 1,026 frames"):
            sender.send(frames)
    for more in ({"epypes-x": "x" * 120_000}, {"x" * 300 + ":": "x"}):
        with contextlib.suppress(MessageError):
            sender.send([b"a"], headers=more)
            next_of(receiver).ack()
    sender.send([b""] * 1_026, id="good")
    assert len(next_of(receiver).frames) == 1_026


@pytest.mark.slow
def test_whatever_the_reason_says_what_is_rejected_is_put_aside(queue, opened, name):
    opened(queue).send([b"a"])
    receiver = opened(queue)
    next_of(receiver).reject("\x1b[31mblur:\r\n\0 \ud800 grün\uffff")
    letter = next_of(opened(place_of(queue).dead_letters))
    assert letter.headers["epypes-reason"] == "[31mblur: ? grün"
    assert receiver.receive(ABSENT_S) is None


def test_a_message_without_id_and_headers_has_none(queue, opened):
    opened(queue).send([b"a"])
    received = next_of(opened(queue))
    assert received.id == ""
    assert not received.headers


def test_what_was_sent_before_anybody_listened_is_received_in_order(queue, opened):
    sender = opened(queue)
    for number in range(50):
        sender.send([b"%d" % number])
    receiver = opened(queue, prefetch=8)
    came = []
    for _ in range(50):
        received = next_of(receiver)
        came.append(int(bodies(received)[0]))
        received.ack()
    assert came == list(range(50))


@pytest.mark.parametrize("peer", at("rabbitmq", "nats"), indirect=True)
def test_what_was_rejected_while_nobody_could_put_it_aside_is_a_dead_letter_in_the_end(peer, name, opened, monkeypatch):
    """It comes again over the same connection, where it is no event that was sent twice."""
    # Sooner than it would, and later than a busy machine may take to look.
    monkeypatch.setattr("epypes.transport.channels.amqp.channel._AGAIN_S", 2.0)
    monkeypatch.setattr(places, "_SHARED", places._SHARED.evolve(ack_wait=2.0))
    taken = queues.SimpleQueue()
    opened(peer.address(name, create=True)).send([b"spoilt"], id="spoilt")
    with ep.Subscriber(peer.address(name), taken) as subscriber:
        item = taken.get(timeout=WAIT_S)
        remove(peer.address(f"{name}.dead"))
        item.reject("too dark")
        wait_until(lambda: subscriber.duplicates == 1, WAIT_S)
        # Which makes the place for dead letters again.
        opened(peer.address(name, create=True)).send([b"next"], id="next")
        taken.get(timeout=WAIT_S).ack()
        letter = opened(peer.address(f"{name}.dead")).receive(WAIT_S)
        assert (taken.empty(), subscriber.reconnects) == (True, 0)
    assert (letter.id, letter.headers["epypes-reason"]) == ("spoilt", "too dark")


@pytest.mark.slow
def test_an_acknowledgement_is_final(queue, opened):
    opened(queue).send([b"a"])
    receiver = opened(queue)
    received = next_of(receiver)
    received.ack()
    received.reject("too late")
    received.ack()
    receiver.close()
    another = opened(queue)
    assert another.receive(ABSENT_S) is None
    opened(queue).send([b"b"])
    assert bodies(next_of(another)) == [b"b"]


def counted(peer, attempt):
    """Return what a message says of its attempt: with MQTT nobody counts."""
    return 0 if peer.name == "mosquitto" else attempt


def test_what_was_not_acknowledged_comes_again_to_another_and_is_counted(peer, queue, opened):
    opened(queue).send([b"a", b""], id="x", headers={"k": "v"})
    for attempt in (1, 2, 3):
        receiver = opened(queue)
        received = next_of(receiver)
        assert (received.attempt, received.id, bodies(received)) == (counted(peer, attempt), "x", [b"a", b""])
        assert received.headers["k"] == "v"
        receiver.close()


def test_what_was_received_and_never_read_comes_to_another(queue, opened):
    first = opened(queue, prefetch=10)
    assert first.receive(0.0) is None
    sender = opened(queue)
    for number in range(10):
        sender.send([b"%d" % number])
    next_of(first)
    first.close()
    came = [bodies(received) for received in all_of(opened(queue, prefetch=10), 10)]
    assert sorted(came) == [[b"%d" % number] for number in range(10)]


@pytest.mark.slow
def test_what_is_rejected_is_put_aside_with_its_reason(peer, queue, opened, name):
    opened(queue).send([b"a", b"b"], id="x", headers={"k": "v"})
    receiver = opened(queue)
    next_of(receiver).reject("it is no picture: grün")
    dead = next_of(opened(place_of(queue).dead_letters))
    assert (dead.id, bodies(dead)) == ("x", [b"a", b"b"])
    told = {"epypes-reason": "it is no picture: grün", "epypes-from": name, "k": "v"}
    told["epypes-attempts"] = str(counted(peer, 1))
    assert {key: dead.headers[key] for key in told} == told
    dead.ack()
    receiver.close()
    assert opened(queue).receive(ABSENT_S) is None


@pytest.mark.slow
def test_no_more_come_than_asked_for_until_one_is_settled(queue, opened):
    sender, receiver = opened(queue), opened(queue, prefetch=3)
    for number in range(6):
        sender.send([b"%d" % number])
    held = all_of(receiver, 3)
    assert receiver.receive(ABSENT_S) is None
    held[1].ack()
    held.append(next_of(receiver))
    assert receiver.receive(ABSENT_S) is None
    held[0].reject("no")
    next_of(receiver)


@pytest.mark.slow
@pytest.mark.parametrize("peer", at("within", "rabbitmq", "nats"), indirect=True)
def test_more_may_be_in_hand_for_a_while(queue, opened):
    sender, receiver = opened(queue), opened(queue, prefetch=2)
    for number in range(9):
        sender.send([b"%d" % number])
    held = all_of(receiver, 2)
    for prefetch in (3, 5):
        receiver.prefetch = prefetch
        held += all_of(receiver, prefetch - len(held))
        assert receiver.receive(ABSENT_S) is None
    receiver.prefetch = 2
    assert receiver.receive(ABSENT_S) is None
    for received in held:
        received.ack()
    held += all_of(receiver, 2)
    assert receiver.receive(ABSENT_S) is None
    assert sorted(number for received in held for number in bodies(received)) == [b"%d" % n for n in range(7)]


def test_receivers_of_a_queue_share_it(queue, opened):
    sender, receivers = opened(queue), [opened(queue, prefetch=4) for _ in range(3)]
    for receiver in receivers:
        receiver.receive(0.0)
    sent = {f"{number}" for number in range(30)}
    for number in sorted(sent):
        sender.send([b"a"], id=number)
    came, end_s = [], monotonic() + WAIT_S
    share = [0, 0, 0]
    while len(came) < len(sent) and monotonic() < end_s:
        for place, receiver in enumerate(receivers):
            received = receiver.receive(0.02)
            if received is not None:
                came.append(received.id)
                share[place] += 1
                received.ack()
    assert sorted(came) == sorted(sent)
    assert all(share)


@pytest.mark.slow
def test_a_message_is_settled_from_any_thread(queue, opened):
    sender, receiver = opened(queue), opened(queue, prefetch=20)
    for _ in range(20):
        sender.send([b"a"])
    held = all_of(receiver, 20)
    threads = [threading.Thread(target=received.ack) for received in held]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    receiver.close()
    assert opened(queue).receive(ABSENT_S) is None


@pytest.mark.slow
def test_a_broadcast_reaches_all_who_listen_and_is_not_kept(peer, name, opened):
    address = peer.address(name, kind="broadcast", create=True)
    sender, listeners = opened(address), [opened(address) for _ in range(3)]
    for listener in listeners:
        assert listener.receive(0.0) is None
    for number in range(5):
        sender.send([b"%d" % number, b""], id=f"{number}")
    for listener in listeners:
        came = all_of(listener, 5)
        assert [bodies(received) for received in came] == [[b"%d" % number, b""] for number in range(5)]
        for received in came:
            received.ack()
    assert opened(address).receive(ABSENT_S) is None


# MQTT has no log: the newest message, and those that come, which tests/transport/test_mqtt.py tries.
@pytest.mark.parametrize("peer", at("within", "rabbitmq", "nats"), indirect=True)
def test_a_log_is_read_by_all_from_the_first_in_the_same_order(peer, name, opened):
    address = peer.address(name, kind="log", create=True)
    early = opened(address)
    assert early.receive(0.0) is None

    def write(sender, channel):
        for number in range(30):
            channel.send([f"{sender} {number}".encode()])

    writers = [threading.Thread(target=write, args=(sender, opened(address))) for sender in "abc"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(WAIT_S)
    orders = [[bodies(received)[0] for received in all_of(channel, 90)] for channel in (early, opened(address))]
    assert orders[0] == orders[1]
    assert len(set(orders[0])) == 90


def test_a_queue_that_is_not_there_is_an_error_without_the_password(peer, name, opened):
    address = peer.address(name)
    with pytest.raises(BrokerError) as caught:
        opened(address).send([b"a"])
    assert name in str(caught.value)
    assert "create=true" in str(caught.value)
    assert (place_of(address).password or "nothing") not in str(caught.value)


@pytest.fixture(params=at("rabbitmq", "nats", "mosquitto"))
def server(request):
    """Each of the real servers."""
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("by", ["a file", "the address"])
def test_who_is_refused_is_told_where_the_password_comes_from(server, name, by, tmp_path):
    place, file = place_of(server.address(name)), tmp_path / "password"
    file.write_text("wrong")
    who, option = (f"{place.user}@", f"?password_file={file}") if by == "a file" else (f"{place.user}:wrong@", "")
    with pytest.raises(BrokerError) as caught:
        open_channel(f"{place.scheme}://{who}{place.host}:{place.port}/{name}{option}", timeout_s=WAIT_S)
    told = f"read from {file}" if by == "a file" else "?password_file=PATH"
    assert told in str(caught.value)
    assert "wrong" not in str(caught.value)


def test_refused_credentials_are_an_error_that_says_so(server, name):
    place = place_of(server.address(name, create=True))
    address = str(place).replace(f"{place.user}@", f"{place.user}:wrong-one@") + "?create=true"
    with pytest.raises(BrokerError) as caught:
        open_channel(address, timeout_s=WAIT_S)
    assert "refuse" in str(caught.value)
    assert "wrong-one" not in str(caught.value)


def test_a_broker_that_is_not_there_is_an_error(server, name):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    scheme = place_of(server.address(name)).scheme
    began_s = monotonic()
    with pytest.raises(BrokerError, match=str(port)):
        open_channel(f"{scheme}://127.0.0.1:{port}/{name}", timeout_s=2.0)
    assert monotonic() - began_s < WAIT_S


@pytest.mark.parametrize(
    "says",
    [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        *(pytest.param(more, marks=pytest.mark.soak) for more in (b"", bytes(1000), b"\xff" * 1000)),
    ],
)
def test_a_port_of_another_program_is_an_error(server, name, says):
    scheme = place_of(server.address(name)).scheme

    def answer(listening):
        connected, _ = listening.accept()
        with connected, contextlib.suppress(ConnectionError):
            connected.sendall(says)
            while connected.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listening:
        talking = threading.Thread(target=answer, args=(listening,))
        talking.start()
        began_s = monotonic()
        with pytest.raises(BrokerError):
            open_channel(f"{scheme}://127.0.0.1:{listening.getsockname()[1]}/{name}", timeout_s=1.0)
        assert monotonic() - began_s < WAIT_S
        talking.join(WAIT_S)
        assert not talking.is_alive()


def test_what_is_larger_than_the_broker_takes_is_an_error_and_the_next_goes_out(server, queue_of, opened):
    address = queue_of(server)
    sender = opened(address)
    with pytest.raises(MessageError) as caught:
        sender.send([bytes(200 * 1024 * 1024)])
    assert caught.value.reason == "too large"
    another = opened(address)
    another.send([b"a"])
    assert bodies(next_of(opened(address))) == [b"a"]


@pytest.fixture
def queue_of(name):
    return lambda server: server.address(name, create=True)


def ends_with(use):
    """Call something again and again on a thread of its own; give what tells when and how that ended."""
    ended = []

    def run():
        try:
            for number in itertools.count():
                use(number)
        except Exception as error:
            ended.append(error)

    threading.Thread(target=run, daemon=True).start()
    return ended


def test_a_broker_that_goes_away_is_an_error_in_time_and_keeps_what_it_has(peer, name, opened):
    queue, other = peer.address(name, create=True), peer.address(f"{name}-2", create=True)
    receiver, waiting, sender = opened(queue, prefetch=2), opened(other), opened(queue)
    sender.send([b"kept"], id="kept")
    held = next_of(receiver)
    sent = []

    def send(number):
        sender.send([bytes(1000)], id=f"{number}")
        sent.append(number)

    ends = [ends_with(send), ends_with(lambda number: waiting.receive(60.0))]
    wait_until(lambda: len(sent) > 20 and peer.has_written, WAIT_S)
    peer.stop(at_once=True)
    try:
        wait_until(lambda: all(ends), WAIT_S)
        assert all(isinstance(error, BrokerError) for (error,) in ends)
        held.ack()
        held.reject("it is too late")
        began_s = monotonic()
        for channel in (receiver, waiting, sender):
            channel.close()
        assert monotonic() - began_s < WAIT_S
        with pytest.raises(BrokerError):
            open_channel(queue, timeout_s=2.0)
    finally:
        peer.start()
    came, again = set(), opened(queue, prefetch=100)
    # What mosquitto had confirmed in its last moment and not yet written is lost.
    confirmed = sent[:-20] if peer.name == "mosquitto" else sent
    wanted = {"kept", *map(str, confirmed)}
    end_s = monotonic() + 2 * WAIT_S
    while not wanted <= came and monotonic() < end_s:
        received = again.receive(1.0)
        if received is not None:
            came.add(received.id)
            received.ack()
    assert wanted <= came


def test_who_waits_in_receive_is_told_of_a_close(queue, opened):
    receiver = opened(queue)
    ended = ends_with(lambda number: receiver.receive(60.0))
    opened(queue)
    receiver.close()
    receiver.close()
    wait_until(lambda: ended, WAIT_S)
    assert isinstance(ended[0], BrokerError)
    with pytest.raises(BrokerError):
        receiver.send([b"a"])


def test_closed_channels_leave_no_thread_behind(queue):
    def use():
        channel = open_channel(queue, timeout_s=WAIT_S)
        channel.send([b"a"])
        next_of(channel).ack()
        channel.close()

    use()
    before = set(threading.enumerate())
    for _ in range(3):
        use()
    wait_until(lambda: len(set(threading.enumerate()) - before) <= 0, WAIT_S)


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def reached(sender, receiver, frames):
    """Send until it arrives: ZeroMQ drops what nobody listens to yet."""
    assert receiver.receive(0.0) is None
    end_s = monotonic() + WAIT_S
    while monotonic() < end_s:
        sender.send(frames)
        received = receiver.receive(0.05)
        if received is not None:
            return received
    raise AssertionError("nothing has come")


@pytest.mark.parametrize("frames", FRAMES.values(), ids=FRAMES)
def test_zeromq_carries_frames_without_a_broker(opened, port, frames):
    address = f"tcp://127.0.0.1:{port}"
    received = reached(opened(address), opened(address), frames)
    assert bodies(received) == [bytes(frame) for frame in frames]
    received.ack()
    received.reject("nobody asks")
    assert (received.id, received.attempt) == ("", 0)


def test_zeromq_connects_and_binds_the_other_way_round(opened, port):
    sender, receiver = opened(f"connect:tcp://127.0.0.1:{port}"), opened(f"bind:tcp://127.0.0.1:{port}")
    assert bodies(reached(sender, receiver, [b"a", b"b"])) == [b"a", b"b"]


def test_a_port_in_use_is_an_error_of_the_seam(opened, port):
    with socket.create_server(("127.0.0.1", port)), pytest.raises(BrokerError, match="in use"):
        opened(f"tcp://127.0.0.1:{port}").send([b"a"])


def test_zeromq_tells_what_can_not_be_sent(opened, port):
    with pytest.raises(MessageError):
        opened(f"tcp://127.0.0.1:{port}").send([])


def test_a_closed_channel_of_zeromq_is_over(opened, port):
    channel = opened(f"tcp://127.0.0.1:{port}")
    ended = ends_with(lambda number: channel.receive(60.0))
    channel.send([b"a"])
    channel.close()
    wait_until(lambda: ended, WAIT_S)
    assert isinstance(ended[0], BrokerError)
    with pytest.raises(BrokerError):
        channel.send([b"a"])


WRONG = [
    "amqp:/robot:secret@host/events",
    "robot:secret@host/events",
    "amqp://robot:sec/secret@host/events",
    "amqp://robot:12/secret@host/events",
    "amqp://robot:sec?secret@host/events",
    "amqp://robot:[secret@host/events",
    "amqp://robot:secret\u2100@host/events",
    b"amqp://robot:secret@host/events",
    "amqp://robot:secret@host/events?password_file=%00",
    "amqp://robot:secret@host:secret/events",
    "amqp://robot:secret@host/eve%0Ants",
]


@pytest.mark.parametrize("address", WRONG)
def test_an_address_that_is_written_wrongly_is_an_error_that_never_has_the_password_in_it(address):
    with pytest.raises(AddressError) as caught:
        place_of(address)
    assert "secret" not in "".join(traceback.format_exception(caught.value, chain=True)).replace(repr(address), "")
    assert "secret" not in caught.value.address


@pytest.mark.parametrize(
    ("who", "option", "told"),
    [
        ("", "", "Write USER@ before the host, and the path of a file"),
        ("", "?password_file={file}", "Write USER@ before the host; the password was read from {file}."),
        ("robot:wrong@", "", "Mend the user or the password before the host"),
        ("robot@", "?password_file={file}", "mend that file, or the user before the host"),
    ],
)
def test_the_way_out_of_a_refusal_names_what_was_written(tmp_path, who, option, told):
    file = tmp_path / "password"
    file.write_text("wrong")
    place = place_of(f"nats://{who}127.0.0.1/events{option.format(file=file)}")
    assert told.format(file=file) in place.refused_way_out


def test_an_address_may_have_a_number_sign_as_topics_and_passwords_have():
    place = place_of("mqtt://robot:a#b@host/line/#?kind=broadcast")
    assert (place.password, place.name, place.kind) == ("a#b", "line/#", "broadcast")
    assert place_of(str(place)).name == "line/#"


def test_an_address_of_nobody_is_an_error():
    with pytest.raises(AddressError, match="carrier-pigeon"):
        open_channel("carrier-pigeon://127.0.0.1/events")
