"""The page on ROS 2 has code in it: its conversions are run with stand-ins of the message classes."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from epypes.wire import Envelope, FailureRecord, encode

PAGE = Path(__file__).parents[2] / "notebooks" / "09_ros2_and_dds.md"


class Image:
    """As sensor_msgs/Image."""

    def __init__(self):
        self.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
        self.height = self.width = self.step = 0
        self.encoding, self.is_bigendian, self.data = "", False, b""


class Node:
    """As far as the channel asks a node for anything."""

    def __init__(self):
        self.published, self.callback, self.destroyed = [], None, []

    def create_subscription(self, kind, topic, callback, qos):
        self.callback = callback
        return topic

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)

    def destroy_subscription(self, subscription):
        self.destroyed.append(subscription)

    def destroy_publisher(self, publisher):
        self.destroyed.append(publisher)


@pytest.fixture
def page(monkeypatch):
    qos, messages = ModuleType("rclpy.qos"), ModuleType("sensor_msgs.msg")
    qos.qos_profile_sensor_data, messages.Image = object(), Image
    given = {"rclpy": ModuleType("rclpy"), "rclpy.qos": qos, "sensor_msgs": ModuleType("sensor_msgs")}
    for name, module in {**given, "sensor_msgs.msg": messages}.items():
        monkeypatch.setitem(sys.modules, name, module)
    names = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0], names)
    return SimpleNamespace(**names)


def message(image, encoding, *, padding=0, is_bigendian=False):
    made = Image()
    rows = image.reshape(image.shape[0], -1)
    rows = rows.astype(rows.dtype.newbyteorder(">")) if is_bigendian else rows
    data = np.pad(rows.view(np.uint8), ((0, 0), (0, padding)), constant_values=255)
    made.height, made.width, made.step = image.shape[0], image.shape[1], data.shape[1]
    made.encoding, made.is_bigendian, made.data = encoding, is_bigendian, data.tobytes()
    made.header.frame_id, made.header.stamp.sec, made.header.stamp.nanosec = "camera", 12, 34
    return made


IMAGES = {
    "mono8": np.arange(12, dtype=np.uint8).reshape(3, 4),
    "mono16": np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000,
    "32FC1": np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4),
    "bgr8": np.arange(36, dtype=np.uint8).reshape(3, 4, 3),
    "rgb8": np.arange(36, dtype=np.uint8).reshape(3, 4, 3),
    "bgra8": np.arange(48, dtype=np.uint8).reshape(3, 4, 4),
}


@pytest.mark.parametrize("encoding", IMAGES)
@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_an_image_of_ros_is_an_envelope_with_the_same_pixels(page, encoding, padding, is_bigendian):
    envelope = page.envelope_of(message(IMAGES[encoding], encoding, padding=padding, is_bigendian=is_bigendian))
    assert np.array_equal(envelope.parts["image"], IMAGES[encoding])
    assert envelope.parts["image"].dtype == IMAGES[encoding].dtype
    assert (envelope.source, envelope.acquired_ns) == ("camera", 12_000_000_034)
    assert set(envelope.rgb) == ({"image"} if encoding == "rgb8" else set())


@pytest.mark.parametrize("encoding", IMAGES)
def test_there_and_back_a_message_is_what_it_was(page, encoding):
    given = message(IMAGES[encoding], encoding)
    back = page.message_of(page.envelope_of(given))
    for name in ("height", "width", "step", "encoding", "is_bigendian", "data"):
        assert getattr(back, name) == getattr(given, name)
    assert vars(back.header.stamp) == vars(given.header.stamp)


def test_the_channel_carries_images_both_ways(page):
    node = Node()
    channel = page.RosChannel(node, "/camera", "/edges", part="edges")
    assert channel.receive(0.0) is None
    node.callback(message(IMAGES["bgr8"], "bgr8"))
    received = channel.receive(1.0)
    received.ack()
    assert received.id
    channel.send(encode(Envelope("answer", {"edges": IMAGES["mono8"]})))
    channel.send(encode(Envelope("answer", failure=FailureRecord("canny", ("image",), "error", "too small"))))
    assert [message.data for message in node.published] == [IMAGES["mono8"].tobytes()]
    channel.close()
    assert len(node.destroyed) == 2


def test_a_camera_that_is_faster_than_its_reader_fills_no_memory(page):
    node = Node()
    channel = page.RosChannel(node, "/camera", "/edges")
    for _ in range(100):
        node.callback(message(IMAGES["mono8"], "mono8"))
    assert channel.found.qsize() == 8


def test_an_image_that_can_not_be_understood_is_skipped_and_the_next_one_is_carried(page, caplog):
    node = Node()
    channel = page.RosChannel(node, "/camera", "/edges")
    unknown, short = message(IMAGES["mono8"], "bayer_rggb8"), message(IMAGES["mono8"], "mono8")
    short.data = short.data[:-1]
    for each in (unknown, short, message(IMAGES["mono8"], "mono8")):
        node.callback(each)
    assert [channel.receive(0.0), channel.receive(0.0)] == [None, None]
    assert "bayer_rggb8" in caplog.text
    assert channel.receive(0.0).id


def test_answers_that_are_no_image_of_ros_are_skipped(page, caplog):
    node = Node()
    channel = page.RosChannel(node, "/camera", "/edges")
    channel.send(encode(Envelope("answer", {"number": 3})))
    channel.send(encode(Envelope("answer", {"image": IMAGES["mono8"].astype(float)})))
    channel.send(encode(Envelope("answer", {"image": IMAGES["mono8"]})))
    assert [image.encoding for image in node.published] == ["mono8"]
    assert caplog.text.count("skipped an answer") == 2


def test_the_page_needs_no_more_than_it_says(page):
    """The conversions and the channel are about 40 lines, without imports and blank lines."""
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]
    lines = [line for line in code.splitlines() if line.strip() and not line.startswith(("import", "from"))]
    assert len(lines) <= 48
