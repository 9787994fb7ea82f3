"""Does a running service stay up, and count, whatever a peer sends to its socket?"""

from __future__ import annotations

import contextlib
import queue
import random

import cv2
import numpy as np
import pytest
import zmq

import epypes as ep
from epypes.errors import MessageError
from epypes.service import Service
from epypes.wire import EncodedEnvelope, Envelope, Event, Limits, encode, serialized
from tests.service.bundles import written_bundle
from tests.transport.peers import wait_until
from tests.wire.mutants import mutate_bytes, mutate_description, mutate_frames

WAIT_S = 60.0
# Fewer than what a socket keeps, so that none is lost on the way.
BATCH = 400


def wrong_parts(image, rng):
    """Return the frames of a request that is well made and not what the bundle takes."""
    values = [None, 3, "text", b"", [1, 2], {"a": image}, image, image[:0], image.astype(object).tolist(), 1e308]
    names = ["image", "picture", "", "image ", "__class__"]
    return encode(Envelope("epypes.request", {rng.choice(names): rng.choice(values) for _ in range(rng.randint(0, 2))}))


def mutants(image, count):
    """Yield messages that nobody should send: broken requests, requests with wrong parts, messages of 2019."""
    rng = random.Random(7)
    request = [bytes(frame) for frame in encode(Envelope("epypes.request", {"image": image}), inline_below=64)]
    event_2019 = serialized(Event(type="request", id="7"))
    for number in range(count):
        kind = number % 5
        if kind == 0:
            yield mutate_description(request, rng)
        elif kind < 3:
            # ZeroMQ knows no message without frames.
            yield mutate_frames(request, rng) or [b""]
        elif kind == 3:
            yield wrong_parts(image, rng)
        else:
            yield [mutate_bytes(event_2019, rng)]


def is_refused(frames):
    """Whether the header is none; everything of one frame is a message of 2019, and values are the worker's."""
    try:
        return len(frames) > 1 and EncodedEnvelope.read(frames) is None
    except MessageError:
        return True


@contextlib.contextmanager
def serving(bundle, **given):
    """A service, a socket that sends it whatever one likes, and its answers."""
    answers = queue.SimpleQueue()
    with (
        Service(bundle, **given) as service,
        ep.ZMQSubscriber(service.service_state.pub, answers) as subscriber,
        zmq.Context() as context,
        context.socket(zmq.XPUB) as peer,
    ):
        peer.linger, peer.rcvtimeo = 0, int(WAIT_S * 1_000)
        assert subscriber.wait_joined(WAIT_S)
        peer.connect(service.service_state.sub)
        assert peer.recv() == b"\x01"
        yield service, peer, answers


@pytest.mark.slow
@pytest.mark.parametrize("count", [1_000, pytest.param(100_000, marks=pytest.mark.soak)])
def test_each_message_that_nobody_should_send_is_counted_and_the_good_one_after_them_is_answered(
    edge_bundle, caplog, count
):
    caplog.set_level("ERROR", "epypes.service")
    image = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3)
    with serving(edge_bundle.path, mailbox_size=2 * BATCH) as (service, peer, answers):
        worker = service.info()["worker_pid"]

        def has_taken(sent):
            counts = service.counts()
            return counts["received"] + counts["rejected"] == sent and counts["waiting"] <= BATCH

        refused = 0
        for number, frames in enumerate(mutants(image, count), 1):
            peer.send_multipart(frames)
            refused += is_refused(frames)
            if number % BATCH == 0:
                wait_until(lambda sent=number: has_taken(sent), WAIT_S)
        good = Envelope("epypes.request", {"image": image})
        peer.send_multipart(encode(good))
        while (answer := answers.get(timeout=WAIT_S)).correlation_id != good.id:
            pass
        assert np.array_equal(answer.parts["edges"], cv2.Canny(cv2.medianBlur(image, 5), 70, 200))
        wait_until(lambda: not service.counts()["in_flight"], WAIT_S)
        counts = service.counts()
        assert service.state == "READY"
        assert service.info()["worker_pid"] == worker
    assert counts["rejected"] == refused > count / 5
    assert counts["received"] == counts["answered"] + counts["failed"] == count + 1 - refused
    assert counts["failed"] > count / 3


@pytest.mark.slow
def test_a_message_beyond_the_limits_is_refused_before_it_is_kept_and_the_next_is_answered(edge_bundle, photograph):
    with serving(edge_bundle.path) as (service, peer, answers):
        peer.send_multipart([b"/", *[b""] * 5_000])
        peer.send_multipart([b"/", bytes(17 * 1024**2)])
        peer.send_multipart(encode(Envelope("epypes.request", {"image": photograph})))
        assert answers.get(timeout=WAIT_S).failure is None
        assert service.counts()["rejected"] == 2


GROWS = """
    import numpy as np


    def grow(size):
        return np.zeros(size, np.uint8)


    func_dict = {"grow": grow}
    func_io = {"grow": ("size", "grown")}
"""


@pytest.mark.slow
def test_an_answer_beyond_the_limits_is_a_failure_and_the_next_event_is_answered(tmp_path):
    sample = {"size": 3}, {"grown": np.zeros(3, np.uint8)}
    bundle = written_bundle(tmp_path / "grows", GROWS, ["size"], ["grown"], sample=sample)
    requests, answers = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        Service(bundle) as service,
        ep.ZMQSubscriber(service.service_state.pub, answers) as subscriber,
        ep.ZMQPublisher(service.service_state.sub, requests, bind=False) as publisher,
    ):
        assert subscriber.wait_joined(WAIT_S)
        assert publisher.wait_for_subscriber(WAIT_S)
        requests.put(Envelope("epypes.request", {"size": Limits().total_bytes + 1}))
        failure = answers.get(timeout=WAIT_S).failure
        assert (failure.function, failure.exception) == ("f_out", "MessageError")
        requests.put(Envelope("epypes.request", {"size": 5}))
        assert len(answers.get(timeout=WAIT_S).parts["grown"]) == 5
        assert service.state == "READY"
