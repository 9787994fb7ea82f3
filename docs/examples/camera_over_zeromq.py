"""Publish what is found in each frame of a camera over ZeroMQ, and subscribe to it in another process.

    python camera_over_zeromq.py [VIDEO, FOLDER or number of a camera]

The first process publishes. It starts a second one, which subscribes; that may run on its own, too, and be several.
"""

import queue
import subprocess
import sys

import cv2
from skimage import data

import epypes as ep
from epypes.wire import Envelope


def pan():
    """Yield twenty frames, as of a camera that is moved over a table."""
    photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    for left in range(0, 200, 10):
        yield photograph[:, left : left + 400]


def edges(image, low=70, high=200):
    return cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), low, high)


def publish(source):
    """Publish the edges of every frame, and return the exit status of the subscriber."""
    pipe = ep.Pipeline("edges", ep.CompGraph.from_functions(edges))
    messages = queue.SimpleQueue()
    with ep.ZMQPublisher("tcp://127.0.0.1:*", messages) as publisher:
        subscriber = subprocess.Popen([sys.executable, __file__, "--subscribe", publisher.address])
        publisher.wait_for_subscriber()
        for frame in ep.camera(source):
            messages.put(Envelope("edges", {"edges": pipe(frame.image)}, attributes={"frame": frame.number}))
        messages.put(Envelope("end"))
        return subscriber.wait()


def subscribe(address):
    """Print a line for each message until the publisher says that it was the last one."""
    messages = queue.SimpleQueue()
    with ep.ZMQSubscriber(address, messages):
        while (message := messages.get(timeout=60)).type != "end":
            found = message.parts["edges"]
            print(f"frame {message.attributes['frame']}: {(found > 0).sum()} edge pixels of {found.size}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--subscribe"]:
        subscribe(sys.argv[2])
    else:
        sys.exit(publish(sys.argv[1] if len(sys.argv) > 1 else pan()))
