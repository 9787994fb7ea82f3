from __future__ import annotations

import logging
import os
import queue
import re
import shutil
import signal
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
import zmq

import epypes as ep
from epypes.bundle.seal import seal
from epypes.errors import AddressError, BundleError, RemoteFailure, ReplayDiffers, ServiceError, StillRunning
from epypes.service import Client, Service, call
from epypes.service.state import StateLock, read_state, state_file
from epypes.wire import Envelope, encode
from tests.colours import red_image, red_runner
from tests.service.processes import run_cli, running

pytestmark = pytest.mark.slow  # each proves and serves a bundle

TIMEOUT_S = 20.0
ANY = "tcp://127.0.0.1:*"


@pytest.fixture
def local(edge_bundle):
    """A service in this process, with its state published as serve does."""
    with StateLock(edge_bundle.path) as lock:
        service = Service(edge_bundle.path, ANY, ANY)
        lock.publish(service.start())
        yield service
        service.stop()


def test_a_service_in_another_process_answers_with_what_the_notebook_computed(edge_bundle, photograph):
    expected = cv2.Canny(cv2.medianBlur(photograph, 5), 70, 200)
    with running(edge_bundle.path) as process:
        assert process.ready.startswith("READY")
        with Client(edge_bundle.path, timeout_s=TIMEOUT_S) as client:
            answers = [client.call({"image": photograph}) for _ in range(3)]
        for answer in answers:
            assert np.array_equal(answer.tokens["edges"], expected)
            assert set(answer.timings_ns) == {"smooth", "canny"}
            assert 0 < answer.overhead_ns < answer.total_ns < answer.round_trip_ns
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0, err
        assert "STOPPED received 3, answered 3, failed 0, dropped 0, rejected 0" in out
    assert read_state(edge_bundle.path) is None


def test_a_function_that_fails_is_told_to_the_caller_and_the_service_goes_on(local, edge_bundle, photograph):
    with pytest.raises(RemoteFailure, match="Function 'smooth' failed in the service: error") as error:
        call(edge_bundle.path, {"image": np.zeros((0, 0), np.uint8)}, timeout_s=TIMEOUT_S)
    assert error.value.function == "smooth"
    assert call(edge_bundle.path, {"image": photograph}, timeout_s=TIMEOUT_S).tokens["edges"].any()
    assert local.counts()["failed"] == 1


@pytest.mark.parametrize("parts", [{}, {"picture": np.zeros((9, 9), np.uint8)}, {"image": 1, "more": 2}])
def test_an_event_with_other_parts_is_a_failure_that_names_them(local, edge_bundle, parts):
    with pytest.raises(RemoteFailure, match="The event must have the parts 'image'; it has"):
        call(edge_bundle.path, parts, timeout_s=TIMEOUT_S)


def test_garbage_on_the_input_socket_is_counted_and_the_service_goes_on(local, edge_bundle, photograph):
    header = bytes(encode(Envelope(type="x", parts={"image": photograph}))[1])
    context = zmq.Context()
    socket_ = context.socket(zmq.XPUB)
    try:
        socket_.connect(local.subscriber.address)
        assert socket_.poll(TIMEOUT_S * 1000), "the service has subscribed"
        garbage = [
            [b""], [b"garbage"], [os.urandom(5000)], [b"\x00" * 100], [b"a/", b"garbage"], [b"/", b""],
            [b"/", header], [b"/", header, b"too short"], [b"/", os.urandom(300), os.urandom(300)], [b""] * 50,
            [b"\xff\xff"], [b"\x80\x04\x95canary"],
        ]  # fmt: skip
        for frames in garbage:
            socket_.send_multipart(frames)
        # The same socket: what comes behind the garbage arrives behind it.
        answers: queue.SimpleQueue = queue.SimpleQueue()
        with ep.ZMQSubscriber(local.publisher.address, answers) as subscriber:
            assert subscriber.wait_joined(TIMEOUT_S)
            request = Envelope(type="x", parts={"image": photograph})
            socket_.send_multipart(encode(request))
            while True:
                answer = answers.get(timeout=TIMEOUT_S)
                if answer.correlation_id == request.id:
                    break
        assert answer.failure is None
        assert answer.parts["edges"].any()
    finally:
        socket_.close(0)
        context.term()
    counts = local.counts()
    assert counts["rejected"] + counts["failed"] + counts["dropped"] >= len(garbage) - 2
    assert counts["rejected"] >= 4
    assert call(edge_bundle.path, {"image": photograph}, timeout_s=TIMEOUT_S).tokens["edges"].any()


