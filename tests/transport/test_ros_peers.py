"""Images of ROS 2 over DDS, against nodes of ROS 2 and C programs: no code of EPypes is on their side.

The nodes run `ros_peer/node.py` on Fast DDS, ROS 2's default. The C programs are `ros_peer/peer.c` on Cyclone DDS, with
the types that `idlc` makes of the published definitions.
"""

from __future__ import annotations

import os
import queue
import shutil
import subprocess
import threading
from functools import partial
from itertools import islice
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

import epypes as ep
from epypes.wire import Envelope
from epypes.wire.ros import ros_type
from tests.transport.peers import WAIT_S, process, wait_until

pytestmark = pytest.mark.slow

SOURCES = Path(__file__).parent / "ros_peer"
# Of this worker of pytest alone: peers of other workers would be discovered too.
DOMAIN = 40 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
PERIOD_MS, IMAGES = 33, 45
# More than a machine that stands still for a second lets wait.
DEPTH = 100
HEIGHT, WIDTH = 480, 640
LOOPBACK = """
<CycloneDDS><Domain>
<General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
<LeaseDuration>1s</LeaseDuration></Discovery>
</Domain></CycloneDDS>
"""
ENVIRONMENT = {
    **os.environ,
    "CYCLONEDDS_URI": LOOPBACK,
    "ROS_DOMAIN_ID": str(DOMAIN),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
}
_ENDING_S = 10.0
ROS2 = Path(__file__).parents[2] / ".venv" / "ros2" / "bin" / "python"


def picture(number):
    """The image of this number, as peer.c makes it."""
    at = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint32)
    return (number * 7919 + at * 31 + (at >> 8)).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)


def envelope(number):
    return Envelope("", {"image": picture(number)}, source="camera", acquired_ns=number * 10**9 + 500)


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """The node, and the C program compiled: without and with the description of its types for XTypes."""
    assert shutil.which("idlc"), "Cyclone DDS is not installed on this machine: sh .ci/packages"
    assert ROS2.exists(), "ROS 2 is not installed here: make .venv/.ros2"
    made = {"node": [ROS2, SOURCES / "node.py"]}
    for kind, options in (("plain", ["-t"]), ("described", [])):
        folder = tmp_path_factory.mktemp(kind)
        subprocess.run(["idlc", "-x", "final", *options, "-o", folder, SOURCES / "messages.idl"], check=True)
        sources, made[kind] = [SOURCES / "peer.c", folder / "messages.c"], [folder / "peer"]
        checks = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror"]
        subprocess.run(["cc", *checks, f"-I{folder}", *sources, "-lddsc", "-o", *made[kind]], check=True)
    return made


class Peer:
    """A peer that runs: the images that it has received, as number, fields and pixels, and its other lines."""

    def __init__(self, command, logs):
        environment = {**ENVIRONMENT, "ROS_LOG_DIR": str(logs)}
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
        self.images, self.lines = queue.SimpleQueue(), queue.SimpleQueue()
        self.thread = threading.Thread(target=self.read)
        self.thread.start()

    def read(self):
        for line in iter(self.process.stdout.readline, b""):
            what, number, *fields = line.decode().split()
            if what == "image":
                self.images.put((int(number), fields[:-1], self.process.stdout.read(int(fields[-1]))))
            else:
                self.lines.put((what, int(number)))

    def kill(self):
        self.process.kill()
        self.end()

    def end(self):
        self.process.terminate()
        self.thread.join(_ENDING_S)
        # A node of ROS 2 may miss the signal, and would run for ever.
        self.process.kill()
        self.thread.join()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture
def peer(programs, tmp_path):
    started = []

    def start(kind, topic, *numbers, reliability="reliable", durability="volatile", depth=DEPTH, program="plain"):
        qos = [reliability, durability, depth]
        started.append(Peer([*programs[program], *map(str, (kind, DOMAIN, topic, *qos, *numbers))], tmp_path))
        return started[-1]

    yield start
    for one in started:
        one.end()


@pytest.fixture
def topic():
    return f"rt/image_{uuid4().hex[:12]}"


def address(topic, **options):
    given = {"type": "sensor_msgs/msg/Image", "reliability": "reliable", "history": DEPTH, **options}
    return f"dds://{DOMAIN}/{topic}?" + "&".join(f"{name}={value}" for name, value in given.items())


