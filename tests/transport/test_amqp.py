"""RabbitMQ behind the seam, against a real one."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
from collections.abc import Callable, Iterator
from time import monotonic

import pytest

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels import Channel, Received, open_channel, place_of
from tests.brokers.rabbitmq import MAX_MESSAGE_BYTES, Server, is_installed

pika = pytest.importorskip("pika")
from epypes.transport.channels.amqp.reasons import leader_hint  # noqa: E402 - it needs pika

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_installed(), reason="RabbitMQ is not installed: rabbitmq-server"),
]

WAIT_S = 60.0
_numbers = itertools.count()


@pytest.fixture
def server(rabbitmq: Server) -> Server:
    return rabbitmq


@pytest.fixture
def name() -> str:
    return f"amqp events {next(_numbers)}"


@pytest.fixture
def opened() -> Iterator[Callable[..., Channel]]:
    with contextlib.ExitStack() as stack:

        def open_one(address: str, **options: float) -> Channel:
            channel = open_channel(address, **options)
            stack.callback(channel.close)
            return channel

        yield open_one


@pytest.fixture
def other(server: Server) -> Iterator[pika.adapters.blocking_connection.BlockingChannel]:
    """Another program's way to the broker."""
    who = pika.PlainCredentials(server.user, server.password)
    connection = pika.BlockingConnection(pika.ConnectionParameters("127.0.0.1", server.port, credentials=who))
    yield connection.channel()
    connection.close()


def received(channel: Channel, timeout_s: float = WAIT_S) -> Received:
    message = channel.receive(timeout_s)
    assert message is not None
    return message


def parts(message: Received) -> list[bytes]:
    return [bytes(frame) for frame in message.frames]


def until(is_so: Callable[[], object]) -> None:
    end_s = monotonic() + WAIT_S
    while not is_so():
        assert monotonic() < end_s


def lost(act: Callable[[], object]) -> BrokerError:
    """Do something again and again, until the broker is known to be away."""
    end_s = monotonic() + WAIT_S
    while monotonic() < end_s:
        try:
            act()
        except BrokerError as error:
            return error
    raise AssertionError("it has not been noticed")


def test_what_is_sent_is_received_with_its_frames_its_id_and_its_headers(server, name, opened):
    channel = opened(server.address(name, create=True))
    channel.send([b"first", memoryview(b""), b"\x00" * 1_000_000], id="17", headers={"colour": "grün"})
    message = received(opened(server.address(name)))
    assert parts(message) == [b"first", b"", b"\x00" * 1_000_000]
    assert (message.id, message.attempt, message.headers) == ("17", 1, {"colour": "grün"})


def test_what_is_acknowledged_is_gone_and_what_is_not_comes_again_and_is_counted(server, name, opened):
    channel = opened(server.address(name, create=True), prefetch=2)
    channel.send([b"done"], id="1")
    channel.send([b"left"], id="2")
    received(channel).ack()
    assert received(channel).attempt == 1
    channel.close()
    for attempt in (2, 3):
        channel = opened(server.address(name))
        message = received(channel)
        assert (message.id, message.attempt) == ("2", attempt)
        channel.close()


def test_no_more_are_received_than_were_asked_for_before_one_is_acknowledged(server, name, opened):
    channel = opened(server.address(name, create=True), prefetch=2)
    for number in range(3):
        channel.send([b"%d" % number])
    first, _ = received(channel), received(channel)
    assert channel.receive(0.2) is None
    threading.Thread(target=first.ack).start()
    assert parts(received(channel)) == [b"2"]


def test_what_is_rejected_is_a_dead_letter_that_says_why(server, name, opened):
    channel = opened(server.address(name, create=True))
    channel.send([b"a", b"b"], id="9", headers={"colour": "red"})
    received(channel).reject("it " + "is too bright " * 1_000)
    dead = received(opened(server.address(f"{name}.dead")))
    assert (dead.id, dead.attempt, parts(dead)) == ("9", 1, [b"a", b"b"])
    assert dead.headers["epypes-reason"].startswith("it is too bright")
    assert (dead.headers["epypes-from"], dead.headers["epypes-attempts"], dead.headers["colour"]) == (name, "1", "red")
    assert channel.receive(0.2) is None


@pytest.fixture
def soon(monkeypatch):
    """What could not be put aside comes again soon."""
    monkeypatch.setattr("epypes.transport.channels.amqp.channel._AGAIN_S", 0.2)


