"""A node of ROS 2 that publishes or subscribes to sensor_msgs/Image, with the arguments and the output of peer.c.

It runs in an environment of its own, `make .venv/.ros2`, and knows the kinds "image" and "view".
"""

import array
import contextlib
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

WIDTH, HEIGHT = 640, 480
STEP = 3 * WIDTH
PATTERN = bytes((at * 31 + (at >> 8)) & 255 for at in range(HEIGHT * STEP))


def report(what, number):
    sys.stdout.write(f"{what} {number}\n")
    sys.stdout.flush()


def picture(number):
    """Return the image of this number: each byte of the pattern plus the same one."""
    shift = number * 7919 & 255
    image = Image(height=HEIGHT, width=WIDTH, encoding="bgr8", step=STEP)
    image.header.stamp.sec, image.header.stamp.nanosec, image.header.frame_id = number, 500, "camera"
    image.data = array.array("B", PATTERN.translate(bytes((byte + shift) & 255 for byte in range(256))))
    return image


def publish(node, topic, qos, first, count, period_ms):
    publisher = node.create_publisher(Image, topic, qos)
    if qos.durability == DurabilityPolicy.VOLATILE:
        while not publisher.get_subscription_count():
            time.sleep(0.005)
        report("matched", publisher.get_subscription_count())
    for number in range(first, first + count):
        if not rclpy.ok():
            return
        publisher.publish(picture(number))
        report("published", number)
        time.sleep(period_ms / 1000)


def view(image):
    header = image.header
    fields = (header.stamp.sec, header.stamp.nanosec, header.frame_id, image.height, image.width, image.encoding)
    line = " ".join(map(str, ("image", *fields, image.is_bigendian, image.step, len(image.data))))
    sys.stdout.buffer.write(line.encode() + b"\n" + image.data)
    sys.stdout.flush()


def main(kind, topic, reliability, durability, depth, *numbers):
    rclpy.init()
    node = rclpy.create_node("peer")
    reliable = ReliabilityPolicy.RELIABLE if reliability == "reliable" else ReliabilityPolicy.BEST_EFFORT
    kept = DurabilityPolicy.VOLATILE if durability == "volatile" else DurabilityPolicy.TRANSIENT_LOCAL
    qos = QoSProfile(depth=int(depth), reliability=reliable, durability=kept)
    if kind == "view":
        node.create_subscription(Image, topic, view, qos)
        report("waiting", 0)
    else:
        publish(node, topic, qos, *map(int, numbers))
    # Until SIGTERM ends it in order: Fast DDS leaves shared memory behind where a process is killed.
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


# The domain is in the environment, and ROS 2 adds "rt" to topics.
main(sys.argv[1], sys.argv[3].removeprefix("rt"), *sys.argv[4:])