def test_a_port_in_use_is_named_and_nothing_is_left_behind(edge_bundle):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run_cli("serve", edge_bundle.path, "--sub", f"tcp://127.0.0.1:{port}")
    assert done.returncode == 1
    assert str(port) in done.stderr
    assert "Traceback" not in done.stderr
    assert read_state(edge_bundle.path) is None
    with running(edge_bundle.path, "--sub", f"tcp://127.0.0.1:{port}") as process:
        assert f"tcp://127.0.0.1:{port}" in process.ready


def test_a_bundle_is_served_once(edge_bundle):
    with running(edge_bundle.path) as process:
        done = run_cli("serve", edge_bundle.path)
        assert done.returncode == 1
        assert f"is being served already, by process {process.pid} at tcp://127.0.0.1:" in done.stderr


@pytest.mark.slow
def test_a_killed_service_is_not_taken_for_a_running_one(edge_bundle, photograph):
    with running(edge_bundle.path) as process:
        process.kill()
        process.wait(TIMEOUT_S)
        assert state_file(edge_bundle.path).read_text()
        with pytest.raises(ServiceError, match="No service runs for .* Start one: epypes serve"):
            call(edge_bundle.path, {"image": photograph})
    with running(edge_bundle.path):
        assert call(edge_bundle.path, {"image": photograph}, timeout_s=TIMEOUT_S).tokens["edges"].any()


@pytest.mark.slow
def test_a_service_that_is_killed_while_it_works_is_told_to_the_caller(edge_bundle, photograph):
    with running(edge_bundle.path) as process, Client(edge_bundle.path, timeout_s=TIMEOUT_S) as client:
        client.call({"image": photograph})
        process.kill()
        process.wait(TIMEOUT_S)
        with pytest.raises(ServiceError, match="ended before it answered"):
            client.call({"image": photograph})


@pytest.mark.slow
def test_a_stopped_service_makes_the_call_time_out(edge_bundle, photograph):
    with running(edge_bundle.path) as process, Client(edge_bundle.path, timeout_s=1.0) as client:
        client.call({"image": photograph})
        process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(ServiceError, match="did not answer within 1 s"):
                client.call({"image": photograph})
        finally:
            process.send_signal(signal.SIGCONT)


def test_a_changed_bundle_is_not_served(edge_bundle, tmp_path):
    copy = tmp_path / "edges"
    shutil.copytree(edge_bundle.path, copy)
    with (copy / "pipeline.toml").open("a") as file:
        file.write(" ")
    with pytest.raises(BundleError, match=r"pipeline\.toml was changed"):
        Service(copy, ANY, ANY)
    settings = copy / "pipeline.toml"
    settings.write_text(settings.read_text().replace("value = 70", "value = 20"))
    seal(copy)
    with pytest.raises(ReplayDiffers, match="token 'edges'"):
        Service(copy, ANY, ANY)


def test_an_address_that_others_can_reach_is_refused(edge_bundle):
    with pytest.raises(AddressError, match=r"tcp://0\.0\.0\.0:5999"):
        Service(edge_bundle.path, "tcp://0.0.0.0:5999", ANY)


def test_a_service_can_connect_instead_of_bind(edge_bundle, photograph):
    requests, answers = queue.Queue(), queue.Queue()
    with ep.ZMQPublisher(ANY, requests) as publisher, ep.ZMQSubscriber(ANY, answers, bind=True) as subscriber:
        sub, pub = f"connect:{publisher.address}", f"connect:{subscriber.address}"
        with StateLock(edge_bundle.path) as lock:
            service = Service(edge_bundle.path, sub, pub)
            lock.publish(service.start())
            assert publisher.wait_for_subscriber(TIMEOUT_S)
            assert subscriber.wait_joined(TIMEOUT_S)
            requests.put(Envelope(type="x", parts={"image": photograph}))
            assert answers.get(timeout=TIMEOUT_S).parts["edges"].any()
            with pytest.raises(ServiceError, match=re.escape(f"connects to {publisher.address}")):
                call(edge_bundle.path, {"image": photograph})
            service.stop()


def test_a_service_stops_twice_and_before_it_was_started(edge_bundle):
    service = Service(edge_bundle.path, ANY, ANY)
    service.stop()
    service.start()
    service.stop()
    service.stop()


def test_load_pipeline_gives_the_pipeline_that_serve_runs(edge_bundle, photograph):
    q_in, q_out = queue.Queue(), queue.Queue()
    with ep.load_pipeline(edge_bundle.path, q_in, q_out):
        request = Envelope(type="x", parts={"image": photograph})
        q_in.put(request)
        answer = q_out.get(timeout=TIMEOUT_S)
    assert answer.correlation_id == request.id
    assert answer.bundle_digest == edge_bundle.digest
    assert np.array_equal(answer.parts["edges"], cv2.Canny(cv2.medianBlur(photograph, 5), 70, 200))