@pytest.mark.parametrize("create", [True, False])
def test_what_nobody_can_put_aside_comes_again_and_nothing_else_waits_for_it(
    server, name, opened, other, soon, caplog, create
):
    opened(server.address(name, create=True))
    channel = opened(server.address(name, create=create), prefetch=2)
    channel.send([b"keep me"], id="spoilt")
    message = received(channel)
    other.queue_delete(f"{name}.dead")
    message.reject("no")
    assert (
        f"can't be put among the dead letters, and comes again in 0.2 s: There is no queue '{name}.dead'" in caplog.text
    )
    channel.send([b"other"], id="other")
    came = {each.id: each for each in (received(channel), received(channel))}
    assert (came["spoilt"].attempt, came["other"].attempt) == (2, 1)
    came["other"].ack()
    if not create:
        came["spoilt"].reject("again no")
        assert caplog.text.count("can't be put among the dead letters") == 2
        other.queue_declare(f"{name}.dead", durable=True, arguments={"x-queue-type": "quorum"})
        came["spoilt"] = received(channel)
    came["spoilt"].reject("at last")
    dead = received(opened(server.address(f"{name}.dead")))
    assert (dead.id, dead.headers["epypes-reason"]) == ("spoilt", "at last")
    assert channel.receive(0.5) is None


def test_while_one_waits_to_be_put_aside_there_is_room_for_as_many_as_before(server, name, opened, other):
    channel = opened(server.address(name, create=True), prefetch=1)
    for number in range(3):
        channel.send([b"x"], id=str(number))
    other.queue_delete(f"{name}.dead")
    spoilt = received(channel)
    assert channel.receive(0.2) is None
    spoilt.reject("no")
    second = received(channel, 2.0)
    assert (spoilt.id, second.id) == ("0", "1")
    assert channel.receive(0.2) is None, "one at a time"
    second.ack()
    assert received(channel, 2.0).id == "2"


def test_what_can_not_be_put_aside_while_the_queue_is_full_counts_for_nothing_else(server, name, opened, other, soon):
    told = {"x-queue-type": "quorum", "x-max-length": 1, "x-overflow": "reject-publish"}
    other.queue_declare(f"{name}.dead", durable=True, arguments=told)
    channel = opened(server.address(name, create=True), prefetch=3)
    dead = opened(server.address(f"{name}.dead"))
    # A quorum queue takes some more than its length.
    until(lambda: is_refused(dead))
    for number in range(3):
        channel.send([b"x"], id=str(number))
    spoilt, held = received(channel), received(channel)
    for _ in range(4):
        spoilt.reject("no")
        came = received(channel)
        if came.id == "2":
            came.ack()
            came = received(channel)
        assert came.id == "0"
        spoilt = came
    assert spoilt.attempt == 5
    held.ack()
    until(lambda: other.queue_declare(name, passive=True).method.message_count == 0)
    channel.close()
    again = received(opened(server.address(name)))
    assert (again.id, again.attempt) == ("0", 6), "the others were delivered once and are done"


def is_refused(channel: Channel) -> bool:
    try:
        channel.send([b"x"])
    except BrokerError:
        return True
    return False


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "no queue 'nowhere'.*create=true"),
        ({"kind": "log"}, "no queue 'nowhere'"),
        ({"kind": "broadcast"}, "no exchange 'nowhere'"),
        ({"password": "wrong"}, "refuses user 'robot' or the password"),
        ({"user": "nobody"}, "refuses user 'nobody'"),
        ({"vhost": "elsewhere"}, "no virtual host 'elsewhere'"),
    ],
)
def test_what_the_broker_refuses_is_said_without_the_password(server, options, text):
    with pytest.raises(BrokerError, match=text) as caught:
        open_channel(server.address("nowhere", **options))
    assert server.password not in str(caught.value)
    assert "wrong" not in str(caught.value)


def test_a_queue_without_one_for_its_dead_letters_is_refused(server, name, other):
    other.queue_declare(name)
    with pytest.raises(BrokerError, match=rf"no queue '{name}.dead', for the dead letters of '{name}'.*\?dead="):
        open_channel(server.address(name))


def test_a_queue_of_another_program_is_taken_as_it_is(server, name, opened, other):
    other.queue_declare(name)
    headers = {"number": 7, "raw": b"bytes"}
    other.basic_publish("", name, b"plain", pika.BasicProperties(headers=headers))
    channel = opened(server.address(name, create=True))
    message = received(channel)
    assert (parts(message), message.id, message.attempt) == ([b"plain"], "", 1)
    assert message.headers == {"number": "7", "raw": "bytes"}
    channel.close()
    assert received(opened(server.address(name))).attempt == 2


