"""An exported graph as a service in C++, beside the same bundle served by Python."""

from __future__ import annotations

import queue
import re
import signal
import subprocess
import sys
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.cli import main
from epypes.cpp import export_cpp
from epypes.errors import RemoteFailure, ServiceError
from epypes.service import Client, Service
from epypes.service.state_file import StateLock
from epypes.wire import Envelope
from epypes.wire.protobuf import message_class
from tests.conftest import EDGE_HPARAMS, EDGE_IO, blur, grayscale
from tests.service.bundles import written_bundle
from tests.serving import with_parent

pytestmark = pytest.mark.slow

TIMEOUT_S = 60.0


@pytest.fixture(scope="module", autouse=True)
def own_state(tmp_path_factory):
    """Services of these tests have folders of their own."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
            patched.setenv(name, str(tmp_path_factory.mktemp("state")))
        yield


def canny(image, lo, hi):
    return cv2.Canny(image, lo, hi)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, photograph):
    functions = {"grayscale": grayscale, "blur": blur, "canny": canny}
    runner = ep.CompGraphRunner(ep.CompGraph(functions, EDGE_IO), EDGE_HPARAMS)
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges").path


def compiled(bundle, project):
    """Return the service of a bundle, compiled with warnings as errors."""
    export_cpp(bundle, project, service=True)
    build, name = project / "build", f"{bundle.name}_service"
    # Without optimization, and with its sources as one, it compiles in a third of the time.
    options = ["-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS=-Werror -g0", "-DCMAKE_UNITY_BUILD=ON"]
    for command in (
        ["cmake", "-S", project, "-B", build, *options],
        ["cmake", "--build", build, "--target", name],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-4_000:] + done.stderr[-4_000:]
    return build / name


@pytest.fixture(scope="module")
def program(bundle, tmp_path_factory):
    return compiled(bundle, tmp_path_factory.mktemp("cpp") / "edges_cpp")


class Running:
    """A service in C++, with its addresses."""

    def __init__(self, process, key_file):
        self.process, self.key_file = process, key_file
        ready = re.search("events at (.*), answers at (.*), control at (.*), process", process.stdout.readline())
        self.sub, self.pub, self.http = ready.groups()

    def counts(self):
        return ep.connect(self.http).info()["counts"]

    def end(self):
        """Send SIGTERM; return the counts of the last line."""
        self.process.send_signal(signal.SIGTERM)
        line, _ = self.process.communicate(timeout=TIMEOUT_S)
        assert self.process.returncode == 0
        return {name: int(number) for name, number in re.findall(r"(\w+) (\d+)", line)}


@contextmanager
def running(program, folder, *options):
    key_file = folder / "access_key"
    command = [program, "--http", "127.0.0.1:0", "--access-key-file", key_file, *options]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **streams, text=True, preexec_fn=with_parent()) as process:
        try:
            yield Running(process, key_file)
        finally:
            process.kill()


@pytest.fixture(scope="module")
def cpp(program, tmp_path_factory):
    with running(program, tmp_path_factory.mktemp("running")) as service:
        yield service


@pytest.fixture(scope="module")
def python(bundle):
    with StateLock(bundle) as lock, Service(bundle) as service:
        assert service.state == "READY", service.reason
        lock.publish(service.service_state)
        yield service.service_state


@contextmanager
def peer_of(service):
    """Yield what sends events to a service, and the queue of its answers."""
    answers = queue.SimpleQueue()
    with ep.ZMQSubscriber(service.pub, answers) as subscriber, ep.ZMQPublisher(service.sub, bind=False) as publisher:
        assert subscriber.wait_joined(TIMEOUT_S)
        assert publisher.wait_for_subscriber(TIMEOUT_S)
        yield publisher, answers


def status_of(*command):
    """Run a command of epypes in this process; return its exit status as a shell sees it, printing what it says."""
    try:
        main([str(part) for part in command])
    except SystemExit as ending:
        if isinstance(ending.code, str):
            sys.stderr.write(f"{ending.code}\n")
            return 1
        return ending.code or 0
    return 0


def against(service):
    return f"{service.sub},{service.pub}"


def test_an_event_gets_the_answer_that_the_service_in_python_gives(cpp, python, photograph):
    """The edges are bit-identical between OpenCV of Debian and of the wheel."""
    request = Envelope("x", {"image": photograph}, acquired_ns=12, source="robot")
    answered = []
    for service in (cpp, python):
        with peer_of(service) as (publisher, answers):
            publisher.send(request)
            answered.append(answers.get(timeout=TIMEOUT_S))
    ours, theirs = answered
    np.testing.assert_array_equal(ours.parts["edges"], theirs.parts["edges"], strict=True)
    for name in ("type", "source", "sequence", "acquired_ns", "correlation_id", "revision", "bundle_digest"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert (ours.request_source, ours.request_sequence) == (theirs.request_source, theirs.request_sequence)
    assert list(ours.timings) == list(theirs.timings) == ["grayscale", "blur", "canny"]
    assert ours.attributes.keys() == theirs.attributes.keys()
    assert ours.attributes["total_ns"] == sum(ours.timings.values()) + ours.attributes["overhead_ns"]


def keep(value):
    return value


# A value of each type that a token may have in C++.
VALUES = {
    "whole": 3,
    "number": 2.5,
    "truth": True,
    "text": "caf\xe9",
    "float32": np.float32(1.5),
    "int64": np.int64(-7),
    "bool_": np.bool_(True),
    "gray": np.arange(2_000, dtype=np.uint8).reshape(40, 50),
    "colour": np.arange(30_000, dtype=np.uint16).reshape(100, 100, 3),
    "flow": np.arange(60, dtype=np.float32).reshape(6, 5, 2),
    "rows": np.arange(28, dtype=np.float32).reshape(7, 4),
    "line": np.arange(3_000),
    "mask": np.eye(4, 5) > 0,
    "block": np.arange(120.0).reshape(2, 3, 4, 5),
    "floats": [1.0, 2.0],
    "pair": (1, 2.5, "x"),
    "pairs": [(1, 2.0), (3, 4.0)],
    "texts": ["a", "b"],
    "keypoints": [cv2.KeyPoint(1, 2, 3, 4, 5, 6, 7)],
    "matches": (cv2.DMatch(1, 2, 3.5), cv2.DMatch(0, 1, 0.5)),
    "contours": (np.array([[[1, 2]], [[3, 4]]], np.int32), np.array([[[5, 6]]], np.int32)),
}


def mix(image, before, k):
    if before is None:
        return image
    return cv2.addWeighted(image, 1.0 - k, before, k, 0.0)


@pytest.mark.soak
def test_state_between_events_outlives_the_event_that_it_came_with(tmp_path, capsys):
    cg = ep.CompGraph({"mix": mix}, {"mix": (("image", "before", "k"), "mixed")})
    runner = ep.CompGraphRunner(ep.delay(cg, "mixed", "before", initial=None), {"k": 0.5})
    images = [np.full((40, 50), 16 * step, np.uint8) for step in range(4)]
    expected = [runner.run(image=image)["mixed"] for image in images]
    bundle = ep.promote(runner, tmp_path / "mixing").path
    with (
        running(compiled(bundle, tmp_path / "mixing_cpp"), tmp_path) as service,
        Client(bundle, sub=service.sub, pub=service.pub, timeout_s=TIMEOUT_S) as client,
    ):
        for image, mixed in zip(images, expected, strict=True):
            np.testing.assert_array_equal(client.call({"image": image}).tokens["mixed"], mixed)
    assert status_of("verify", bundle, "--against", against(service)) == 1
    assert "has state between events ('before')" in capsys.readouterr().err


@pytest.mark.soak
def test_values_of_every_type_arrive_and_return_as_they_are(tmp_path, capsys):
    names = {token: f"keep_{token}" for token in VALUES}
    io = {name: (token, f"{token}_kept") for token, name in names.items()}
    runner = ep.CompGraphRunner(ep.CompGraph(dict.fromkeys(io, keep), io))
    runner.run(**VALUES)
    bundle = ep.promote(runner, tmp_path / "every_type").path
    with running(compiled(bundle, tmp_path / "every_type_cpp"), tmp_path) as service:
        assert status_of("verify", bundle, "--against", against(service)) == 0
    assert f"identical: {len(VALUES)} tokens of 1 sample" in capsys.readouterr().out


def test_call_finds_a_service_by_its_addresses(bundle, cpp, photograph, straight_edges, tmp_path):
    cv2.imwrite(str(tmp_path / "image.png"), photograph)
    command = ["call", bundle, tmp_path / "image.png", "--out", tmp_path / "edges.png"]
    assert status_of(*command, "--sub", cpp.sub, "--pub", cpp.pub) == 0
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "edges.png"), cv2.IMREAD_GRAYSCALE), straight_edges)


@pytest.mark.parametrize("name", ["cpp", "python"])
def test_verify_replays_the_samples_against_a_service_in_either_language(name, bundle, request, capsys):
    service = request.getfixturevalue(name)
    assert status_of("verify", bundle, "--against", against(service)) == 0
    assert "identical: 1 token of 1 sample" in capsys.readouterr().out


def test_verify_finds_a_service_of_this_machine_by_its_bundle(bundle, python, capsys):
    assert status_of("verify", bundle, "--against", bundle) == 0
    assert f"by the service at {bundle}" in capsys.readouterr().out


def test_parameters_are_set_while_it_runs_and_verify_names_what_differs(bundle, cpp, photograph, capsys):
    key = ["--access-key-file", cpp.key_file]
    assert status_of("set", cpp.http, "canny_lo=90", *key) == 0
    assert "canny_lo 70 -> 90: revision 1" in capsys.readouterr().out
    with peer_of(cpp) as (publisher, answers):
        publisher.send(Envelope("x", {"image": photograph}))
        answer = answers.get(timeout=TIMEOUT_S)
    expected = canny(blur(grayscale(photograph), 11), 90, 200)
    np.testing.assert_array_equal(answer.parts["edges"], expected)
    assert answer.revision == 1
    assert status_of("verify", bundle, "--against", against(cpp)) == 1
    printed = capsys.readouterr()
    assert re.search(r"'edges': \d+ of 240000 values differ, first at \[\d+, \d+\]: expected 255, got 0", printed.out)
    assert "The service at tcp" in printed.err
    assert status_of("verify", bundle, "--against", against(cpp), "--tolerance", "edges=255") == 0
    assert "differs by at most 255" in capsys.readouterr().err
    assert status_of("set", cpp.http, "canny_lo=70", *key) == 0


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("blur_kernel=4", "blur_kernel has to be at least 1 and odd"),
        ("canny_lo=1.5", "'canny_lo' is a whole number, and 1.5 is none."),
        ("canny_lo=99999999999", "is a whole number from -2147483648 to 2147483647, and 99999999999 is none."),
        ("canny_low=1", "No hyperparameter 'canny_low' in this service"),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(value, reason, cpp, capsys):
    assert status_of("set", cpp.http, value, "--access-key-file", cpp.key_file) == 1
    assert reason in capsys.readouterr().err


def test_a_change_needs_the_access_key(cpp):
    with pytest.raises(ServiceError, match="Changes need the service's access key"):
        ep.connect(cpp.http).set(canny_lo=80)
    with pytest.raises(ServiceError, match="This is not the service's access key"):
        ep.connect(cpp.http, access_key="x" * 22).set(canny_lo=80)
    assert ep.connect(cpp.http).parameters().entries["canny_lo"]["value"] == 70


def test_an_exception_of_opencv_is_a_failure_of_the_function(bundle, cpp):
    with (
        Client(bundle, sub=cpp.sub, pub=cpp.pub, timeout_s=TIMEOUT_S) as client,
        pytest.raises(RemoteFailure, match=r"grayscale.*cv::Exception.*Assertion failed.*_src.empty"),
    ):
        client.call({"image": np.zeros((0, 5, 3), np.uint8)})


def test_verify_says_that_nothing_answers_or_that_the_service_is_another_one(bundle, cpp, tmp_path, photograph, capsys):
    nowhere = f"ipc://{tmp_path}/sub,ipc://{tmp_path}/pub"
    assert status_of("verify", bundle, "--against", nowhere, "--timeout", "0.2") == 1
    assert "can't be reached within 0.2 s" in capsys.readouterr().err
    assert status_of("verify", bundle, "--against", cpp.sub) == 1
    assert "Give both: --against EVENTS,ANSWERS" in capsys.readouterr().err
    assert status_of("verify", bundle, "--tolerance", "edges=1") != 0
    assert "give --against too" in capsys.readouterr().err
    assert status_of("verify", bundle, "--against", against(cpp), "--tolerance", "edge=1") == 1
    assert "Did you mean" in capsys.readouterr().err
    sample = {"image": photograph}, {"gray": photograph[..., 0].copy()}
    other = written_bundle(tmp_path / "other", "", ["image"], ["gray"], sample=sample)
    assert status_of("verify", other, "--against", against(cpp)) == 1
    assert f"answers with edges, and {other} has recorded gray" in capsys.readouterr().err


# -- hostile messages -------------------------------------------------------------------------------------------------


def header(name, change):
    message = message_class("epypes.v1.Envelope")(id=name, version=1)
    change(message)
    return message.SerializeToString()


def add_image(message, *, name="image", width=4, height=4, encoding="bgr8", step=12, data=b"x" * 48, frame=None):
    image = message.parts.add(name=name).value.image
    image.width, image.height, image.encoding, image.step = width, height, encoding, step
    if frame is None:
        image.inline = data
    else:
        image.frame = frame


def add_tensor(message, dtype, shape, data=b""):
    tensor = message.parts.add(name="image").value.tensor
    tensor.dtype, tensor.inline = dtype, data
    tensor.shape.extend(shape)


def add_nested(message, depth):
    value = message.parts.add(name="image").value
    for _ in range(depth):
        value = value.list.items.add()
    value.integer = 1


def add_values(message):
    value = message_class("epypes.v1.Value")(integer=1)
    message.parts.add(name="image").value.list.items.extend([value] * 1_000_001)


# What is answered with a failure of f_in, with a part of its message.
HOSTILE = {
    "size": (lambda message: add_image(message, width=10_000, height=10_000, step=30_000), "has 48 bytes"),
    "side": (lambda message: add_image(message, width=2**31 - 1, height=2**31 - 1, step=2**32 - 1), "which can't be"),
    "encoding": (lambda message: add_image(message, encoding="yuv"), "encoding 'yuv', which is not known"),
    "shape": (lambda message: add_tensor(message, "<f8", [2**40, 2**40], b"x" * 64), "a shape that no array has"),
    "overflow": (lambda message: add_tensor(message, "|u1", [2**31 - 1] * 30, b"x" * 64), "takes another number"),
    "no bytes": (lambda message: add_tensor(message, "|u1", [*[2**31 - 1] * 30, 0]), "31 axes"),
    "negative": (lambda message: add_tensor(message, "|u1", [-1, 3]), "a shape that no array has"),
    "dtype": (lambda message: add_tensor(message, "|O", [1], b"x" * 8), "dtype '|O', which this service does not take"),
    "frame": (lambda message: add_image(message, frame=7), "payload frame 7, but there are 0"),
    "depth": (lambda message: add_nested(message, 27), "nests deeper than 24 containers"),
    "parts": (lambda message: [add_image(message, name=str(number)) for number in range(2_000)], "may have 1024 parts"),
    "values": (add_values, "more than 1000000 values"),
    "twice": (lambda message: [add_image(message), add_image(message)], "'image' twice among its parts"),
    "others": (lambda message: add_image(message, name="frame"), "must have the parts 'image'; it has 'frame'"),
    "kind": (lambda message: add_tensor(message, "<f4", [4, 4, 3], b"\0" * 192), "this service takes CV_8U, 3 axes"),
}


def test_hostile_messages_are_answered_or_counted_and_cost_little_memory(cpp):
    before = cpp.counts()
    good = header("good", add_image)
    with peer_of(cpp) as (publisher, answers):
        for name, (change, text) in HOSTILE.items():
            publisher.send((b"/", header(name, change)))
            answer = answers.get(timeout=TIMEOUT_S)
            failure = answer.failure
            assert (answer.correlation_id, failure.function, failure.exception) == (name, "f_in", "MessageError")
            assert text in failure.message
        for frames in ((b"/", good, b"unused"), (b"of 2019",)):
            publisher.send(frames)
            assert answers.get(timeout=TIMEOUT_S).failure.function == "f_in"
        for frames in (
            (b"/", b"\xff\xff"),
            (b"/", good[:-3]),
            (b"no topic", good),
            (b"/", good + b"\x78\x02"),  # of version 2
            (b"/", good, *[b""] * 1_025),
        ):
            publisher.send(frames)
        publisher.send((b"/", good))
        answer = answers.get(timeout=TIMEOUT_S)
        assert (answer.correlation_id, answer.parts["edges"].shape) == ("good", (4, 4))
    counts = cpp.counts()
    assert counts["rejected"] - before["rejected"] == 5
    assert counts["failed"] - before["failed"] == len(HOSTILE) + 2
    with open(f"/proc/{cpp.process.pid}/status", encoding="ascii") as status:
        peak_kb = int(re.search(r"VmHWM:\s+(\d+) kB", status.read())[1])
    assert peak_kb < 500_000


def test_events_that_find_no_room_are_answered_and_counted(program, tmp_path):
    image = np.zeros((1_500, 1_500, 3), np.uint8)
    with running(program, tmp_path, "--mailbox-size", "2") as service:
        with peer_of(service) as (publisher, answers):
            for _ in range(20):
                publisher.send(Envelope("x", {"image": image}))
            answered = [answers.get(timeout=TIMEOUT_S) for _ in range(20)]
        dropped = [answer for answer in answered if answer.failure is not None]
        assert {answer.failure.function for answer in dropped} <= {"mailbox"}
        assert [answer.sequence for answer in answered] == [*range(1, 21)]
        counts = service.end()
    assert (counts["received"], counts["answered"], counts["dropped"]) == (20, 20 - len(dropped), len(dropped))


def test_sigterm_ends_it_after_the_accepted_events_are_answered(program, tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (2_000, 2_000, 3), np.uint8)
    timeout = ["--drain-timeout", str(TIMEOUT_S)]
    with running(program, tmp_path, *timeout) as service, peer_of(service) as (publisher, answers):
        requests = [Envelope("x", {"image": image}) for _ in range(6)]
        for request in requests:
            publisher.send(request)
        while service.counts()["received"] < len(requests):
            continue
        counts = service.end()
        answered = [answers.get(timeout=TIMEOUT_S) for _ in requests]
    assert [answer.correlation_id for answer in answered] == [request.id for request in requests]
    assert counts == {"received": 6, "answered": 6, "failed": 0, "dropped": 0, "rejected": 0}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--sub", "tcp://0.0.0.0:5555"], "Other machines can reach tcp://0.0.0.0:5555"),
        (["--mailbox", "newest"], "There is no mailbox newest. Take drop_oldest, latest or fault."),
        (["--http", "127.0.0.1:0"], "HTTP control needs an access key"),
        (["--port", "5555"], "There is no option --port. See --help."),
    ],
)
def test_options_that_make_no_sense_are_refused(options, reason, program):
    done = subprocess.run([program, *options], capture_output=True, text=True, check=False, timeout=TIMEOUT_S)
    assert done.returncode != 0
    assert reason in done.stderr