@pytest.fixture(scope="module")
def copy_bundle(tmp_path_factory):
    """A bundle of one function ``f``, which copies its image."""
    runner = ep.CompGraphRunner(ep.CompGraph({"f": np.copy}, {"f": ("image", "out")}))
    runner.run(image=np.zeros((4, 4), np.uint8))
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "copy")


@pytest.fixture
def serving(copy_bundle):
    """Serve a graph of one function in this process; returns a function that starts it and gives the service."""
    started = []

    def serve(function):
        lock = StateLock(copy_bundle.path)
        service = Service(copy_bundle.path, ANY, ANY)
        # What a bundle can't be made of here, a function of this test, takes the place of its own.
        service.pipeline.network.nodes["f"].func = function
        lock.publish(service.start())
        started.append((service, lock))
        return copy_bundle.path, service

    yield serve
    for service, lock in started:
        service.stop()
        lock.__exit__(None, None, None)


@contextmanager
def peer_of(service):
    """Join a service from outside; gives a queue of requests and one of answers."""
    requests, answers = queue.Queue(), queue.Queue()
    with (
        ep.ZMQSubscriber(service.publisher.address, answers) as subscriber,
        ep.ZMQPublisher(service.subscriber.address, requests, bind=False) as publisher,
    ):
        assert subscriber.wait_joined(TIMEOUT_S)
        assert publisher.wait_for_subscriber(TIMEOUT_S)
        yield requests, answers


def held():
    """Return a function that says when it was called and does not return until it is released."""
    started, release = threading.Event(), threading.Event()

    def hold(image):
        started.set()
        release.wait(TIMEOUT_S)
        return image

    return hold, started, release


def test_a_function_that_uses_its_buffer_again_does_not_change_answers_on_their_way(serving):
    buffer = np.zeros((1000, 1000), np.uint8)

    def reuse(image):
        np.add(image, 1, out=buffer)
        return buffer

    path, _ = serving(reuse)

    def calls(value):
        image = np.full((1000, 1000), value, np.uint8)
        with Client(path, timeout_s=TIMEOUT_S) as client:
            return all((client.call({"image": image}).tokens["out"] == value + 1).all() for _ in range(15))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(calls, range(4)))


def test_threads_that_share_a_client_each_get_their_own_answer(serving):
    path, _ = serving(np.copy)
    with Client(path, timeout_s=TIMEOUT_S) as client, ThreadPoolExecutor(4) as pool:
        images = [np.full((9, 9), value, np.uint8) for value in range(40)]
        answers = list(pool.map(lambda image: client.call({"image": image}).tokens["out"], images))
    assert all(np.array_equal(image, answer) for image, answer in zip(images, answers, strict=True))


def test_a_value_that_cannot_be_sent_is_answered_with_a_failure(serving):
    path, service = serving(lambda image: object())
    with pytest.raises(RemoteFailure, match="Function 'f_out' failed in the service: MessageError"):
        call(path, {"image": np.zeros((9, 9), np.uint8)}, timeout_s=TIMEOUT_S)
    assert service.counts()["failed"] == 1


def test_a_function_that_exits_is_a_failure_and_the_service_goes_on(serving):
    def leave(image):
        if image[0, 0]:
            raise SystemExit(0)
        return image

    path, _ = serving(leave)
    with pytest.raises(RemoteFailure, match="SystemExit"):
        call(path, {"image": np.ones((9, 9), np.uint8)}, timeout_s=TIMEOUT_S)
    assert call(path, {"image": np.zeros((9, 9), np.uint8)}, timeout_s=TIMEOUT_S).tokens["out"].shape == (9, 9)


def test_every_event_is_answered_dropped_ones_and_those_that_wait_at_the_stop_too(serving):
    hold, started, release = held()
    _, service = serving(hold)
    count = 30
    with peer_of(service) as (requests, answers):
        sent = [Envelope(type="x", parts={"image": np.zeros((9, 9), np.uint8)}) for _ in range(count)]
        requests.put(sent[0])
        assert started.wait(TIMEOUT_S)
        for request in sent[1:]:
            requests.put(request)
        dropped = [answers.get(timeout=TIMEOUT_S) for _ in range(count - 1 - service.mailbox.size)]
        assert {answer.failure.exception for answer in dropped} == {"MessageError"}
        assert "Send it again later" in dropped[0].failure.message
        stopping = threading.Thread(target=service.stop)
        stopping.start()
        release.set()
        stopping.join()
        rest = [answers.get(timeout=TIMEOUT_S) for _ in range(1 + service.mailbox.size)]
    assert {answer.correlation_id for answer in dropped + rest} == {request.id for request in sent}
    assert all(answer.failure is None for answer in rest)
    assert service.counts() == {"received": 30, "answered": 30, "failed": 0, "dropped": 21, "rejected": 0}