def test_a_message_whose_header_does_not_fit_is_received_as_an_error_and_can_be_put_aside(server, name, opened, other):
    channel = opened(server.address(name, create=True))
    other.basic_publish("", name, b"12345", pika.BasicProperties(headers={"epypes-frames": "2,2"}))
    message = received(channel)
    assert message.frames == ()
    assert "tells of 4 bytes; 5 came" in message.headers["epypes-error"]
    message.reject(message.headers["epypes-error"])
    assert parts(received(opened(server.address(f"{name}.dead")))) == [b"12345"]


def test_a_dead_letter_whose_headers_leave_no_room_for_the_reason_goes_without_them(server, name, opened, other):
    channel = opened(server.address(name, create=True))
    other.basic_publish("", name, b"12", pika.BasicProperties(headers={"long": "x" * 110_000, "epypes-frames": "1,1"}))
    received(channel).reject("no")
    dead = received(opened(server.address(f"{name}.dead")))
    assert parts(dead) == [b"1", b"2"]
    assert dead.headers == {"epypes-reason": "no", "epypes-from": name, "epypes-attempts": "1"}


def test_a_message_that_is_too_large_is_refused_and_the_next_one_is_sent(server, name, opened):
    channel = opened(server.address(name, create=True))
    for _ in range(2):
        with pytest.raises(MessageError, match="too large") as caught:
            channel.send([bytes(MAX_MESSAGE_BYTES + 1)])
        assert caught.value.reason == "too large"
    with pytest.raises(MessageError, match="longer than 255 bytes"):
        channel.send([b""], id="é" * 128)
    channel.send([bytes(MAX_MESSAGE_BYTES)], id="largest")
    assert received(channel).id == "largest"


def test_a_queue_that_is_deleted_is_noticed_by_who_receives_and_who_sends(server, name, opened, other):
    receiver = opened(server.address(name, create=True))
    sender = opened(server.address(name))
    assert receiver.receive(0.0) is None
    other.queue_delete(name)
    with pytest.raises(BrokerError, match=f"the queue '{name}' was deleted"):
        receiver.receive(WAIT_S)
    with pytest.raises(BrokerError, match=f"There is no queue '{name}'"):
        sender.send([b"to nobody"])


def test_a_broadcast_reaches_all_who_listen_then_and_nobody_later(server, name, opened):
    address = server.address(name, create=True, kind="broadcast")
    sender, *listeners = (opened(address) for _ in range(3))
    sender.send([b"nobody hears"])
    for listener in listeners:
        assert listener.receive(0.0) is None
    for number in range(300):
        sender.send([b"%d" % number], id=str(number))
    for listener in listeners:
        assert [received(listener).id for _ in range(300)] == [str(number) for number in range(300)]
    assert opened(address).receive(0.2) is None


def test_a_log_is_read_by_everybody_from_its_first_message_in_one_order(server, name, opened):
    address = server.address(name, create=True, kind="log")
    senders = [opened(address), opened(address)]
    for number in range(120):
        senders[number % 2].send([b"x"], id=str(number))
    early = opened(address)
    read = [received(early).id for _ in range(120)]
    senders[0].send([b"x"], id="late")
    assert [received(early).id, early.receive(0.1)] == ["late", None]
    late = opened(server.address(name, kind="log"))
    assert [received(late).id for _ in range(121)] == [*read, "late"]
    assert sorted(read, key=int) == [str(number) for number in range(120)]


def test_threads_send_receive_and_acknowledge_on_one_channel_at_once(server, name, opened):
    channel = opened(server.address(name, create=True), prefetch=4)
    ids = [str(number) for number in range(200)]
    got: list[str] = []

    def receive() -> None:
        while len(got) < len(ids):
            message = received(channel)
            got.append(message.id)
            threading.Thread(target=message.ack).start()

    receiver = threading.Thread(target=receive)
    receiver.start()
    for number in ids:
        channel.send([b"x"], id=number)
    receiver.join(WAIT_S)
    assert got == ids
    assert channel.receive(0.1) is None
    channel.close()
    assert opened(server.address(name)).receive(0.2) is None


