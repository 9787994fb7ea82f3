"""Zenoh beside what every middleware promises: other programs on its keys, routers, keys, credentials."""

from __future__ import annotations

import contextlib
import gc
import queue
import signal
import socket
import struct
import subprocess
import threading
import time

import numpy as np
import psutil
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from epypes.errors import AddressError, BrokerError
from epypes.transport import Publisher, Subscriber
from epypes.wire import Envelope
from tests.brokers.ports import free_ports
from tests.transport.channels import WAIT_S, Receiver, Sender, body, join
from tests.transport.peers import line_of, process, wait_until

# A router, as zenohd is one: mode, listener and settings of Zenoh's own configuration.
ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
settings = {"mode": "router", "scouting/multicast/enabled": False, **json.loads(sys.argv[2])}
for name, value in {**settings, "listen/endpoints": [sys.argv[1]]}.items():
    config.insert_json5(name, json.dumps(value))
session = zenoh.open(config)
print("routing", flush=True)
sys.stdin.read()
"""
# A program without EPypes that puts what it likes on a key.
OTHER = """
import json, sys, zenoh
from zenoh import ext
config = zenoh.Config()
settings = {"scouting/multicast/enabled": False, "listen/endpoints": [], "connect/endpoints": ["tcp/127.0.0.1:7446"]}
# Over a network there is none.
settings["transport/shared_memory/enabled"] = False
for name, value in settings.items():
    config.insert_json5(name, json.dumps(value))
key = sys.argv[1]
with zenoh.open(config) as session:
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    joining = f"@epypes/other/{key}"
    queryable = session.declare_queryable(joining, lambda query: query.reply(joining, b""))
    token = session.liveliness().declare_token(joining)
    sys.stdin.readline()
    publisher.put(b"plain")
    publisher.put(b"")
    publisher.put(b"junk", attachment=b"\\xff" * 9)
    publisher.put(b"map of numbers", attachment=ext.z_serialize({1: 2}))
    publisher.put(b"two frames", attachment=ext.z_serialize({"epypes-frames": "3,999"}))
    publisher.put(b"no sizes", attachment=ext.z_serialize({"epypes-frames": "-1,9"}))
    publisher.put(b"ab", attachment=ext.z_serialize({"epypes-frames": "1,1", "epypes-error": "no", "a": "b"}))
    publisher.put(bytes(1_500_000))
    publisher.put(bytes(9_000_000))
    publisher.delete()
    publisher.put(b"last", attachment=ext.z_serialize({"epypes-id": "7"}))
    print("put", flush=True)
    sys.stdin.read()
"""
OPEN = """
import sys, threading
from epypes.transport import Publisher
with Publisher(sys.argv[1]):
    print("open", flush=True)
    threading.Event().wait()
