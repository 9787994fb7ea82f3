from __future__ import annotations

import json
import re
import shutil
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from epypes.bundle.seal import seal
from epypes.display.views.jsonview import from_json
from epypes.service.packing import unpack
from epypes.wire import Envelope, decode
from tests.service.bundles import written_bundle
from tests.service.workers import TIMEOUT_S, ready_worker, worker_of

pytestmark = pytest.mark.slow

# What its function does is told by the event.
SOURCE = '''
    """A graph whose functions do what they are told."""

    import os
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


    ACTIONS = {
        "fail": fail,
        "object": object,
        "say": say,
        "hold": hold,
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
        (lambda text: text.replace('return f"{what} {k}"', "fail()"), "not with me.*In function 'act'"),
    ],
)
def test_a_bundle_that_does_not_compute_what_was_recorded_is_refused(acting, tmp_path, change, reason):
    folder = tmp_path / "changed"
    shutil.copytree(acting, folder)
    module = folder / "pipeline.py"
    module.write_text(change(module.read_text()))
    seal(folder)
    with worker_of(folder, tmp_path) as front:
        header, _ = front.receive("refused")
        assert any(re.search(reason, found) for found in header["reasons"]), header
        assert front.process.wait(TIMEOUT_S) == 1


# -- events --------------------------------------------------------------------------------------------------------


def test_the_trace_of_a_failure_tells_the_lines_of_the_bundle_and_none_of_ours(shared, acting):
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
        ask = front.send_ask("run", tokens=["told"], revision=4)
        other = front.send_ask("svg")
        assert front.receive("answer")[0]["ask"] == other
        assert not front.waiting, "neither is answered as long as the event is under way"
        front.release.touch()
        assert front.done()[0]["revision"] == 0
        assert front.receive("parameters")[0]["revision"] == 4
        header, (packed,) = front.receive("answer")
        assert header["ask"] == ask
        assert decode(unpack(packed)).parts["told"] == "held 8"


def test_asked_values_are_not_computed_beside_the_events_of_the_only_slot(own):
    with own() as front:
        front.run(what="a")
        front.set(4, k=8)
        front.send_event(Envelope(type="x", parts={"what": "hold"}))
        until(front.started.exists)
        front.send_ask("run", tokens=["told"], revision=4)
        front.ask("running")
        front.send_ask("svg")
        front.receive("answer")
        front.release.touch()
        values = front.receive("answer")[1]
        assert decode(unpack(values[0])).parts["told"] == "held 8", "the event's own values came in time"


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
        assert "annotation allows" in front.receive("parameters_refused")[0]["problems"]["k"]
        front.set(2, k=5)
        assert front.receive("parameters")[0]["revision"] == 2
        front.set(3, k=0)
        assert front.receive("parameters_refused")[0]["revision"] == 3
        assert [front.run(x=1)[1][0].parts["y"] for _ in range(4)] == [5] * 4


# -- asking --------------------------------------------------------------------------------------------------------


def test_before_an_event_the_graph_is_seen_and_no_value(own):
    with own() as front:
        header, (view,) = front.ask("view")
        assert [function.name for function in from_json(json.loads(view)).functions] == ["act", "tell"]
        assert front.ask("svg")[1][0].startswith(b"<svg")
        assert front.ask("preview", token="k", max_side_px=64)[1] == [b"2\nint 2"]
        for ask in ({"what": "preview", "token": "out", "max_side_px": 64}, {"what": "run", "tokens": ["out"]}):
            header, frames = front.ask(**ask)
            assert (header["reason"], frames) == ("not computed", [])
            assert "No event has been completed yet" in header["error"]


def test_a_value_that_cannot_be_sent_is_refused_with_the_reason(shared):
    shared.run(what="object")
    header, _ = shared.ask("run", tokens=["out"])
    assert header["reason"] == "no codec"
    assert shared.values("told").parts["told"].endswith(" 2")


def test_a_function_that_fails_with_new_parameters_is_told_to_who_asked(tmp_path):
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
        header, _ = front.ask("run", tokens=["y"], revision=1)
        assert (header["reason"], header["error"][:26]) == ("failed", "divide: ZeroDivisionError:")
        assert front.ask("run", tokens=["y"], revision=7)[0]["reason"] == "unknown revision"


def test_too_many_questions_are_refused_and_none_is_left_without_answer(own):
    with own() as front:
        front.run(what="zeros")
        asks = [front.send_ask("preview", token="out", max_side_px=16 + number) for number in range(300)]
        answers = [front.receive("answer")[0] for _ in asks]
        assert sorted(answer["ask"] for answer in answers) == asks
        assert {answer.get("reason") for answer in answers} <= {None, "busy"}


# -- how it ends ---------------------------------------------------------------------------------------------------


def test_a_worker_whose_front_goes_ends_at_once_even_while_a_function_computes(own):
    with own() as front:
        front.send_event(Envelope(type="x", parts={"what": "hold"}))
        until(front.started.exists)
        start = time.monotonic()
        front.channel.close()
        assert front.process.wait(TIMEOUT_S) == 3
        assert time.monotonic() - start < TIMEOUT_S / 2


@pytest.mark.parametrize("header", [{"kind": "nonsense"}, {"kind": "event"}])
def test_a_worker_that_is_told_what_it_does_not_know_ends_with_2(own, header):
    with own() as front:
        front.channel.send(header)
        assert front.process.wait(TIMEOUT_S) == 2


def test_a_worker_that_waits_costs_nothing(own):
    with own("--threads", "3") as front:
        front.run(what="a")
        process = psutil.Process(front.process.pid)
        before = process.num_ctx_switches().voluntary, sum(process.cpu_times()[:2])
        threading.Event().wait(1.0)
        assert process.num_ctx_switches().voluntary - before[0] <= 5, "no thread polls"
        assert sum(process.cpu_times()[:2]) - before[1] <= 0.1
