"""How addresses are read, and which of them stay on this machine."""

from __future__ import annotations

import traceback

import pytest

from epypes.errors import AddressError
from epypes.transport import check_bind, is_loopback
from epypes.transport.address import is_broker, parse_address


@pytest.mark.parametrize(
    "address",
    [
        "tcp://127.0.0.1:5555",
        "tcp://127.0.0.1:*",
        "tcp://127.255.1.2:1",
        "tcp://localhost:5555",
        "tcp://[::1]:5555",
        "ipc:///tmp/x",
        "inproc://x",
    ],
)
def test_loopback_may_be_bound(address):
    assert is_loopback(address)
    check_bind(address)


@pytest.mark.parametrize(
    "address",
    [
        "tcp://*:5555",
        "tcp://0.0.0.0:5555",
        "tcp://[::]:5555",
        "tcp://192.168.1.1:5555",
        "tcp://lo:5555",
        "tcp://127.0.0.1.example.org:5555",
        "tcp://localhost.example.org:5555",
        "tcp://127.1:5555",
        "tcp://:5555",
        "udp://127.0.0.1:5555",
        "ws://127.0.0.1:5555",
        "ipc://",
    ],
)
def test_anything_else_must_be_asked_for(address):
    assert not is_loopback(address)
    with pytest.raises(AddressError) as caught:
        check_bind(address)
    assert caught.value.address == address
    check_bind(address, insecure=True)


@pytest.mark.parametrize("address", ["", "x", None])
def test_what_is_no_address_is_refused_even_so(address):
    with pytest.raises(AddressError, match="is not an address"):
        check_bind(address, insecure=True)


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
    "amqp://robot:secret@host/",
    "amqp://robot:secret@host/events?kind=stack",
    "amqp://robot:secret@host/events?create=perhaps",
    "amqp://robot:secret@host/events?attempts=0",
    "amqp://robot:secret@host/events?color=red",
]


@pytest.mark.parametrize("address", WRONG)
def test_an_address_that_is_written_wrongly_is_an_error_that_never_has_the_password_in_it(address):
    with pytest.raises(AddressError) as caught:
        parse_address(address)
    assert "secret" not in "".join(traceback.format_exception(caught.value, chain=True)).replace(repr(address), "")
    assert "secret" not in caught.value.address


def test_an_address_shows_no_password():
    address = parse_address("amqp://robot:secret@[::1]:5/a%20b?create=true&kind=log&vhost=cell&group=g&ca=/x.pem")
    assert str(address) == "amqp://robot@[::1]:5/a%20b?kind=log"
    assert "secret" not in repr(address)
    assert (address.password, address.create, address.vhost, address.group, address.ca) == (
        "secret",
        True,
        "cell",
        "g",
        "/x.pem",
    )
    assert (address.is_on_this_machine, address.is_encrypted, address.encrypted_as) == (True, False, "amqps")


@pytest.mark.parametrize(
    ("user", "option", "text"),
    [
        ("", "", "Write USER@ before the host, and the path of a file"),
        ("", "?password_file={file}", "Write USER@ before the host; the password was read from {file}."),
        ("robot:wrong@", "", "Correct the user or the password before the host"),
        ("robot@", "?password_file={file}", "correct that file, or the user before the host"),
    ],
)
def test_the_way_out_of_a_refusal_names_what_was_written(tmp_path, user, option, text):
    file = tmp_path / "password"
    file.write_text("wrong\n")
    address = parse_address(f"nats://{user}127.0.0.1/events{option.format(file=file)}")
    assert text.format(file=file) in address.refused_way_out
    assert address.password in ("", "wrong")


def test_an_address_may_have_a_number_sign_as_topics_and_passwords_have():
    address = parse_address("mqtt://robot:a#b@host/line/#?kind=broadcast")
    assert (address.password, address.name, address.kind) == ("a#b", "line/#", "broadcast")
    assert parse_address(str(address)).name == "line/#"


@pytest.mark.parametrize(
    ("text", "letters"),
    [
        ("amqp://h/events", "events.dead"),
        ("mqtt://h/events", "events/dead"),
        ("nats://h/events?dead=aside", "aside"),
        ("nats://h/events.dead", "events.dead"),
        ("nats://h/events.dead?dead=worse", "worse"),
    ],
)
def test_rejected_messages_go_beside_their_queue_or_where_the_address_says(text, letters):
    assert parse_address(text).dead_letters.name == letters
    assert parse_address(text).dead_letters.kind == "queue"


@pytest.mark.parametrize(
    "text",
    [
        "dds://0/rt/image?type=sensor_msgs/msg/Image&history=5&reliability=best_effort",
        "zenoh://127.0.0.1/line/*/edges?congestion=block",
        "zenoh://robot@router.lab:7448/line?priority=data_high&ca=/etc/lab.pem&password_file={file}",
    ],
)
def test_an_address_of_dds_or_zenoh_is_no_broker_and_its_text_is_read_as_the_same(text, tmp_path):
    file = tmp_path / "password"
    file.write_text("secret\n")
    text = text.format(file=file)
    address = parse_address(text)
    assert (str(address), address.endpoint, parse_address(str(address))) == (text, text, address)
    assert (address.kind, address.is_broker, address.is_zeromq, is_broker(text)) == ("broadcast", False, False, False)
    assert "secret" not in f"{address} {address!r}"


def test_an_address_of_zeromq_is_no_broker_and_is_kept_as_it_is():
    address = parse_address("connect:tcp://127.0.0.1:5555")
    assert (str(address), address.is_broker, address.kind) == ("connect:tcp://127.0.0.1:5555", False, "broadcast")
    assert address.is_on_this_machine
    assert not is_broker("tcp://127.0.0.1:5555")
    assert is_broker("mqtts://h/a")
    assert parse_address(address) is address
