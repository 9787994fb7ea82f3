"""Only peers with a known key can subscribe and publish."""

from __future__ import annotations

import queue

import pytest
import zmq.auth

from epypes.errors import AddressError, KeysError
from epypes.transport import Keys, ZMQPublisher, ZMQSubscriber, make_keys, read_keys
from tests.transport.peers import LOCAL, WAIT_S, wait_until


def test_a_known_key_gets_messages_and_an_unknown_one_none_and_is_counted(tmp_path):
    robot, known, stranger = (make_keys(tmp_path / name) for name in ("robot", "known", "stranger"))
    out, into, nothing = queue.SimpleQueue(), queue.SimpleQueue(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out, keys=robot, allow=[known.public]) as pub,
        ZMQSubscriber(pub.address, into, keys=known, allow=robot) as sub,
        ZMQSubscriber(pub.address, nothing, keys=stranger, allow=robot) as other,
    ):
        assert sub.wait_joined(WAIT_S)
        wait_until(lambda: pub.refused[stranger.public])
        for number in range(50):
            out.put(b"%d" % number)
        assert [int(into.get(timeout=WAIT_S)) for _ in range(50)] == list(range(50))
        assert not other.wait_joined(0.1)
        assert other.received == 0
        assert nothing.empty()
        assert set(pub.refused) == {stranger.public}


def test_a_subscriber_that_binds_hears_only_known_keys(tmp_path):
    server, known, stranger = (make_keys(tmp_path / name) for name in ("server", "known", "stranger"))
    into, out, bad = queue.SimpleQueue(), queue.SimpleQueue(), queue.SimpleQueue()
    with (
        ZMQSubscriber(LOCAL, into, bind=True, keys=server, allow=known) as sub,
        ZMQPublisher(sub.address, bad, bind=False, keys=stranger, allow=server) as enemy,
        ZMQPublisher(sub.address, out, bind=False, keys=known, allow=server),
    ):
        assert sub.wait_joined(WAIT_S)
        wait_until(lambda: sub.refused[stranger.public])
        bad.put(b"bad")
        wait_until(lambda: enemy.sent == 1)
        out.put(b"good")
        assert into.get(timeout=WAIT_S) == b"good"
        assert into.empty()


@pytest.mark.slow
def test_a_peer_without_keys_and_one_that_takes_another_for_the_server_get_nothing(tmp_path):
    robot, known = make_keys(tmp_path / "robot"), make_keys(tmp_path / "known")
    out, nothing = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        ZMQPublisher(LOCAL, out, keys=robot, allow=known) as pub,
        ZMQSubscriber(pub.address, nothing) as plain,
        ZMQSubscriber(pub.address, nothing, keys=known, allow=known.public) as mistaken,
    ):
        assert not plain.wait_joined(0.5)
        assert not mistaken.wait_joined(0.1)
        out.put(b"x")
        wait_until(lambda: pub.sent == 1)
        assert nothing.empty()


def test_guarded_and_open_sockets_live_side_by_side_and_can_be_started_again(tmp_path):
    robot, known = make_keys(tmp_path / "robot"), make_keys(tmp_path / "known")
    with (
        ZMQPublisher(LOCAL, queue.SimpleQueue()) as open_pub,
        ZMQSubscriber(open_pub.address, queue.SimpleQueue()) as sub,
    ):
        assert sub.wait_joined(WAIT_S)
        for _ in range(3):
            with (
                ZMQPublisher(LOCAL, queue.SimpleQueue(), keys=robot, allow=known) as pub,
                ZMQSubscriber(pub.address, queue.SimpleQueue(), keys=known, allow=robot) as guarded,
            ):
                assert guarded.wait_joined(WAIT_S)


def test_a_key_that_is_allowed_at_one_socket_is_a_stranger_at_another(tmp_path):
    robot, one, two = (make_keys(tmp_path / name) for name in ("robot", "one", "two"))
    with (
        ZMQPublisher(LOCAL, queue.SimpleQueue(), keys=robot, allow=one) as first,
        ZMQPublisher(LOCAL, queue.SimpleQueue(), keys=robot, allow=two) as second,
        ZMQSubscriber(second.address, queue.SimpleQueue(), keys=one, allow=robot) as sub,
    ):
        wait_until(lambda: second.refused[one.public])
        assert not sub.wait_joined(0.0)
        assert first.refused == {}


def test_keys_are_files_that_zmq_auth_reads_and_the_secret_one_is_private(tmp_path):
    made = make_keys(tmp_path / "keys" / "camera")
    secret, public = tmp_path / "keys" / "camera.key_secret", tmp_path / "keys" / "camera.key"
    assert secret.stat().st_mode & 0o777 == 0o600
    assert made.secret not in public.read_text()
    assert read_keys(tmp_path / "keys" / "camera") == read_keys(secret) == made
    assert zmq.auth.load_certificate(secret) == (made.public.encode(), made.secret.encode())
    assert zmq.auth.load_certificate(public) == (made.public.encode(), None)