def received(messages, count):
    return [messages.get(timeout=WAIT_S) for _ in range(count)]


def numbers(found):
    return [one.acquired_ns // 10**9 for one in found]


def assert_as_sent(found):
    for one in found:
        number = one.acquired_ns // 10**9
        assert (one.type, one.source, one.acquired_ns % 10**9) == ("sensor_msgs/msg/Image", "camera", 500)
        assert np.array_equal(one.parts["image"], picture(number)), number


def assert_as_published(images):
    for number, fields, pixels in images:
        assert fields == ["500", "camera", "480", "640", "bgr8", "0", "1920"]
        assert pixels == picture(number).tobytes(), number


def test_an_image_has_the_bytes_that_cyclone_dds_writes(programs, topic):
    command = [*programs["plain"], "bytes", str(DOMAIN), topic, "reliable", "volatile", "1"]
    written = subprocess.run(command, env=ENVIRONMENT, stdout=subprocess.PIPE, check=True).stdout
    type_ = ros_type("sensor_msgs/Image")
    assert type_.from_envelope(envelope(7)) == written
    assert_as_sent([type_.to_envelope(written)])


# Prints a message of each type as ROS 2 itself writes it. Fast CDR leaves anything in the bytes that align what follows,
# which these messages have at their end alone.
SERIALIZE = """
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Bool, Float64, Int64, String
image = Image(height=2, width=3, encoding="mono16", step=6, data=bytes(range(12)))
image.header.stamp.sec, image.header.stamp.nanosec, image.header.frame_id = 7, 500, "cameras"
file = CompressedImage(header=image.header, format="png", data=b"\\x89PNG\\r\\n\\x1a\\n")
values = Bool(data=True), Float64(data=0.1), Int64(data=-7), String(data="zw\\u00f6lf")
for message in (image, file, *values):
    print(serialize_message(message).hex())
"""


def test_ros_2_writes_each_type_in_the_same_bytes(programs, tmp_path):
    command, environment = [programs["node"][0], "-c", SERIALIZE], {**ENVIRONMENT, "ROS_LOG_DIR": str(tmp_path)}
    written = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
    pixels = np.arange(12, dtype=np.uint8).view("<u2").reshape(2, 3)
    values = {"sensor_msgs/Image": pixels, "sensor_msgs/CompressedImage": b"\x89PNG\r\n\x1a\n"}
    values |= {"std_msgs/Bool": True, "std_msgs/Float64": 0.1, "std_msgs/Int64": -7, "std_msgs/String": "zwölf"}
    for theirs, (name, value) in zip(written, values.items(), strict=True):
        type_ = ros_type(name)
        ours = type_.from_envelope(Envelope("", {"value": value}, source="cameras", acquired_ns=7 * 10**9 + 500)).hex()
        assert theirs[: len(ours)] == ours
        assert len(theirs) - len(ours) < 2 * 4
        assert np.array_equal(type_.to_envelope(bytes.fromhex(theirs), "value").parts["value"], value)


@pytest.mark.parametrize("program", ["node", "plain"])
def test_every_image_crosses_both_ways_as_it_was_at_30_hz(peer, topic, program):
    messages, images, tick = queue.SimpleQueue(), ep.Mailbox("block"), threading.Event()
    with ep.Subscriber(address(topic), messages) as subscriber, ep.Publisher(address(f"{topic}_back"), images) as back:
        peer("image", topic, 0, 10**6, PERIOD_MS, program=program)
        viewer = peer("view", f"{topic}_back", program=program)
        assert back.wait_for_subscriber(WAIT_S)
        for number in range(IMAGES):
            images.put(envelope(number))
            tick.wait(PERIOD_MS / 1000)
        found, seen = received(messages, IMAGES), received(viewer.images, IMAGES)
    # Fast DDS sends as soon as it knows the subscriber, which may not know the publisher yet.
    first = numbers(found)[0]
    assert numbers(found) == list(range(first, first + IMAGES))
    assert_as_sent(found)
    assert not subscriber.rejected
    assert [number for number, _, _ in seen] == list(range(IMAGES))
    assert_as_published(seen)


@pytest.mark.parametrize("program", ["node", "plain"])
def test_late_joiners_get_the_last_images_of_a_transient_local_publisher(peer, topic, program):
    camera = peer("image", topic, 0, 5, 0, durability="transient_local", depth=2, program=program)
    assert received(camera.lines, 5)[-1] == ("published", 4)
    messages, images = queue.SimpleQueue(), ep.Mailbox("block")
    with ep.Subscriber(address(topic, durability="transient_local", history=2), messages):
        found = received(messages, 2)
    assert numbers(found) == [3, 4]
    assert_as_sent(found)

    with ep.Publisher(address(f"{topic}_back", durability="transient_local", history=2), images):
        for number in range(5):
            images.put(envelope(number))
        viewer = peer("view", f"{topic}_back", durability="transient_local", depth=2, program=program)
        found = received(viewer.images, 2)
    assert [number for number, _, _ in found] == [3, 4]
    assert_as_published(found)


# A service's two ends: it publishes what it receives, and prints a line when it can receive.
RELAY = """
import sys
import epypes as ep
images = ep.Mailbox("block")
with ep.Publisher(sys.argv[2], images), ep.Subscriber(sys.argv[1], images):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_each_of_three_peers_is_killed_and_the_other_two_go_on_with_its_successor(peer, topic):
    def see(viewer, first):
        """Wait for images that a camera has published from number ``first`` on."""
        later = filter(lambda image: image[0] >= first, iter(partial(viewer.images.get, timeout=WAIT_S), None))
        assert_as_published(islice(later, 3))

    def start_relay():
        return process(RELAY, address(topic), address(f"{topic}_back"))

    with start_relay() as relay:
        assert relay.stdout.readline() == "ready\n"
        viewer, camera = peer("view", f"{topic}_back"), peer("image", topic, 0, 10**6, PERIOD_MS)
        see(viewer, 0)
        camera.kill()
        camera = peer("image", topic, 1000, 10**6, PERIOD_MS, program="described")
        see(viewer, 1000)
        viewer.kill()
        viewer = peer("view", f"{topic}_back", program="described")
        see(viewer, 1000)
    # The relay is killed here.
    camera.kill()
    with start_relay():
        peer("image", topic, 2000, 10**6, PERIOD_MS)
        see(viewer, 2000)


def test_the_input_is_stale_from_the_death_of_a_camera_to_its_successor(peer, topic):
    messages, changes = queue.SimpleQueue(), queue.SimpleQueue()
    subscriber = ep.Subscriber(address(topic), messages)
    subscriber.on_stale = changes.put
    with subscriber:
        camera = peer("image", topic, 0, 10**6, PERIOD_MS)
        messages.get(timeout=WAIT_S)
        assert not subscriber.is_stale
        camera.kill()
        assert changes.get(timeout=WAIT_S)
        assert subscriber.is_stale
        peer("image", topic, 0, 10**6, PERIOD_MS)
        assert not changes.get(timeout=WAIT_S)


def test_a_best_effort_camera_has_best_effort_subscribers_alone(peer, topic, caplog):
    strict, tolerant = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        ep.Subscriber(address(topic), strict),
        ep.Subscriber(address(topic, reliability="best_effort"), tolerant),
    ):
        peer("image", topic, 0, 10**6, PERIOD_MS, reliability="best_effort")
        assert_as_sent(received(tolerant, 3))
        wait_until(lambda: "offers reliability best_effort, the subscriber asks for reliable" in caplog.text)
        assert strict.empty()


def test_peers_of_another_type_or_with_bytes_that_are_no_image_hold_no_image_up(peer, topic, caplog, capfd):
    messages = queue.SimpleQueue()
    with ep.Subscriber(address(topic), messages) as subscriber:
        peer("string", topic, 0, 1, 0, durability="transient_local")
        for kind in ("lies", "cut"):
            assert received(peer(kind, topic, 0, 1, 0).lines, 2)[-1] == ("published", 0)
        wait_until(lambda: subscriber.rejected == {"size differs": 1})
        # Cyclone DDS itself refuses bytes that were cut off, and says so.
        refused, said = f"deserialization {topic}/sensor_msgs::msg::dds_::Image_ failed", []
        wait_until(lambda: said.append(capfd.readouterr().err) or refused in "".join(said))
        peer("image", topic, 0, 3, 0)
        found = received(messages, 3)
    assert numbers(found) == [0, 1, 2]
    assert_as_sent(found)
    assert "a peer has this topic with the type std_msgs::msg::dds_::String_" in caplog.text
