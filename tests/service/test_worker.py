from __future__ import annotations

import json
import re
import shutil
import signal
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from epypes.bundle.manifest import write_manifest
from epypes.display.views.graphview import from_json
from epypes.service.supervision.frame_socket import WorkerMessage
from epypes.service.supervision.packing import MARK, unpack
from epypes.wire import Envelope, decode
from tests.service.bundles import written_bundle
from tests.service.workers import TIMEOUT_S, ready_worker, worker_of

pytestmark = pytest.mark.slow

# The event says what its function does.
SOURCE = '''
    """A graph whose functions do what the event says."""

    import ctypes
    import os
    import re
    import signal
    import subprocess
    import sys
    import time

    import numpy as np


    def act(what, k):
        if what in ACTIONS:
            return ACTIONS[what]()
        return f"{what} {k}"


    def tell(done, k):
        return f"{done} {k}"


    def fail():
        raise ValueError("not with me")


    def deep():
        return deep()


    def interrupt():
        raise KeyboardInterrupt


    def many():
        raise MemoryError("no room")


    def odd():
        class Odd(Exception):
            def __str__(self):
                raise RuntimeError("no text")

            @property
            def __notes__(self):
                raise SystemExit(1)

        raise Odd


    def say():
        print("from print")
        os.write(1, b"from the file descriptor\\n")
        subprocess.run(["echo", "from a child"], check=True)
        print("to stderr", file=sys.stderr)
        return "said"


    def hold():
        open(os.environ["STARTED"], "w").close()
        while not os.path.exists(os.environ["RELEASE"]):
            time.sleep(0.002)
        return "held"


    def regex():
        open(os.environ["STARTED"], "w").close()
        return re.match(r"(a+)+$", "a" * 60 + "b")


    ACTIONS = {
        "fail": fail,
        "exit": lambda: sys.exit(3),
        "interrupt": interrupt,
        "memory": many,
        "deep": deep,
        "odd": odd,
        "object": object,
        "say": say,
        "hold": hold,
        "regex": regex,
        "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
        "segv": lambda: ctypes.string_at(0),
        "signals": lambda: [str(signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)],
        "pid": os.getpid,
        "zeros": lambda: np.zeros((400, 400), np.uint8),
    }

    func_dict = {"act": act, "tell": tell}
    func_io = {"act": (("what", "k"), "out"), "tell": (("out", "k"), "told")}
'''
SAMPLE = {"what": "plain"}, {"out": "plain 2"}


@pytest.fixture(scope="module")
def acting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "acting"
    return written_bundle(folder, SOURCE, ["what"], ["out"], hyperparameters={"k": 2}, sample=SAMPLE)


@pytest.fixture(scope="module")
def shared(acting, tmp_path_factory):
    """A worker that many tests use one after another."""
    with ready_worker(acting, tmp_path_factory.mktemp("shared")) as front:
        yield front
        assert front.end() == 0


@pytest.fixture
def own(acting, tmp_path):
    """A worker of this test alone, with files by which a held function is seen and released."""

    @contextmanager
    def start(*options):
        environment = {"STARTED": str(tmp_path / "started"), "RELEASE": str(tmp_path / "release")}
        with ready_worker(acting, tmp_path, *options, environment=environment) as front:
            front.started, front.release = (Path(path) for path in environment.values())
            yield front

    return start


def until(condition):
    """Wait until something is so, and return it."""
    deadline = time.monotonic() + TIMEOUT_S
    while not (found := condition()):
        assert time.monotonic() < deadline, "it did not come to be"
        threading.Event().wait(0.005)
    return found


# -- ready ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text.replace("{what} {k}", "{what}-{k}"), "token 'out': expected 'plain 2', got 'plain-2'"),
        (lambda text: text + "import no_such_module\n", r"No module named 'no_such_module'"),
        (lambda text: text + "sys.exit(0)\n", r"failed at pipeline.py, line \d+: sys.exit\(0\): SystemExit: 0"),
        (lambda text: text + "1 +\n", "SyntaxError"),
        (lambda text: text.replace("func_io", "func_oi"), "defines no 'func_io'"),
        (lambda text: text.replace('return f"{what} {k}"', "fail()"), "not with me.*In function 'act'"),
    ],
)
def test_a_bundle_that_does_not_compute_what_was_recorded_is_refused(acting, tmp_path, change, reason):
    folder = tmp_path / "changed"
    shutil.copytree(acting, folder)
    module = folder / "pipeline.py"
    module.write_text(change(module.read_text()))
    write_manifest(folder)
    with worker_of(folder, tmp_path) as front:
        reasons = front.receive("refused").content["reasons"]
        assert any(re.search(reason, found) for found in reasons), reasons
        assert front.process.wait(TIMEOUT_S) == 1