def test_closing_ends_who_waits_and_is_done_as_often_as_you_like(server, name, opened):
    channel = opened(server.address(name, create=True))
    caught: list[BrokerError] = []
    begun = threading.Event()

    def wait() -> None:
        assert channel.receive(0.0) is None
        begun.set()
        with pytest.raises(BrokerError, match="it was closed") as error:
            channel.receive(60.0)
        caught.append(error.value)

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert begun.wait(WAIT_S)
    begun_s = monotonic()
    channel.close()
    channel.close()
    waiting.join(WAIT_S)
    assert len(caught) == 1
    assert monotonic() - begun_s < WAIT_S / 2
    with pytest.raises(BrokerError, match="it was closed"):
        channel.send([b"too late"])
    until(lambda: "epypes keeps 127.0.0.1" not in [thread.name for thread in threading.enumerate()])


@pytest.mark.parametrize("said", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"AMQP\x00\x01\x00\x00"])
def test_another_program_at_the_port_is_told_from_a_broker(said):
    with socket.create_server(("127.0.0.1", 0)) as program:

        def answer() -> None:
            with contextlib.suppress(OSError):
                peer, _ = program.accept()
                with peer:
                    peer.sendall(said)
                    while peer.recv(100):
                        pass

        threading.Thread(target=answer, daemon=True).start()
        address = f"amqp://127.0.0.1:{program.getsockname()[1]}/events"
        with pytest.raises(BrokerError, match="did not answer within|does not speak AMQP"):
            open_channel(address, timeout_s=1.0)


def test_who_is_not_there_is_said():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BrokerError, match="Connection refused. Is the broker running"):
        open_channel(f"amqp://127.0.0.1:{port}/events")
    with pytest.raises(BrokerError, match=r"no host is called 'nobody.invalid'"):
        open_channel("amqp://nobody.invalid/events")


def test_an_encrypted_broker_is_checked_by_its_certificates(server, name, opened, certificates):
    channel = opened(server.address(name, scheme="amqps", create=True, ca=certificates / "ca.pem"))
    channel.send([b"secret"])
    assert parts(received(channel)) == [b"secret"]
    with pytest.raises(BrokerError, match=r"with encryption.*\?ca=FILE"):
        open_channel(server.address(name, scheme="amqps"))
    with pytest.raises(BrokerError, match="can't be read from /none: No such file"):
        open_channel(server.address(name, scheme="amqps", ca="/none"))


def test_who_could_read_along_is_told_once_of_a_connection_to_elsewhere(server, name, opened, caplog):
    # Resolved to 127.0.0.1, which the name of it does not tell.
    address = server.address(name, create=True).replace("@127.0.0.1", "@127.1")
    assert not place_of(address).is_on_this_machine
    opened(address)
    opened(server.address(name))
    assert [record.name for record in caplog.records if "can read along" in record.message] == ["epypes.transport"]


def test_a_broker_that_takes_no_messages_just_now_says_why(server, name, opened):
    channel = opened(server.address(name, create=True), timeout_s=1.0)
    server.evaluate("vm_memory_monitor:set_vm_memory_high_watermark(0).")
    try:
        error = lost(lambda: channel.send([b"x"]))
    finally:
        server.evaluate("vm_memory_monitor:set_vm_memory_high_watermark(0.8).")
    assert "did not confirm a message within 1 s" in str(error)
    assert "takes no messages just now: low on memory" in str(error)


def test_a_queue_that_says_nothing_is_told_of_and_what_was_rejected_stays_until_it_is_put_aside(
    server, name, opened, soon, caplog
):
    channel = opened(server.address(name, create=True), timeout_s=1.0, prefetch=2)
    channel.send([b"x"], id="spoilt")
    queue = f"whereis('%2F_{name}.dead')"
    server.evaluate(f"sys:suspend({queue}).")
    try:
        received(channel).reject("it is spoilt")
        with pytest.raises(BrokerError, match=f"did not answer within 1 s.*quorum_status '{name}.dead' says"):
            opened(server.address(f"{name}.dead"), timeout_s=1.0).receive(0.0)
    finally:
        server.evaluate(f"sys:resume({queue}).")
    assert ".dead did not confirm a message within 1 s: it may have it or not. If it goes on, rabbitmq" in caplog.text
    again = received(channel)
    assert (again.id, again.attempt) == ("spoilt", 2)
    again.reject("it is still spoilt")
    assert received(opened(server.address(f"{name}.dead"))).id == "spoilt"


