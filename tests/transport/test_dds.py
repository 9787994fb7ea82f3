"""DDS: EPypes' own messages against a C program, quality of service, and addresses that can't be."""

from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic

import epypes as ep
from epypes.errors import AddressError, BrokerError, MessageError
from epypes.optional import NO_WHEEL_FROM
from epypes.transport.address import open_channel, parse_address
from epypes.transport.channel import ChannelOptions
from epypes.transport.peers.dds_domain import qos_of
from epypes.transport.peers.dds_messages import MessageCodec, codec_of
from tests.transport.channels import Receiver, Sender, join
from tests.transport.peers import PEER_PUBLISHER, WAIT_S, line_of, process, publish, wait_until

ROOT = Path(__file__).parents[2]
# What the guide has a program on Cyclone DDS take.
GUIDE = (ROOT / "docs/guides/ros2.md").read_text(encoding="utf-8")
LOOPBACK = GUIDE.partition("export CYCLONEDDS_URI='")[2].partition("'")[0]
# Of this worker of pytest alone: peers of other workers would be discovered too.
DOMAIN = 60 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The path of the C program, compiled with the message that is published in proto/."""
    assert shutil.which("idlc"), "Cyclone DDS is not installed on this machine: sh .ci/packages"
    folder, source = tmp_path_factory.mktemp("program"), Path(__file__).parent / "dds_peer" / "peer.c"
    subprocess.run(["idlc", "-o", folder, ROOT / "proto/epypes/v1/message.idl"], check=True)
    command = ["cc", "-std=gnu11", "-Wall", "-Wextra", "-Werror", f"-I{folder}", source, folder / "message.c"]
    subprocess.run([*command, "-lddsc", "-o", folder / "peer"], check=True)
    return folder / "peer"


@pytest.fixture
def started(program, monkeypatch):
    """Starts the C program, with the configuration of Cyclone DDS that this process has then, too."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    running = []

    def start(kind, topic):
        running.append(subprocess.Popen([program, kind, str(DOMAIN), topic]))

    yield start
    for one in running:
        one.kill()
        one.wait()


@pytest.fixture
def topic(name):
    """The name of a topic that any DDS takes."""
    return name.replace("-", "_")


@pytest.fixture
def place(topic):
    return f"dds://{DOMAIN}/{topic}"


@pytest.mark.slow
def test_a_c_program_reads_and_writes_the_message_that_is_published_as_idl(started, topic, place, opened):
    started("echo", topic)
    sender, receiver = opened(Sender, place), opened(Receiver, f"{place}_back")
    join(sender, receiver)
    frames = [b"", b"a", bytes(range(256)) * 4_096, b"end"]
    sender.send(*frames, id="event 1: grün", headers={"epypes-x": "grün", "b": ""})
    came = receiver.next()
    assert (came.id, dict(came.headers)) == ("event 1: grün", {"epypes-x": "grün", "b": ""})
    assert [bytes(frame) for frame in came.frames] == frames


def test_closing_does_not_wait_for_all_that_has_arrived(place, opened, monkeypatch):
    sender, receiver = opened(Sender, place), opened(Receiver, place)
    join(sender, receiver)
    unpack, read, may_go_on = MessageCodec.unpack, [], threading.Event()

    def hold(codec, cdr):
        read.append(cdr)
        assert may_go_on.wait(WAIT_S)
        return unpack(codec, cdr)

    monkeypatch.setattr(MessageCodec, "unpack", hold)
    for _ in range(200):
        sender.send(b"a")
    wait_until(lambda: read)
    receiver.channel.close(0.0)
    may_go_on.set()
    receiver.channel.join(WAIT_S)
    assert len(read) < 200


@pytest.mark.slow
def test_what_is_no_message_of_epypes_is_counted_and_the_next_arrives(started, topic, place):
    started("odd", topic)
    arrived = queue.SimpleQueue()
    with ep.Subscriber(f"{place}?durability=transient_local&history=10", arrived) as subscriber:
        assert arrived.get(timeout=WAIT_S) == bytes([1, 2, 3])
        assert subscriber.rejected == {"bad cdr": 1, "bad frames": 1, "bad topic": 1}


def test_a_subscriber_has_joined_when_the_publisher_knows_it(topic, place):
    address = parse_address(place)
    _, sample_type = codec_of(address, ChannelOptions())
    with ep.Subscriber(place, queue.SimpleQueue()) as subscriber:
        participant, qos = DomainParticipant(DOMAIN), qos_of(address, is_reader=False)
        topics = Topic(participant, topic, sample_type)
        writer = DataWriter(participant, topics, Qos(Policy.Userdata(b"epypes"), base=qos))
        wait_until(writer.get_matched_subscriptions)
        assert not subscriber.wait_joined(0.5), "it matches, and is not in the list of this writer"
        (reader,) = map(writer.get_matched_subscription_data, writer.get_matched_subscriptions())
        writer.set_qos(Qos(Policy.Userdata(b"epypes" + reader.key.bytes)))
        assert subscriber.wait_joined(WAIT_S)


