"""A service takes events from DDS and Zenoh, and publishes answers and failures there."""

from __future__ import annotations

import queue
from uuid import uuid4

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import AddressError, ServiceError
from epypes.service import Client, Service, call
from epypes.wire import Envelope
from tests.service.bundles import written_bundle
from tests.service.processes import running
from tests.service.served import TIMEOUT_S, serving, until
from tests.transport.channels import PEERS, OfPeers

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("middleware", PEERS)
def test_a_service_without_a_broker_answers_fails_drains_and_goes_on(middleware, acting):
    names = {name: OfPeers(middleware).address(f"{name}_{uuid4().hex}") for name in ("sub", "pub", "failures")}
    with serving(acting, **names) as (service, peer):
        assert service.service_state.sub == names["sub"]
        assert peer.ask(number=3).parts["out"] == 6
        answer = peer.ask("fail:no")
        assert answer.failure.function == "act"
        assert peer.failures.get(timeout=TIMEOUT_S).failure.message.startswith("no")
        assert service.drain()
        # Nothing subscribes to the events meanwhile.
        until(lambda: not peer.publisher.wait_for_subscriber(0.0))
        service.resume()
        assert peer.publisher.wait_for_subscriber(TIMEOUT_S)
        assert peer.ask(number=5).parts["out"] == 10
        until(lambda: service.counts()["answered"] == 2)
        counts = service.counts()
        assert (counts["received"], counts["failed"], counts["lost"]) == (3, 1, 0)
        wrong = {name: f"{names[name]}x" for name in ("sub", "pub")}
        text = f"Nothing publishes to {wrong['pub']}. Nothing subscribes to {wrong['sub']}. The addresses must be those"
        with pytest.raises(ServiceError, match=text), Client(acting, **wrong, timeout_s=0.1):
            pass


@pytest.mark.parametrize("middleware", PEERS)
def test_a_service_takes_raw_images_of_ros_2_and_publishes_edges(middleware, edge_bundle, photograph):
    number = uuid4().hex
    before = "rt/" if middleware == "dds" else ""
    place = {
        name: f"{OfPeers(middleware).address(f'{before}{name}_{number}')}?type=sensor_msgs/msg/Image" for name in "ab"
    }
    edges, images = queue.Queue(), ep.Mailbox("block")
    expected = cv2.Canny(cv2.medianBlur(photograph, 5), 70, 200)
    with (
        running(edge_bundle.path, "--sub", place["a"], "--pub", f"{place['b']}&token=edges"),
        ep.Subscriber(f"{place['b']}&token=edges", edges) as viewer,
        ep.Publisher(place["a"], images) as camera,
    ):
        assert viewer.wait_joined(TIMEOUT_S)
        assert camera.wait_for_subscriber(TIMEOUT_S)
        # The median filter takes no image of 64-bit floats, and a message of ROS 2 holds no failure.
        for image in (photograph, photograph.astype(float), photograph):
            images.put(Envelope("frame", {"image": image}, source="camera", acquired_ns=1_700_000_000_000_000_007))
        for _ in range(2):
            answer = edges.get(timeout=TIMEOUT_S)
            assert (answer.source, answer.acquired_ns) == ("camera", 1_700_000_000_000_000_007)
            assert np.array_equal(answer.parts["edges"], expected)
        with pytest.raises(ServiceError, match="do not say which event an answer is to"):
            call(edge_bundle.path, {"image": photograph})
        with pytest.raises(ServiceError, match="do not say which event an answer is to"):
            Client(edge_bundle.path, sub=place["a"], pub=place["b"])


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A bundle that halves a colour image, and makes a mask of a grey one, which no image of ROS 2 can be."""
    source = """
        def small(picture):
            return picture[::2, ::2].copy() if picture.ndim == 3 else picture > 128

        func_dict = {"small": small}
        func_io = {"small": (("picture",), "half")}
    """
    sample = {"picture": np.ones((2, 4, 3), np.uint8)}, {"half": np.ones((1, 2, 3), np.uint8)}
    folder = tmp_path_factory.mktemp("bundles") / "small"
    return written_bundle(folder, source, ["picture"], ["half"], sample=sample)


IMAGE, NUMBER = "type=sensor_msgs/msg/Image", "type=std_msgs/msg/Int64"


def test_a_message_of_ros_2_gets_the_name_of_the_input_and_an_answer_that_is_none_counts_as_failed(small, photograph):
    place = {name: f"dds://7/rt/{name}_{uuid4().hex}?{IMAGE}" for name in "ab"}
    answers, images = queue.Queue(), ep.Mailbox("block")
    with (
        Service(small, place["a"], place["b"]) as service,
        ep.Subscriber(place["b"], answers) as viewer,
        ep.Publisher(place["a"], images) as camera,
    ):
        assert viewer.wait_joined(TIMEOUT_S)
        assert camera.wait_for_subscriber(TIMEOUT_S)
        at_failure = []
        service.listen(lambda kind, data: kind == "failure" and at_failure.append(service.counts()))
        for image in (photograph[..., 0], photograph):
            images.put(Envelope("frame", {"any": image}))
        assert np.array_equal(answers.get(timeout=TIMEOUT_S).parts["image"], photograph[::2, ::2])
        until(lambda: service.counts()["answered"])
        counts = service.counts()
        assert (counts["received"], counts["answered"], counts["failed"]) == (2, 1, 1)
        # It was counted once, when it was known what became of it: no count ever falls.
        assert [(each["answered"], each["failed"]) for each in at_failure] == [(0, 0)]
        assert service.failure_store.flush()
        (record,) = service.failure_records()
        assert "mask.astype('uint8')" in record.message


@pytest.mark.parametrize(
    ("name", "addresses", "text"),
    [
        ("small", {"pub": f"dds://7/rt/a?{IMAGE}&token=haf"}, "no output 'haf'. Did you mean token=half"),
        (
            "small",
            {"pub": f"zenoh://127.0.0.1/a?{NUMBER}"},
            "by its samples: A std_msgs/msg/Int64 must be a whole number",
        ),
        ("small", {"sub": f"dds://7/rt/a?{IMAGE}&token=image"}, "no input 'image'. Write token=picture"),
        ("small", {"sub": f"dds://7/rt/a?{NUMBER}"}, "by its samples: 'picture' is uint8 2 x 4 x 3; .* a whole number"),
        ("acting", {"sub": f"dds://7/rt/a?{NUMBER}"}, "one value, and an event of acting has 'what', 'number'"),
    ],
)
def test_what_can_not_be_a_message_of_ros_2_is_refused_before_the_service_starts(name, addresses, text, request):
    with pytest.raises(AddressError, match=text):
        Service(request.getfixturevalue(name), **addresses)