def test_keys_in_another_layout_of_the_format_are_read(tmp_path):
    public, secret = (key.decode() for key in zmq.curve_keypair())
    text = f'#   ZeroMQ CURVE SECRET key\n\nmetadata\ncurve\n    public-key = "{public}"\n    secret-key = "{secret}"\n'
    (tmp_path / "old.key_secret").write_text(text)
    (tmp_path / "old.key_secret").chmod(0o600)
    assert read_keys(tmp_path / "old") == Keys(public, secret)


def test_keys_of_zmq_auth_are_read(tmp_path):
    public, secret = zmq.auth.create_certificates(tmp_path, "old")
    (tmp_path / "old.key_secret").chmod(0o600)
    assert read_keys(secret).public == zmq.auth.load_certificate(public)[0].decode()


def test_keys_that_can_not_be_made_whole_leave_nothing_behind(tmp_path):
    make_keys(tmp_path / "camera")
    (tmp_path / "camera.key_secret").unlink()
    with pytest.raises(KeysError, match=r"camera\.key exists"):
        make_keys(tmp_path / "camera")
    assert [file.name for file in tmp_path.iterdir()] == ["camera.key"], "no secret key that is of another pair"
    with pytest.raises(KeysError, match="names no keys"):
        make_keys("")


def test_a_folder_of_key_files_is_a_list(tmp_path):
    robot = make_keys(tmp_path / "robot")
    known = [make_keys(tmp_path / "known" / name) for name in ("one", "two")]
    with ZMQPublisher(LOCAL, queue.SimpleQueue(), keys=tmp_path / "robot.key_secret", allow=tmp_path / "known") as pub:
        for keys in known:
            with ZMQSubscriber(pub.address, queue.SimpleQueue(), keys=keys, allow=tmp_path / "robot.key") as sub:
                assert sub.wait_joined(WAIT_S)
    assert robot.secret not in repr(robot)


def test_a_secret_key_that_others_can_read_is_refused_and_the_text_says_what_to_do(tmp_path):
    make_keys(tmp_path / "robot")
    (tmp_path / "robot.key_secret").chmod(0o644)
    with pytest.raises(KeysError, match=r"chmod 600 .*robot\.key_secret"):
        read_keys(tmp_path / "robot")


def test_keys_are_never_overwritten(tmp_path):
    made = make_keys(tmp_path / "robot")
    with pytest.raises(KeysError, match="exists"):
        make_keys(tmp_path / "robot")
    assert read_keys(tmp_path / "robot") == made
    assert {file.name for file in tmp_path.iterdir()} == {"robot.key", "robot.key_secret"}


def test_a_bind_that_others_can_reach_needs_keys_or_to_be_called_insecure(tmp_path):
    keys = make_keys(tmp_path / "robot")
    for kind in (ZMQPublisher, ZMQSubscriber):
        with pytest.raises(AddressError, match=r"keys= and allow="):
            kind("tcp://0.0.0.0:5555", queue.SimpleQueue(), bind=True)
        with pytest.raises(KeysError, match="not whose are allowed"):
            kind("tcp://0.0.0.0:5555", queue.SimpleQueue(), bind=True, keys=keys)
        # Not started: nothing in these tests listens to other machines.
        kind("tcp://0.0.0.0:5555", queue.SimpleQueue(), bind=True, insecure=True)
        kind("tcp://0.0.0.0:5555", queue.SimpleQueue(), bind=False)
        kind("tcp://0.0.0.0:5555", queue.SimpleQueue(), bind=True, keys=keys, allow=[])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"allow": "x" * 40}, "but no keys"),
        ({"keys": "nowhere/robot", "allow": "x" * 40}, r"No key can be read from .*robot\.key_secret"),
        ({"keys": Keys("p" * 40, "s" * 40), "allow": "x" * 39}, "No key can be read from"),
        ({"keys": Keys("p" * 40, "s" * 40), "allow": [42]}, "no public key"),
    ],
)
def test_what_is_no_key_is_refused_at_once(options, text):
    with pytest.raises(KeysError, match=text):
        ZMQPublisher(LOCAL, queue.SimpleQueue(), **options)


def test_one_that_connects_must_know_one_server(tmp_path):
    keys = make_keys(tmp_path / "robot")
    with pytest.raises(KeysError, match="2 were given"):
        ZMQSubscriber("tcp://127.0.0.1:5555", queue.SimpleQueue(), keys=keys, allow=["a" * 40, "b" * 40])


@pytest.mark.parametrize("text", ["hello", "public-key\n", 'public-key = "short"'])
def test_a_file_without_keys_is_named(tmp_path, text):
    (tmp_path / "x.key").write_text(text)
    with pytest.raises(KeysError, match=r"x\.key is no key file"):
        ZMQPublisher(LOCAL, queue.SimpleQueue(), keys=make_keys(tmp_path / "me"), allow=tmp_path / "x.key")
