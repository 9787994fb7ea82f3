from __future__ import annotations

import os
import queue
import re
import shutil
import signal
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import zmq

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.errors import AddressError, BundleError, RemoteFailure, ServiceError
from epypes.service import Client, Service, call
from epypes.service.serving import serve
from epypes.service.state_file import ServiceState, StateLock, running_at, state_file
from epypes.store import Store
from epypes.wire import Envelope, encode
from tests.colours import red_image, red_runner
from tests.service.bundles import written_bundle
from tests.service.processes import run_cli, running
from tests.service.served import TIMEOUT_S, peer_of, serving, until
from tests.service.states import read_state

ANY = "tcp://127.0.0.1:*"

IMAGES = '''
    """Functions of images that a service must stand."""


    def brighten(image):
        return image + 1


    func_dict = {"brighten": brighten}
    func_io = {"brighten": ("image", "out")}
'''
FAILING = '''
    """Failures that a service must stand."""


    class Odd(ValueError):
        pass


    class Speechless(Exception):
        def __str__(self):
            raise RuntimeError("no text")


    def fail(what):
        if what == "good":
            return what
        if what == "object":
            return object()
        if what == "exit":
            raise SystemExit(0)
        if what == "interrupt":
            raise KeyboardInterrupt
        if what == "speechless":
            raise Speechless
        if what == "memory":
            raise MemoryError("no room")
        if what == "recursion":
            return fail(what)
        error = Odd({"half a pair": "\\ud800 bad", "long": "x" * 10**7}.get(what, ""))
        error.__notes__ = {"number": [1], "long": ["note " * 10_000]}.get(what)
        raise error


    func_dict = {"fail": fail}
    func_io = {"fail": ("what", "out")}
'''


@pytest.fixture(scope="module")
def image_bundle(tmp_path_factory):
    small = np.zeros((4, 4), np.uint8)
    folder = tmp_path_factory.mktemp("bundles") / "images"
    return written_bundle(folder, IMAGES, ["image"], ["out"], sample=({"image": small}, {"out": small + 1}))