"""


@contextlib.contextmanager
def router(port, protocol="tcp", settings="{}"):
    with process(ROUTER, f"{protocol}/127.0.0.1:{port}", settings) as running:
        assert line_of(running) == "routing"
        yield running


def test_whatever_another_program_puts_on_a_key_is_counted_and_the_next_message_arrives(name, opened):
    address = f"zenoh://127.0.0.1/{name}/*"
    raw = opened(Receiver, address, max_message_bytes=1_000_000)
    arrived = queue.Queue()
    with Subscriber(address, arrived, max_message_bytes=1_000_000) as subscriber:
        with process(OTHER, f"{name}/key") as other:
            assert raw.channel.publishers.wait(WAIT_S)
            assert subscriber.wait_joined(WAIT_S)
            print("put", file=other.stdin, flush=True)
            assert line_of(other) == "put"
            came = [raw.next()]
            while came[-1].id != "7":
                came.append(raw.next())
            items = [arrived.get(timeout=WAIT_S)]
            while items[-1] != b"last":
                items.append(arrived.get(timeout=WAIT_S))
        read = [body(delivery) for delivery in came if delivery.frames]
        assert read == [b"plain", b"", b"junk", b"map of numbers", b"a|b", b"last"]
        assert [dict(delivery.headers) for delivery in came if body(delivery) == b"a|b"] == [{"a": "b"}]
        reasons = [delivery.headers["epypes-error-reason"] for delivery in came if not delivery.frames]
        assert reasons == ["bad frames", "bad frames", "too large", "no message"]
        # The largest was dropped by Zenoh. Two frames of one byte are no envelope.
        assert items == [b"plain", b"", b"junk", b"map of numbers", b"last"]
        rejected = subscriber.rejected
        assert (rejected["bad frames"], rejected["too large"], rejected["no message"], rejected.total()) == (2, 1, 1, 5)


def test_a_subscriber_keeps_no_thread_of_the_publishers_that_it_has_seen(name, opened):
    receiver = opened(Receiver, f"zenoh://127.0.0.1/{name}")

    def kept_threads():
        for _ in range(4):
            sender = Sender(f"zenoh://127.0.0.1/{name}")
            join(sender, receiver)
            sender.channel.close()
            wait_until(lambda: receiver.channel.publishers.is_stale)
        gc.collect()
        return sum(issubclass(type(each), threading.Thread) for each in gc.get_objects())

    assert kept_threads() + 4 > kept_threads()


IMAGE_KEY = "/sensor_msgs::msg::dds_::Image_/RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"


@pytest.fixture
def session():
    """A session of Zenoh without EPypes."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", '["tcp/127.0.0.1:7446"]')
    config.insert_json5("connect/retry", '{"period_init_ms": 100}')
    with zenoh.open(config) as opened:
        yield opened


@pytest.fixture
def topic(name):
    """The name of a topic of ROS 2."""
    return f"{name.replace('-', '_')}/image"