# -- events --------------------------------------------------------------------------------------------------------


def test_the_trace_of_a_failure_has_the_lines_of_the_bundle_and_none_of_ours(shared, acting):
    header, _ = shared.run(what="fail")
    failure = header["failure"]
    assert failure["tokens"] == ["what", "k", "out"]
    trace = "\n".join(failure["trace"])
    assert f'File "{acting}/pipeline.py", line ' in trace
    assert 'raise ValueError("not with me")' in trace
    assert "In function 'act': (what='fail', k=2) -> (out)" in trace
    assert "epypes/run" not in trace


def test_what_functions_print_goes_to_stderr_and_never_into_the_channel(shared):
    assert shared.run(what="say")[1][0].parts["out"] == "said"
    shared.run(what="a")
    text = shared.stderr.read_text()
    for line in ("from print", "from the file descriptor", "from a child", "to stderr"):
        assert line in text


# -- parameters ----------------------------------------------------------------------------------------------------


def test_parameters_are_set_when_no_slot_works_and_asked_values_wait_for_that(own):
    with own("--threads", "2") as front:
        front.run(what="a")
        front.send_event(Envelope(type="x", parts={"what": "hold"}))
        until(front.started.exists)
        front.set(4, k=8)
        number = front.send_query("run", tokens=["told"], revision=4)
        other = front.send_query("svg")
        assert front.receive("answer").number == other
        assert not front.waiting, "neither is answered as long as the event is under way"
        front.release.touch()
        assert front.done()[0]["revision"] == 0
        assert front.changed()["revision"] == 4
        answer = front.receive("answer")
        assert answer.number == number
        assert decode(unpack(answer.frames[0])).parts["told"] == "held 8"


def test_asked_values_are_not_computed_beside_the_events_of_the_only_slot(own):
    with own() as front:
        front.run(what="a")
        front.set(4, k=8)
        front.send_event(Envelope(type="x", parts={"what": "hold"}))
        until(front.started.exists)
        front.send_query("run", tokens=["told"], revision=4)
        front.query("running")
        front.send_query("svg")
        front.receive("answer")
        front.release.touch()
        answer = front.receive("answer")
        assert decode(unpack(answer.frames[0])).parts["told"] == "held 8", "the event's own values came in time"


def test_a_value_that_an_annotation_does_not_allow_is_refused(tmp_path):
    source = """
        from typing import Annotated

        import epypes as ep


        def double(x, k: Annotated[int, ep.Param(1, 5)]):
            return x * k


        func_dict = {"double": double}
        func_io = {"double": (("x", "k"), "y")}
    """
    hparams, sample = {"k": 2}, ({"x": 4}, {"y": 8})
    bundle = written_bundle(tmp_path / "b", source, ["x"], ["y"], hyperparameters=hparams, sample=sample)
    with ready_worker(bundle, tmp_path, "--threads", "2") as front:
        front.set(1, k=9)
        assert "annotation allows" in front.changed()["problems"]["k"]
        front.set(2, k=5)
        assert front.changed()["revision"] == 2
        front.set(3, k=0)
        assert front.changed()["problems"]
        assert [front.run(x=1)[1][0].parts["y"] for _ in range(4)] == [5] * 4


# -- asking --------------------------------------------------------------------------------------------------------


def test_before_an_event_the_graph_is_seen_and_no_value(own):
    with own() as front:
        header, (view,) = front.query("view")
        assert [function.name for function in from_json(json.loads(view)).functions] == ["act", "tell"]
        assert front.query("svg")[1][0].startswith(b"<svg")
        assert front.query("preview", token="k", max_side_px=64)[1] == [b"2\nint 2"]
        for ask in ({"what": "preview", "token": "out", "max_side_px": 64}, {"what": "run", "tokens": ["out"]}):
            header, frames = front.query(**ask)
            assert (header["reason"], frames) == ("not computed", [])
            assert "No event has been completed yet" in header["error"]