@pytest.fixture(scope="module")
def failing_bundle(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "failing"
    return written_bundle(folder, FAILING, ["what"], ["out"], sample=({"what": "good"}, {"out": "good"}))


@pytest.fixture
def local():
    """Returns a function that serves a bundle with its front in this process, its state published as serve does."""
    started = []

    def serve(path, *arguments, **options):
        lock = StateLock(path)
        service = Service(path, *arguments, **options)
        started.append((service, lock))
        lock.publish(service.start())
        assert service.state == "READY", service.reason
        return service

    yield serve
    for service, lock in started:
        service.stop()
        lock.__exit__(None, None, None)


@pytest.mark.slow
def test_a_service_in_another_process_answers_with_what_the_notebook_computed(edge_bundle, photograph, tmp_path):
    """It is served once at a time, and a call to one that is stopped is not waited for without end."""
    expected = cv2.Canny(cv2.medianBlur(photograph, 5), 70, 200)
    with running(edge_bundle.path, "--store", str(tmp_path / "events.sqlite")) as process:
        assert process.ready.startswith("READY")
        with Client(edge_bundle.path, timeout_s=TIMEOUT_S) as client:
            answers = [client.call({"image": photograph}) for _ in range(3)]
            for answer in answers:
                assert np.array_equal(answer.tokens["edges"], expected)
                assert set(answer.timings_ns) == {"smooth", "canny"}
                assert 0 < answer.overhead_ns < answer.total_ns < answer.round_trip_ns
            with pytest.raises(ServiceError, match=f"is being served already, by process {process.pid} at tcp://"):
                serve(edge_bundle.path, ANY, ANY)
            client.timeout_s = 0.5
            process.send_signal(signal.SIGSTOP)
            try:
                with pytest.raises(ServiceError, match="did not answer within 0.5 s"):
                    client.call({"image": photograph})
            finally:
                process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0, err
        assert "STOPPED received 4, answered 4, failed 0, dropped 0, retried 0, dead_letters 0" in out
    assert read_state(edge_bundle.path) is None
    with Store(tmp_path / "events.sqlite") as store:
        rows = store.series("events", *store.names("events")).rows()
        assert [row["outcome"] for row in rows] == ["answered"] * 4


@pytest.mark.slow
def test_a_function_that_fails_is_reported_to_the_caller_and_the_service_goes_on(local, edge_bundle, photograph):
    service = local(edge_bundle.path)
    with pytest.raises(RemoteFailure, match="Function 'smooth' failed in the service: error") as error:
        call(edge_bundle.path, {"image": np.zeros((0, 0), np.uint8)}, timeout_s=TIMEOUT_S)
    assert error.value.function == "smooth"
    assert call(edge_bundle.path, {"image": photograph}, timeout_s=TIMEOUT_S).tokens["edges"].any()
    assert service.counts()["failed"] == 1
    for parts in ({}, {"picture": np.zeros((9, 9), np.uint8)}, {"image": 1, "more": 2}):
        with pytest.raises(RemoteFailure, match="The event must have the parts 'image'; it has"):
            call(edge_bundle.path, parts, timeout_s=TIMEOUT_S)


@pytest.mark.slow
def test_garbage_on_the_input_socket_is_counted_and_the_service_goes_on(edge_bundle, photograph):
    header = bytes(encode(Envelope(type="x", parts={"image": photograph}))[1])
    garbage = [
        [b""], [b"garbage"], [os.urandom(5000)], [b"\x00" * 100], [b"a/", b"garbage"], [b"/", b""],
        [b"/", header], [b"/", header, b"too short"], [b"/", os.urandom(300), os.urandom(300)], [b""] * 50,
        [b"\xff\xff"], [b"\x80\x04\x95canary"], encode(Envelope("x", {"image": photograph}, source="s" * 2_000)),
    ]  # fmt: skip
    with serving(edge_bundle.path, mailbox_size=50) as (service, peer):
        context = zmq.Context()
        context.linger = 0
        socket_ = context.socket(zmq.XPUB)
        try:
            socket_.connect(service.service_state.sub)
            assert socket_.poll(TIMEOUT_S * 1000), "the service has subscribed"
            for frames in garbage:
                socket_.send_multipart(frames)
            # The same socket: what comes behind the garbage arrives behind it.
            request = Envelope(type="x", parts={"image": photograph})
            socket_.send_multipart(encode(request))
            while (answer := peer.take()[0]).correlation_id != request.id:
                assert answer.failure is not None
        finally:
            socket_.close(0)
            context.term()
        assert answer.failure is None
        assert answer.parts["edges"].any()
        until(lambda: service.counts()["answered"] == 1)
        counts = service.counts()
        assert counts["rejected"] >= 4
        assert counts["rejected"] + counts["failed"] == len(garbage)


@pytest.mark.slow
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
    with Service(edge_bundle.path, f"tcp://127.0.0.1:{port}") as service:
        assert service.service_state.sub == f"tcp://127.0.0.1:{port}"


def test_one_of_two_addresses_that_is_missing_is_named(edge_bundle):
    with pytest.raises(ServiceError, match=r"pub \(--pub\) is missing: give both addresses"):
        Client(edge_bundle.path, sub="tcp://127.0.0.1:5555")


@pytest.mark.slow
def test_a_killed_service_is_an_error_at_once_and_is_not_taken_for_a_running_one(edge_bundle, photograph):
    with running(edge_bundle.path) as process, Client(edge_bundle.path, timeout_s=TIMEOUT_S) as client:
        client.call({"image": photograph})
        process.kill()
        process.wait(TIMEOUT_S)
        with pytest.raises(ServiceError, match="ended before it answered"):
            client.call({"image": photograph})
        assert state_file(edge_bundle.path).read_text()
        with pytest.raises(ServiceError, match="No service runs for .* Start one: epypes serve"):
            call(edge_bundle.path, {"image": photograph})
    with running(edge_bundle.path):
        assert call(edge_bundle.path, {"image": photograph}, timeout_s=TIMEOUT_S).tokens["edges"].any()


@pytest.mark.slow
def test_a_changed_bundle_is_not_served(edge_bundle, tmp_path):
    copy = tmp_path / "edges"
    shutil.copytree(edge_bundle.path, copy)
    settings = copy / "pipeline.toml"
    settings.write_text(settings.read_text().replace("value = 70", "value = 20"))
    with pytest.raises(BundleError, match=r"pipeline\.toml was changed"):
        Service(copy, ANY, ANY)
    write_manifest(copy)
    done = run_cli("serve", copy)
    assert done.returncode == 1
    assert "token 'edges'" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_address_that_others_can_reach_is_refused(edge_bundle):
    with pytest.raises(AddressError, match=r"tcp://0\.0\.0\.0:5999"):
        Service(edge_bundle.path, "tcp://0.0.0.0:5999", ANY)


@pytest.mark.slow
def test_a_service_can_connect_instead_of_bind(local, edge_bundle, photograph):
    requests, answers = queue.Queue(), queue.Queue()
    with ep.ZMQPublisher(ANY, requests) as publisher, ep.ZMQSubscriber(ANY, answers, bind=True) as subscriber:
        service = local(edge_bundle.path, f"connect:{publisher.address}", f"connect:{subscriber.address}")
        assert publisher.wait_for_subscriber(TIMEOUT_S)
        assert subscriber.wait_joined(TIMEOUT_S)
        requests.put(Envelope(type="x", parts={"image": photograph}))
        assert answers.get(timeout=TIMEOUT_S).parts["edges"].any()
        with pytest.raises(ServiceError, match=re.escape(f"connects to {publisher.address}")):
            call(edge_bundle.path, {"image": photograph})
        service.stop()


@pytest.mark.slow
def test_a_service_stops_twice_and_before_it_was_started(acting):
    service = Service(acting)
    assert service.state == "STOPPED"
    service.stop()
    service.start()
    with peer_of(service) as peer:
        assert peer.ask(number=1).parts["out"] == 2
    service.stop()
    service.stop()
    assert service.state == "STOPPED"
    with service, peer_of(service) as peer:
        assert peer.ask(number=2).parts["out"] == 4


def test_load_pipeline_gives_the_pipeline_that_serve_runs(edge_bundle, photograph):
    q_in, q_out = queue.Queue(), queue.Queue()
    with ep.load_pipeline(edge_bundle.path, q_in, q_out):
        request = Envelope(type="x", parts={"image": photograph})
        q_in.put(request)
        answer = q_out.get(timeout=TIMEOUT_S)
    assert answer.correlation_id == request.id
    assert answer.bundle_digest == edge_bundle.digest
    assert np.array_equal(answer.parts["edges"], cv2.Canny(cv2.medianBlur(photograph, 5), 70, 200))


@pytest.mark.slow
def test_threads_that_share_a_client_each_get_their_own_answer(local, image_bundle):
    local(image_bundle)
    with Client(image_bundle, timeout_s=TIMEOUT_S) as client, ThreadPoolExecutor(4) as pool:
        images = [np.full((9, 9), value, np.uint8) for value in range(40)]
        answers = list(pool.map(lambda image: client.call({"image": image}).tokens["out"], images))
        assert all(np.array_equal(image + 1, answer) for image, answer in zip(images, answers, strict=True))
        with pytest.raises(ServiceError, match="could not be sent: no codec"):
            client.call({"image": object()})
        assert (client.call({"image": images[0]}).tokens["out"] == 1).all(), "it spoils no later one"


@pytest.mark.slow
def test_whatever_a_function_raises_or_returns_is_answered_and_the_service_goes_on(local, failing_bundle):
    service = local(failing_bundle)
    failures = {
        "object": "Function 'f_out' failed in the service: MessageError",
        "exit": "SystemExit",
        "interrupt": "KeyboardInterrupt",
        "memory": "MemoryError: no room",
        "speechless": "Speechless: .its message can't be had",
        "recursion": "RecursionError: maximum recursion depth",
        "half a pair": "Function 'fail' failed in the service: Odd",
        "long": "Function 'fail' failed in the service: Odd",
        "number": "Function 'fail' failed in the service: Odd",
    }
    with Client(failing_bundle, timeout_s=TIMEOUT_S) as client:
        for what, text in failures.items():
            with pytest.raises(RemoteFailure, match=text):
                client.call({"what": what})
        assert client.call({"what": "good"}).tokens["out"] == "good"
    until(lambda: service.counts()["answered"] == 1)
    assert (service.counts()["failed"], service.info()["restarts"]) == (len(failures), 0)


@pytest.mark.slow
def test_every_event_is_answered_dropped_ones_and_those_that_wait_at_the_stop_too(acting, tmp_path):
    count, size = 30, 8
    with serving(acting, mailbox_size=size) as (service, peer):
        peer.send(f"hold:{tmp_path}", 0)
        until((tmp_path / "started").exists)
        for number in range(1, count):
            peer.send(number=number)
        dropped = peer.take(count - 1 - size)
        assert {answer.failure.exception for answer in dropped} == {"MessageError"}
        assert "Send it again later" in dropped[0].failure.message
        stopping = threading.Thread(target=service.stop)
        stopping.start()
        until(lambda: service.state == "DRAINING")
        assert "takes no more" in service.ready()
        (tmp_path / "release").touch()
        stopping.join()
        rest = peer.take(1 + size)
        assert [answer.correlation_id for answer in dropped] == peer.sent[1 : count - size]
        assert [answer.correlation_id for answer in rest] == [peer.sent[0], *peer.sent[count - size :]]
        assert all(answer.failure is None for answer in rest)
    expected = {"received": 30, "answered": 9, "failed": 0, "dropped": 21, "rejected": 0}
    assert {name: service.counts()[name] for name in expected} == expected


def test_a_state_file_with_other_contents_is_ignored(edge_bundle, photograph):
    with StateLock(edge_bundle.path):
        for text in ("", "{", "[1]", '{"pid": 1, "http": 3}'):
            state_file(edge_bundle.path).write_text(text)
            with pytest.raises(ServiceError, match="No service runs"):
                call(edge_bundle.path, {"image": photograph})
            assert running_at("http://127.0.0.1:1") is None


def test_a_service_is_found_by_where_it_answers_over_http(acting, edge_bundle):
    state = ServiceState(1, "a", "b", "c", "d", "http://127.0.0.1:8642", "/token")
    with StateLock(acting) as lock, StateLock(edge_bundle.path):
        lock.publish(state)
        assert running_at("http://127.0.0.1:8642/") == state
        assert running_at("http://127.0.0.1:864") is None
    assert running_at("http://127.0.0.1:8642") is None, "it does not run any more"


@pytest.mark.slow
def test_the_colours_of_rgb_tokens_survive_the_way_through_a_service(local, tmp_path):
    runner, image = red_runner(), red_image(200)
    runner.run(image=image)
    bundle = ep.promote(runner, tmp_path / "red", outputs=["red", "unsaid"])
    service = local(bundle.path)
    with Client(bundle.path, timeout_s=TIMEOUT_S) as client:
        assert np.array_equal(client.call({"image": image}).tokens["red"], runner["red"])
    with peer_of(service) as peer:
        peer.requests.put(Envelope(type="x", parts={"image": image[..., ::-1].copy()}))
        (answer,) = peer.take()
    assert answer.rgb == {"red"}
    assert np.array_equal(answer.parts["red"], runner["red"]), "what came as BGR was converted"


SEARCHING = '''
    """A function that may find nothing."""

    import epypes as ep


    def find(x):
        return x if x > 2 else ep.Nothing


    def double(y):
        return 2 * y


    func_dict = {"find": find, "double": double}
    func_io = {"find": ("x", "y"), "double": ("y", "z")}
'''


def test_a_service_answers_nothing_where_nothing_was_found(tmp_path):
    sample = ({"x": 1}, {"y": ep.Nothing, "z": ep.Nothing})
    bundle = written_bundle(tmp_path / "search", SEARCHING, ["x"], ["y", "z"], sample=sample)
    with StateLock(bundle) as lock, Service(bundle, ANY, ANY) as service:
        lock.publish(service.start())
        with Client(bundle) as client:
            answers = [client.call({"x": x}) for x in (3, 1, ep.Nothing)]
        assert [answer.tokens["z"] for answer in answers] == [6, ep.Nothing, ep.Nothing]
        assert [[*answer.timings_ns] for answer in answers] == [["find", "double"], ["find"], []]
        assert service.counts()["failed"] == 0
        lines = run_cli("call", bundle, "x=1", "--out", f"z={tmp_path}/z.png").stdout.splitlines()
        assert lines[:2] == ["y = Nothing", f"z = Nothing: {tmp_path}/z.png is not written"]
        assert not (tmp_path / "z.png").exists()
        assert run_cli("call", bundle, "x=5").stdout.splitlines()[:2] == ["y = 5", "z = 10"]