def test_a_state_file_that_somebody_wrote_into_is_not_believed(edge_bundle, photograph):
    with StateLock(edge_bundle.path):
        state_file(edge_bundle.path).write_text('{"pid": "x", "sub": 1, "pub": 2, "digest": 3}')
        with pytest.raises(ServiceError, match="No service runs"):
            call(edge_bundle.path, {"image": photograph})


def test_a_function_that_does_not_return_is_named_at_the_stop_and_what_waited_is_answered(serving):
    endless, started, release = held()
    _, service = serving(endless)
    with peer_of(service) as (requests, answers):
        sent = [Envelope(type="x", parts={"image": np.zeros((9, 9), np.uint8)}) for _ in range(3)]
        requests.put(sent[0])
        assert started.wait(TIMEOUT_S)
        for request in sent[1:]:
            requests.put(request)
        with service.mailbox._changed:
            assert service.mailbox._changed.wait_for(lambda: service.mailbox.qsize() == 2, TIMEOUT_S)
        with pytest.raises(StillRunning, match=r"within 0\.2 s: still in 'f'"):
            service.stop(0.2)
        refused = [answers.get(timeout=TIMEOUT_S) for _ in range(2)]
        release.set()
    assert {answer.correlation_id for answer in refused} == {request.id for request in sent[1:]}
    assert all("the service stops" in answer.failure.message for answer in refused)


@pytest.mark.parametrize("notes", [None, [1], ["note " * 10_000]], ids=["none", "number", "long"])
@pytest.mark.parametrize("text", ["\ud800 bad", "x" * 10**7, ""], ids=["half a pair", "long", "empty"])
def test_a_failure_is_answered_whatever_the_exception_says(serving, text, notes):
    def fail(image):
        error = ValueError(text)
        error.__notes__ = notes
        raise error

    path, _ = serving(fail)
    # What is logged would be kept with the test's report, which can't hold half a surrogate pair.
    logging.disable()
    try:
        with pytest.raises(RemoteFailure, match="Function 'f' failed in the service: ValueError"):
            call(path, {"image": np.zeros((9, 9), np.uint8)}, timeout_s=TIMEOUT_S)
    finally:
        logging.disable(logging.NOTSET)


def test_an_event_that_cannot_be_sent_spoils_no_later_one(serving):
    started = threading.Event()
    path, _ = serving(lambda image: started.wait(0.5) or image)
    with Client(path, timeout_s=TIMEOUT_S) as client:
        with pytest.raises(ServiceError, match="could not be sent: no codec"):
            client.call({"image": object()})
        assert client.call({"image": np.ones((9, 9), np.uint8)}).tokens["out"].all()


def test_the_event_under_way_is_answered_too_when_the_service_must_stop(serving):
    endless, started, release = held()
    path, service = serving(endless)
    said = queue.Queue()

    def calling():
        with Client(path, timeout_s=TIMEOUT_S) as client:
            try:
                client.call({"image": np.zeros((9, 9), np.uint8)})
            except RemoteFailure as failure:
                said.put(str(failure))

    caller = threading.Thread(target=calling)
    caller.start()
    assert started.wait(TIMEOUT_S)
    with pytest.raises(StillRunning):
        service.stop(0.3)
    release.set()
    assert "the service stops while it is in f" in said.get(timeout=TIMEOUT_S)
    caller.join()


def test_the_colours_of_rgb_tokens_survive_the_way_through_a_service(tmp_path):
    runner, image = red_runner(), red_image(200)
    runner.run(image=image)
    bundle = ep.promote(runner, tmp_path / "red", outputs=["red", "unsaid"])
    answers: queue.SimpleQueue = queue.SimpleQueue()
    with StateLock(bundle.path) as lock, Service(bundle.path, ANY, ANY) as service:
        lock.publish(service.start())
        with Client(bundle.path, timeout_s=TIMEOUT_S) as client:
            assert np.array_equal(client.call({"image": image}).tokens["red"], runner["red"])
        requests: queue.SimpleQueue = queue.SimpleQueue()
        with (
            ep.ZMQSubscriber(service.publisher.address, answers) as subscriber,
            ep.ZMQPublisher(service.subscriber.address, requests, bind=False) as publisher,
        ):
            assert subscriber.wait_joined(TIMEOUT_S)
            assert publisher.wait_for_subscriber(TIMEOUT_S)
            requests.put(Envelope(type="x", parts={"image": image[..., ::-1].copy()}))
            answer = answers.get(timeout=TIMEOUT_S)
    assert answer.rgb == {"red"}
    assert np.array_equal(answer.parts["red"], runner["red"]), "what came as BGR was converted"