def test_a_topic_of_ros_2_has_the_keys_tokens_and_attachments_of_rmw_zenoh(topic, session):
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    heard, began_ns = queue.SimpleQueue(), time.time_ns()
    session.declare_subscriber(f"7/{topic}/**", heard.put)
    with Publisher(f"zenoh://127.0.0.1/{topic}?type=sensor_msgs/msg/Image&domain=7") as publisher:
        assert publisher.wait_for_subscriber(WAIT_S)
        for _ in range(2):
            publisher.send(Envelope("x", {"image": image}, source="camera", acquired_ns=5_000_000_007))
        first, second = heard.get(timeout=WAIT_S), heard.get(timeout=WAIT_S)
        assert str(first.key_expr) == f"7/{topic}{IMAGE_KEY}"
        number, time_ns, gid_size = struct.unpack("<qqB", first.attachment.to_bytes()[:17])
        assert (number, gid_size, len(first.attachment)) == (1, 16, 33)
        assert began_ns <= time_ns <= time.time_ns()
        assert struct.unpack("<q", second.attachment.to_bytes()[:8]) == (2,)
        assert second.attachment.to_bytes()[16:] == first.attachment.to_bytes()[16:]
        message = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(first.payload.to_bytes(), "sensor_msgs/msg/Image")
        assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == ("camera", 5, 7)
        assert (message.encoding, message.height, message.width) == ("bgr8", 4, 6)
        assert np.array_equal(message.data.reshape(4, 6, 3), image)
        tokens = sorted(str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/7/**"))
        of_topic = [token for token in tokens if topic.replace("/", "%") in token]
        assert len(of_topic) == 1
        zid = of_topic[0].split("/")[2]
        about = f"%{topic.replace('/', '%')}{IMAGE_KEY}"
        assert of_topic == [f"@ros2_lv/7/{zid}/0/1/MP/%/%/epypes/{about}/::,10:,:,:,,"]
        assert f"@ros2_lv/7/{zid}/0/0/NN/%/%/epypes" in tokens


def test_a_subscriber_reads_a_topic_of_ros_2_of_any_hash_and_counts_what_is_no_message_of_it(topic, session):
    store, arrived = get_typestore(Stores.ROS2_JAZZY), queue.Queue()
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](5, 7), "camera")
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8)
    message = types["sensor_msgs/msg/Image"](header, 4, 6, "rgb8", 0, 18, pixels)
    cdr = bytes(store.serialize_cdr(message, "sensor_msgs/msg/Image"))
    about = f"%{topic.replace('/', '%')}{IMAGE_KEY}"
    token = f"@ros2_lv/0/{session.zid()}/0/9/MP/%/%/talker/{about}/::,10:,:,:,,"
    address = f"zenoh://127.0.0.1/{topic}?type=sensor_msgs/msg/Image&token=picture"
    with session.liveliness().declare_token(token), Subscriber(address, arrived) as subscriber:
        assert subscriber.wait_joined(WAIT_S)
        for key in (IMAGE_KEY, "/sensor_msgs::msg::dds_::Image_/TypeHashNotSupported"):
            publisher = session.declare_publisher(f"0/{topic}{key}")
            wait_until(lambda publisher=publisher: publisher.matching_status.matching)
            for payload in (b"", cdr[:40], cdr[:-1], cdr):
                publisher.put(payload, attachment=struct.pack("<qqB", 1, 5, 16) + bytes(16))
            envelope = arrived.get(timeout=WAIT_S)
            assert np.array_equal(envelope.parts["picture"], pixels.reshape(4, 6, 3))
            assert (envelope.source, envelope.acquired_ns, envelope.rgb) == ("camera", 5_000_000_007, {"picture"})
        assert subscriber.rejected["bad cdr"] == 6
        assert arrived.empty()


def test_peers_meet_when_the_one_has_gone_that_they_would_have_met_through(name, opened):
    address = f"zenoh://127.0.0.1/{name}"
    with process(OPEN, address) as meeting:
        assert line_of(meeting) == "open"
        # It still has the port, and says nothing about other peers.
        meeting.send_signal(signal.SIGSTOP)
        sender, first = opened(Sender, address), opened(Receiver, address)
        meeting.kill()
        meeting.wait()
        join(sender, first)
        second = opened(Receiver, address)
        join(sender, second)
        sender.send(b"a")
        assert (body(first.next()), body(second.next())) == (b"a", b"a")


def test_a_router_that_is_killed_and_started_again_is_told_and_peers_go_on_without_it(name):
    port, changes, arrived = free_ports("127.0.0.1", 1)[0], queue.SimpleQueue(), queue.Queue()
    address = f"zenoh://127.0.0.1:{port}/{name}"
    subscriber, publisher = Subscriber(address, arrived), Publisher(address)
    subscriber.on_connection = lambda *change: changes.put(change)
    with router(port) as running, subscriber, publisher:
        assert subscriber.wait_joined(WAIT_S)
        assert publisher.wait_for_subscriber(WAIT_S)
        assert changes.get(timeout=WAIT_S) == (True, "")
        running.kill()
        assert changes.get(timeout=WAIT_S) == (False, "the connection to the router was lost")
        assert subscriber.trouble
        publisher.send(Envelope("x", {"n": 1}, source="s"))
        assert arrived.get(timeout=WAIT_S).parts["n"] == 1
        with router(port):
            assert changes.get(timeout=WAIT_S) == (True, "")
            assert (subscriber.reconnects, subscriber.trouble) == (1, "")
            publisher.send(Envelope("x", {"n": 2}, source="s"))
            assert arrived.get(timeout=WAIT_S).parts["n"] == 2


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """A folder with an authority, ca.pem, and a certificate of it for 127.0.0.1: Zenoh takes none of its own."""
    folder = tmp_path_factory.mktemp("certificates")
    make = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2"
    leaf = "-CA ca.pem -CAkey ca_key.pem -addext subjectAltName=IP:127.0.0.1 -addext basicConstraints=CA:FALSE"
    for command in (
        f"{make} -subj /CN=authority -keyout ca_key.pem -out ca.pem",
        f"{make} -subj /CN=127.0.0.1 {leaf} -keyout key.pem -out cert.pem",
    ):
        subprocess.run(command.split(), cwd=folder, check=True, capture_output=True, timeout=WAIT_S)
    return folder


def test_a_router_with_users_and_certificates_passes_messages_on(name, opened, certified, tmp_path):
    port, password = free_ports("127.0.0.1", 1)[0], tmp_path / "password"
    (tmp_path / "users").write_text("robot:secret\n")
    password.write_text("secret\n")
    tls = f'"listen_private_key": "{certified / "key.pem"}", "listen_certificate": "{certified / "cert.pem"}"'
    users = f'{{"dictionary_file": "{tmp_path / "users"}"}}'
    settings = f'{{"transport/link/tls": {{{tls}}}, "transport/auth/usrpwd": {users}}}'
    at, trusted = f"127.0.0.1:{port}/{name}", f"ca={certified / 'ca.pem'}"
    with router(port, "tls", settings):
        # A router of Zenoh's own configuration drops what it can't pass on within 1 ms.
        address = f"zenoh://robot@{at}?{trusted}&password_file={password}&congestion=block"
        sender, receiver = opened(Sender, address), opened(Receiver, address)
        join(sender, receiver)
        sender.send(b"secret" * 100_000)
        assert body(receiver.next()) == b"secret" * 100_000
        for wrong, text in (
            (f"zenoh://robot:wrong@{at}?{trusted}", "Correct the user or the password"),
            (f"zenoh://{at}?{trusted}", "can't be reached"),
            (f"zenoh://robot:secret@{at}", "can't be reached"),
        ):
            with pytest.raises(BrokerError, match=text) as refused:
                Sender(wrong, timeout_s=5.0)
            assert "wrong" not in str(refused.value)
            assert "secret" not in str(refused.value)


def test_what_is_no_router_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]

        def answer():
            connected, _ = listening.accept()
            with connected, contextlib.suppress(ConnectionError):
                connected.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                while connected.recv(4096):
                    pass

        talking = threading.Thread(target=answer)
        talking.start()
        with pytest.raises(BrokerError, match="Is a Zenoh router running there"):
            Sender(f"zenoh://127.0.0.1:{port}/a", timeout_s=1.0)
        talking.join(WAIT_S)
        assert not talking.is_alive()
    with pytest.raises(BrokerError, match=f"{port}.*Connection refused"):
        Sender(f"zenoh://127.0.0.1:{port}/a")
    with pytest.raises(BrokerError, match=r"nobody\.invalid"):
        Sender("zenoh://nobody.invalid/a")


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("zenoh://127.0.0.1/a//b", "can't be a key of Zenoh: .*line/camera"),
        ("zenoh://127.0.0.1/a/*", "Write one key"),
        ("zenoh://127.0.0.1/a?priority=7", "priority is one of real_time.*not '7'"),
        ("zenoh://127.0.0.1/a?domain=x", "domain is a whole number"),
        ("zenoh://127.0.0.1/a?type=a b", "type is the name of a type"),
        ("zenoh://127.0.0.1/a?type=sensor_msgs/msg/Imag", "Did you mean 'sensor_msgs/msg/Image'"),
        ("zenoh://127.0.0.1/rt/a?type=std_msgs/Bool", "no rt/ .* write zenoh://127.0.0.1/a[?]type=std_msgs/Bool"),
        ("zenoh://127.0.0.1/a*?type=sensor_msgs/msg/Image", "no name of a ROS 2 topic"),
        ("zenoh://127.0.0.1/a?create=true", "no option create. There are: ca, congestion"),
    ],
)
def test_an_address_that_is_written_wrongly_is_an_error(address, text):
    with pytest.raises(AddressError, match=text):
        Sender(address)


def test_nothing_listens_beyond_this_machine(name):
    with process(OPEN, f"zenoh://127.0.0.1/{name}") as other:
        assert line_of(other) == "open"
        bound = [connection.laddr.ip for connection in psutil.Process(other.pid).net_connections() if connection.laddr]
        assert set(bound) == {"127.0.0.1"}