def test_a_publisher_that_misses_its_deadline_makes_the_input_stale_until_it_sends(place):
    changes, quick = queue.SimpleQueue(), f"{place}?deadline=0.2"
    subscriber = ep.Subscriber(quick, queue.SimpleQueue())
    subscriber.on_stale = changes.put
    with subscriber, ep.Publisher(quick) as publisher:
        assert subscriber.wait_joined(WAIT_S)
        publisher.send(b"first")
        assert changes.get(timeout=WAIT_S) is True
        # It has not gone.
        assert subscriber.wait_joined(0.0)
        publisher.send(b"late")
        assert [changes.get(timeout=WAIT_S) for _ in range(2)] == [False, True]


def test_a_stopped_process_makes_the_input_stale_after_its_lease_until_it_publishes_again(place):
    changes, arrived, leased = queue.SimpleQueue(), queue.SimpleQueue(), f"{place}?lease=1"
    subscriber = ep.Subscriber(leased, arrived)
    subscriber.on_stale = changes.put
    with subscriber, process(PEER_PUBLISHER, leased) as other:
        assert line_of(other) == "joined"
        other.send_signal(signal.SIGSTOP)
        assert changes.get(timeout=WAIT_S) is True
        other.send_signal(signal.SIGCONT)
        publish(other, 1)
        assert changes.get(timeout=WAIT_S) is False
        assert arrived.get(timeout=WAIT_S).parts["n"] == 1


@pytest.mark.parametrize(
    ("offered", "asked", "text"),
    [
        ("", "?deadline=0.5", "the publisher offers deadline none, the subscriber asks for 0.5 s"),
        ("?lease=3", "?lease=1", "the publisher offers lease 3 s, the subscriber asks for 1 s"),
        ("", "?durability=transient_local", "offers durability volatile, the subscriber asks for transient_local"),
    ],
)
def test_both_sides_say_which_quality_of_service_does_not_match(place, caplog, offered, asked, text):
    with ep.Subscriber(place + asked, queue.SimpleQueue()), ep.Publisher(place + offered):
        wait_until(lambda: [text in record.getMessage() for record in caplog.records].count(True) == 2)


WRONG = {
    "dds://robot/image": "a domain is a number from 0 to 230",
    "dds://231/image": "a domain is a number from 0 to 230",
    "dds://0:7400/image": "write dds://DOMAIN/TOPIC",
    "dds:///rt/image?history=5": "has no domain: write dds://0/rt/image[?]history=5",
    "dds://0/two words": "is no topic of DDS",
    "dds://0//cam": "one slash between two words: write dds://0/cam",
    "dds://0/image?type=sensor_msgs/msg/Image": "a topic of ROS 2 has rt/ before its name: write dds://0/rt/image",
    "dds://0/rt//image?type=sensor_msgs/msg/Image": "one slash between two words: write dds://0/rt/image",
    "dds://0/größe": "is no topic of DDS",
    "dds://0/image?history=0": "from 1 to 1,000,000, not 0",
    "dds://0/image?deadline=0": "deadline is a number of seconds above 0",
    "dds://0/rt/image?type=sensor_msgs/Imag": "Did you mean 'sensor_msgs/msg/Image'",
    "dds://0/image?interface=": "interface is the name or the address of a network interface, not ''",
    'dds://0/image?interface="/>': "interface is the name or the address of a network interface",
    "dds://0/image?interface=epypes9": "can't be opened on this network interface: .* has the interfaces .*lo",
}


@pytest.mark.parametrize("address", WRONG)
def test_an_address_that_can_not_be_is_an_error_that_says_so(address):
    with pytest.raises((AddressError, BrokerError), match=WRONG[address]):
        open_channel(address).open(None)


def test_a_domain_has_one_interface_in_a_process_and_one_place_that_names_it(place, monkeypatch, opened):
    opened(Sender, place)
    with pytest.raises(AddressError, match="another interface.* the same interface="):
        open_channel(f"{place}?interface=lo").open(None)
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    with pytest.raises(AddressError, match="CYCLONEDDS_URI is set, which names the interfaces"):
        open_channel(f"{place}?interface=lo").open(None)


def test_a_type_of_ros_2_has_no_place_for_what_is_no_envelope(topic, opened):
    image = f"dds://{DOMAIN}/rt/{topic}?type=sensor_msgs/msg/Image"
    sender, receiver = opened(Sender, image), opened(Receiver, image)
    join(sender, receiver)
    with pytest.raises(MessageError, match="An Envelope can be sent as sensor_msgs/msg/Image, a single frame can't"):
        sender.send(b"bytes")


@pytest.mark.parametrize(
    ("first_without", "text"),
    [((3, 99), "needs cyclonedds, which is not installed: .*dds"), ((3, 11), "no wheel for Python 3.*before 3.11")],
)
def test_without_cyclone_dds_the_error_says_how_to_get_it(place, monkeypatch, first_without, text):
    monkeypatch.setitem(NO_WHEEL_FROM, "cyclonedds", first_without)
    monkeypatch.delitem(sys.modules, "epypes.transport.peers.dds")
    for module in [one for one in sys.modules if one.partition(".")[0] == "cyclonedds"]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(AddressError, match=text):
        open_channel(place)
