"""The code of the page on ROS 2, run with stand-ins of the ROS classes."""

from __future__ import annotations

import queue
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import epypes as ep
from epypes.errors import MessageError
from epypes.wire import Envelope, FailureRecord, decode, encode

PAGE = Path(__file__).parents[2] / "notebooks" / "09_ros2_and_dds.md"


class Image:
    """As sensor_msgs/Image."""

    def __init__(self):
        self.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
        self.height = self.width = self.step = 0
        self.encoding, self.is_bigendian, self.data = "", False, b""


class Node:
    """As much of a node as the channel uses."""

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
    qos, messages, executors = ModuleType("rclpy.qos"), ModuleType("sensor_msgs.msg"), ModuleType("rclpy.executors")
    qos.qos_profile_sensor_data, messages.Image, executors.SingleThreadedExecutor = object(), Image, object
    given = {"rclpy": ModuleType("rclpy"), "rclpy.qos": qos, "rclpy.executors": executors}
    for name, module in {**given, "sensor_msgs": ModuleType("sensor_msgs"), "sensor_msgs.msg": messages}.items():
        monkeypatch.setitem(sys.modules, name, module)
    names = {}
    for code in blocks():
        exec(code, names)
    return SimpleNamespace(**names)


def blocks():
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


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


def test_a_channel_that_is_opened_with_a_handler_delivers_the_images_of_its_topic(page):
    node, deliveries = Node(), []
    channel = page.RosChannel(node, "/camera")
    channel.open(deliveries.append)
    node.callback(message(IMAGES["bgr8"], "bgr8"))
    channel.pause()
    node.callback(message(IMAGES["rgb8"], "rgb8"))
    channel.resume()
    node.callback(message(IMAGES["mono8"], "mono8"))
    envelopes = [decode(delivery.frames) for delivery in deliveries]
    for envelope, delivery, encoding in zip(envelopes, deliveries, ("bgr8", "mono8"), strict=True):
        delivery.ack()
        assert envelope.id == delivery.id
        assert np.array_equal(envelope.parts["image"], IMAGES[encoding])
    channel.close()
    assert node.destroyed == ["/camera"]


def test_a_channel_that_is_opened_without_a_handler_publishes_images(page):
    node, confirmed = Node(), []
    channel = page.RosChannel(node, "/edges", part="edges")
    channel.open(None)
    channel.send(encode(Envelope("answer", {"edges": IMAGES["mono8"]})), confirmed=confirmed.append)
    assert [message.data for message in node.published] == [IMAGES["mono8"].tobytes()]
    assert confirmed == [None]
    channel.close()
    assert len(node.destroyed) == 1


def test_an_image_that_can_not_be_understood_is_skipped_and_the_next_one_is_delivered(page, caplog):
    node, deliveries = Node(), []
    page.RosChannel(node, "/camera").open(deliveries.append)
    unknown, short = message(IMAGES["mono8"], "bayer_rggb8"), message(IMAGES["mono8"], "mono8")
    short.data = short.data[:-1]
    for each in (unknown, short, message(IMAGES["mono8"], "mono8")):
        node.callback(each)
    assert len(deliveries) == 1
    assert "bayer_rggb8" in caplog.text


FAILED = Envelope("answer", failure=FailureRecord("canny", ("image",), "error", "too small"))
OF_FLOAT64 = Envelope("answer", {"image": IMAGES["mono8"].astype(float)})


@pytest.mark.parametrize("answer", [FAILED, OF_FLOAT64, Envelope("answer", {"number": 3})])
def test_an_answer_that_is_no_image_of_ros_is_refused(page, answer):
    channel = page.RosChannel(Node(), "/edges")
    channel.open(None)
    with pytest.raises(MessageError, match="no image for ROS"):
        channel.send(encode(answer))


def test_images_go_to_the_broker_and_answers_come_back(page, caplog):
    node, events, answers = Node(), queue.Queue(), queue.Queue()
    images, edges = page.RosChannel(node, "/camera"), page.RosChannel(node, "/edges")
    edges.open(None)
    with (
        ep.Publisher("memory://ros/edges?create=true") as publisher,
        ep.Subscriber("memory://ros/edges", events, undecoded=True),
    ):
        page.send_images(images, publisher)
        node.callback(message(IMAGES["bgr8"], "bgr8"))
        event = events.get(timeout=60)
    answers.put(SimpleNamespace(frames=encode(FAILED), id="", ack=lambda: None))
    answers.put(event)
    answers.put(None)
    page.publish_answers(answers, edges)
    assert [message.data for message in node.published] == [IMAGES["bgr8"].tobytes()]
    assert event.is_settled
    assert caplog.text.count("skipped an answer") == 1


def test_a_camera_that_is_faster_than_the_broker_fills_no_memory(page):
    node, sent = Node(), []
    events = SimpleNamespace(waiting=0, send=lambda frames, **_: sent.append(frames))
    page.send_images(page.RosChannel(node, "/camera"), events)
    for events.waiting in range(100):
        node.callback(message(IMAGES["mono8"], "mono8"))
    assert len(sent) == 8


def test_the_conversions_and_the_channel_take_some_seventy_lines(page):
    code = blocks()[0]
    lines = [line for line in code.splitlines() if line.strip() and not line.startswith(("import", "from"))]
    assert len(lines) <= 75