def test_where_to_look_is_said_as_a_shell_takes_it():
    assert " quorum_status robots says " in leader_hint(place_of("amqp://h/robots"))
    assert " quorum_status --vhost 'cell 7' 'it'\"'\"'s' says " in leader_hint(place_of("amqp://h/it's?vhost=cell%207"))
    assert leader_hint(place_of("amqp://h/robots?kind=broadcast")) == "", "an exchange has none"


def test_a_channel_that_nobody_uses_is_kept_alive(server, name, opened, monkeypatch):
    monkeypatch.setattr("epypes.transport.channels.amqp.connection._HEARTBEAT_S", 1)
    channel = opened(server.address(name, create=True))
    before = server.log.count("missed heartbeats")
    who = pika.PlainCredentials(server.user, server.password)
    silent = pika.BlockingConnection(pika.ConnectionParameters("127.0.0.1", server.port, credentials=who, heartbeat=1))
    until(lambda: server.log.count("missed heartbeats") > before)
    channel.send([b"still here"])
    assert parts(received(channel)) == [b"still here"]
    assert server.log.count("missed heartbeats") == before + 1
    with contextlib.suppress(pika.exceptions.AMQPError):
        silent.close()


def test_a_broker_that_says_nothing_any_more_is_given_up(server, name, opened, monkeypatch):
    monkeypatch.setattr("epypes.transport.channels.amqp.connection._MOST_SILENT", 3)
    channel = opened(server.address(name, create=True))
    assert channel.receive(0.0) is None
    server.pause()
    try:
        with pytest.raises(BrokerError, match="nothing was heard from the broker for 3 s"):
            channel.receive(WAIT_S)
    finally:
        server.resume()


@pytest.mark.soak
def test_a_broker_that_is_killed_is_noticed_and_what_it_confirmed_is_there_when_it_is_back(server, name, opened):
    receiver = opened(server.address(name, create=True), prefetch=2)
    sender = opened(server.address(name))
    for number in range(20):
        sender.send([b"x"], id=str(number))
    left = [received(receiver), received(receiver)]
    until(lambda: server.has_written)
    server.stop(at_once=True)
    assert "is over" in str(lost(lambda: receiver.receive(0.1)))
    assert "is over" in str(lost(lambda: sender.send([b"nobody is there"])))
    with pytest.raises(BrokerError, match="Connection refused"):
        open_channel(server.address(name))
    left[0].ack()
    left[1].reject("nobody hears it")
    receiver.close()
    server.start()
    again = opened(server.address(name), prefetch=50)
    attempts = {message.id: message.attempt for message in (received(again) for _ in range(20))}
    assert sorted(attempts, key=int) == [str(number) for number in range(20)]
    assert attempts["0"] == attempts["1"] == 2


def interrupting(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, *, after: bool) -> None:
    """Have a method be interrupted once, before or after it has done its work, as by Ctrl-C."""
    real, left = getattr(owner, name), [1]

    def interrupted(*given: object, **more: object) -> object:
        answer = real(*given, **more) if after or not left else None
        if left:
            left.clear()
            raise KeyboardInterrupt
        return answer

    monkeypatch.setattr(owner, name, interrupted)


def test_who_is_interrupted_in_the_midst_of_a_message_hears_at_once_that_the_connection_is_over(
    server, name, opened, monkeypatch
):
    channel = opened(server.address(name, create=True))
    channel.send([b"1"])
    interrupting(monkeypatch, channel._connection.pika._transport, "_produce", after=False)
    with pytest.raises(KeyboardInterrupt):
        channel.send([b"2"])
    assert "a signal came" in channel.trouble
    begun_s = monotonic()
    with pytest.raises(BrokerError, match="a signal came"):
        channel.send([b"3"])
    channel.close()
    assert monotonic() - begun_s < WAIT_S / 2
    again = opened(server.address(name))
    again.send([b"4"])
    assert bytes(again.receive(WAIT_S).frames[0]) == b"1"


def test_who_is_interrupted_as_it_begins_to_receive_begins_anew_with_another_connection(
    server, name, opened, monkeypatch
):
    address = server.address(name, create=True)
    channel = opened(address, prefetch=5)
    for number in (1, 2):
        channel.send([b"%d" % number])
    interrupting(monkeypatch, channel, "_consume", after=True)
    with pytest.raises(KeyboardInterrupt):
        channel.receive(WAIT_S)
    with pytest.raises(BrokerError, match="could not begin to receive: KeyboardInterrupt"):
        channel.receive(WAIT_S)
    channel.close()
    again = opened(address)
    for _ in range(2):
        again.receive(WAIT_S).ack()
    assert again.receive(0.2) is None