def test_a_value_that_cannot_be_sent_is_refused_with_the_reason(shared):
    shared.run(what="object")
    header, _ = shared.query("run", tokens=["out"])
    assert header["reason"] == "no codec"
    assert shared.values("told").parts["told"].endswith(" 2")


def test_a_function_that_fails_with_new_parameters_is_the_answer_to_the_query(tmp_path):
    source = """
        def divide(x, k):
            return x // k


        func_dict = {"divide": divide}
        func_io = {"divide": (("x", "k"), "y")}
    """
    sample = {"x": 4}, {"y": 2}
    bundle = written_bundle(tmp_path / "b", source, ["x"], ["y"], hyperparameters={"k": 2}, sample=sample)
    with ready_worker(bundle, tmp_path) as front:
        front.run(x=8)
        front.set(1, k=0)
        header, _ = front.query("run", tokens=["y"], revision=1)
        assert (header["reason"], header["error"][:26]) == ("failed", "divide: ZeroDivisionError:")
        assert front.query("run", tokens=["y"], revision=7)[0]["reason"] == "unknown revision"


def test_too_many_queries_are_refused_and_none_is_left_without_answer(own):
    with own() as front:
        front.run(what="zeros")
        numbers = [front.send_query("preview", token="out", max_side_px=16 + side) for side in range(150)]
        answers = [front.receive("answer") for _ in numbers]
        assert sorted(answer.number for answer in answers) == numbers
        assert {answer.content.get("reason") for answer in answers} <= {None, "busy"}


# -- how it ends ---------------------------------------------------------------------------------------------------


def test_a_worker_whose_front_goes_ends_at_once_even_while_a_function_computes(own):
    with own() as front:
        front.send_event(Envelope(type="x", parts={"what": "hold"}))
        until(front.started.exists)
        start = time.monotonic()
        front.close()
        assert front.process.wait(TIMEOUT_S) == 3
        assert time.monotonic() - start < TIMEOUT_S / 2


def test_a_worker_writes_its_stacks_while_a_function_holds_the_interpreter(own):
    with own() as front:
        front.send_event(Envelope(type="x", parts={"what": "regex"}))
        until(front.started.exists)
        front.process.send_signal(signal.SIGUSR1)
        text = until(lambda: "in regex" in front.faults.read_text() and front.faults.read_text())
        assert re.search(r'File ".*/pipeline.py", line \d+ in regex', text)
        front.process.kill()


@pytest.mark.parametrize("message", [b"garbage " * 9, MARK + b"\xff" * 40], ids=["garbage", "too many"])
def test_a_worker_that_cannot_understand_its_front_ends_with_2(own, message):
    with own() as front:
        front.channel.send_buffers([memoryview(message)])
        assert front.process.wait(TIMEOUT_S) == 2
        assert "can't be understood" in front.stderr.read_text()


@pytest.mark.parametrize(
    ("channel", "message"),
    [("channel", WorkerMessage("ready")), ("channel", WorkerMessage("parameters", 1)), ("control", WorkerMessage("ready")), ("control", WorkerMessage("query"))],
)  # fmt: skip
def test_a_worker_that_gets_what_it_does_not_know_ends_with_2(own, channel, message):
    with own() as front:
        getattr(front, channel).send(message)
        assert front.process.wait(TIMEOUT_S) == 2


def test_a_worker_that_waits_costs_nothing(own):
    with own("--threads", "3") as front:
        front.run(what="a")
        process = psutil.Process(front.process.pid)

        def idles_for_a_second():
            before = process.num_ctx_switches().voluntary, sum(process.cpu_times()[:2])
            threading.Event().wait(1.0)
            switches = process.num_ctx_switches().voluntary - before[0]
            return switches <= 5 and sum(process.cpu_times()[:2]) - before[1] <= 0.1

        # Its threads may still be starting; one that polls would do so in every second.
        assert any(idles_for_a_second() for _ in range(10))
