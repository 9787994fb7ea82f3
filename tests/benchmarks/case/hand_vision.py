"""What would acquisition and vision be without EPypes: one loop in one thread, with a blocking poller?

Run as a process of its own: ``python -m tests.benchmarks.case.hand_vision THREADS``. It says on standard output where it
listens, ends when its standard input is closed, and speaks the messages of 2019 as the experiment's own nodes do.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter, time
from typing import Any

import cv2
import numpy as np
import zmq
from skimage import data

from epypes.wire import Event, JustBytes

ANY = "tcp://127.0.0.1:*"
SHOWN_ROWS = 20
ORB = {
    "nfeatures": 500,
    "scaleFactor": 1.2,
    "nlevels": 8,
    "edgeThreshold": 31,
    "WTA_K": 2,
    "scoreType": cv2.ORB_HARRIS_SCORE,
    "patchSize": 31,
    "fastThreshold": 20,
}

Found = tuple[Any, np.ndarray]
Features = Callable[[np.ndarray, np.ndarray], tuple[Found, Found, float]]


def _features(image: np.ndarray) -> Found:
    return cv2.ORB_create(**ORB).detectAndCompute(image, None)


def _one_by_one(left: np.ndarray, right: np.ndarray) -> tuple[Found, Found, float]:
    """Return both images' features, and the seconds that the functions took."""
    start = perf_counter()
    found_1 = _features(left)
    middle = perf_counter()
    duration = middle - start
    middle = perf_counter()
    found_2 = _features(right)
    return found_1, found_2, duration + perf_counter() - middle


def _in_two_threads(pool: ThreadPoolExecutor) -> Features:
    def features(left: np.ndarray, right: np.ndarray) -> tuple[Found, Found, float]:
        start = perf_counter()
        other = pool.submit(_features, right)
        found_1 = _features(left)
        found_2 = other.result()
        return found_1, found_2, perf_counter() - start

    return features


def _respond(request: bytes, pair: tuple[np.ndarray, np.ndarray], features: Features) -> bytes:
    t_react = time()
    event = Event.FromString(request)
    t_vreq = event.attributes.entries[0].double_val
    left, right = pair
    acquired = time()

    t_fin_start = time()
    image_1, image_2 = left, right
    t_fin_end = time()
    start = perf_counter()
    (keypoints_1, descriptors_1), (keypoints_2, descriptors_2), nodes = features(image_1, image_2)
    before = perf_counter()
    matches = sorted(
        cv2.BFMatcher(cv2.NORM_HAMMING, True).match(descriptors_1, descriptors_2), key=lambda found: found.distance
    )
    between = perf_counter()
    pairs = [(*keypoints_1[found.queryIdx].pt, *keypoints_2[found.trainIdx].pt) for found in matches]
    paired = np.array(pairs, np.float32).reshape(-1, 4)
    end = perf_counter()
    t_p, nodes = end - start, nodes + (between - before) + (end - between)

    t_fout_start = time()
    message = JustBytes(contents=paired[:SHOWN_ROWS].astype("<f4", copy=False).tobytes(), id=event.id)
    entries = message.attributes.entries
    for key, value in (
        ("t_vreq", t_vreq),
        ("acquisition.t_react", t_react),
        ("acquisition.t_p", acquired - t_react),
        ("acquisition.o_cg", 0.0),
        ("acquisition.t_fin_start", t_react),
        ("acquisition.t_fin_end", t_react),
        ("acquisition.t_fout_start", acquired),
        ("acquisition.t_fout_end", acquired),
        ("acquisition.t_pub", acquired),
        ("vision.t_react", acquired),
        ("vision.t_p", t_p),
        ("vision.o_cg", t_p - nodes),
        ("vision.t_fin_start", t_fin_start),
        ("vision.t_fin_end", t_fin_end),
        ("vision.t_fout_start", t_fout_start),
    ):
        entries.add(type=2, key=key, double_val=value)
    t_fout_end = time()
    entries.add(type=2, key="vision.t_fout_end", double_val=t_fout_end)
    entries.add(type=2, key="vision.t_pub", double_val=time())
    return message.SerializeToString()


def bound(context: zmq.Context[Any]) -> tuple[Any, Any, dict[str, str]]:
    """Return the sockets for requests and responses, and their addresses."""
    requests, responses = context.socket(zmq.SUB), context.socket(zmq.PUB)
    requests.subscribe(b"")
    addresses = {}
    for name, socket in (("requests", requests), ("responses", responses)):
        socket.bind(ANY)
        addresses[name] = socket.getsockopt_string(zmq.LAST_ENDPOINT)
    return requests, responses, addresses


def main(threads: int) -> None:
    left, right, _ = data.stereo_motorcycle()
    pair = (cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right, cv2.COLOR_RGB2GRAY))
    context = zmq.Context()
    requests, responses, addresses = bound(context)
    print(json.dumps(addresses), flush=True)
    poller = zmq.Poller()
    poller.register(requests, zmq.POLLIN)
    poller.register(sys.stdin.fileno(), zmq.POLLIN)
    with ThreadPoolExecutor(1) as pool:
        features = _one_by_one if threads == 1 else _in_two_threads(pool)
        while True:
            ready = dict(poller.poll())
            if sys.stdin.fileno() in ready:
                break
            responses.send(_respond(requests.recv(), pair, features))
    context.destroy(linger=0)


if __name__ == "__main__":
    main(int(sys.argv[1]))
