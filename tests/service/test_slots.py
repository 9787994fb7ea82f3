from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import psutil
import pytest

from epypes.wire import Envelope, JustBytes
from tests.service.bundles import written_bundle
from tests.service.workers import ready_worker

pytestmark = pytest.mark.slow

OWN_PIPELINE = """
    import epypes as ep
    from epypes.wire import Envelope, JustBytes, parsed


    def repeat(text, times):
        return text * times


    class {name}(ep.FullPipeline):
{body}


    def f_in(event):
        if isinstance(event, bytes):
            return {{"text": parsed(JustBytes, event).contents.decode()}}
        return event.parts


    def f_out(view):
        if isinstance(view.event, bytes):
            return JustBytes(contents=view["repeated"].encode())
        return Envelope("own", {{"repeated": view["repeated"]}}, correlation_id=view.event.id)


    def make_pipeline(cg, q_in, q_out, f_in, f_out, hparams):
        return {name}("own", cg, q_in, q_out, f_in, f_out, hparams)


    func_dict = {{"repeat": repeat}}
    func_io = {{"repeat": (("text", "times"), "repeated")}}
"""


@pytest.fixture
def owning(tmp_path):
    """Return a function that makes a bundle with a pipeline class of this body."""

    def make(body, name="Own"):
        lines = "\n".join(f"    {line}" for line in body.splitlines())
        source = OWN_PIPELINE.format(name=name, body=lines)
        sample = {"text": "ab"}, {"repeated": "abab"}
        ports = {"inputs": ["text"], "outputs": ["repeated"], "own": ["f_in", "f_out", "make_pipeline"]}
        return written_bundle(tmp_path / "own", source, **ports, hyperparameters={"times": 2}, sample=sample)

    return make


def test_a_bundle_with_ports_of_its_own_answers_2019_messages_in_their_kind(owning, tmp_path):
    with ready_worker(owning("    pass"), tmp_path) as front:
        front.send_event(JustBytes(contents=b"xy").SerializeToString())
        header, (answer,) = front.done()
        assert header["failure"] is None
        assert JustBytes.FromString(answer).contents == b"xyxy"
        front.send_event(b"\xff\xff")
        header, (answer,) = front.done()
        assert header["failure"]["function"] == "f_in"
        assert answer.failure.exception == "MessageError"
        front.set(3, times=1)
        _, (answer,) = front.run(text="z")
        assert (answer.type, answer.parts["repeated"], answer.revision) == ("own", "z", 3)


@pytest.mark.parametrize(("count", "answers"), [(0, []), (3, ["abab0", "abab1", "abab2"])])
def test_a_pipeline_may_answer_an_event_as_often_as_it_likes_and_it_is_done_once(owning, tmp_path, count, answers):
    body = f"""
    def put(self, answer, view):
        for number in range({count}):
            text = answer.parts["repeated"] + (str(number) if {count} > 1 else "")
            super().put(Envelope("own", {{"repeated": text}}), view)
"""
    with ready_worker(owning(body), tmp_path) as front:
        for _ in range(3):
            header, got = front.run(text="ab")
            assert header["failure"] is None
            assert [answer.parts["repeated"] for answer in got] == answers


def test_what_was_put_before_an_event_failed_is_answered_with_the_failure_after_it(owning, tmp_path):
    body = """
    def put(self, answer, view):
        super().put(answer, view)
        if view["text"] == "bad":
            raise ValueError("too late")
"""
    with ready_worker(owning(body), tmp_path) as front:
        header, (first, failure) = front.run(text="bad")
        assert (header["failure"]["function"], header["failure"]["message"]) == ("put", "too late")
        assert (first.parts["repeated"], failure.failure.message) == ("badbad", "too late")
        assert front.run(text="a")[1][0].parts["repeated"] == "aa"


@pytest.mark.parametrize("method", ["handle(self, event)", "emit(self, event, run)", "compute(self, *args)"])
def test_a_hook_that_raises_is_the_failure_of_its_event(owning, tmp_path, method):
    with ready_worker(owning(f"    def {method}:\n        raise SystemExit('own hook')"), tmp_path) as front:
        for _ in range(3):
            header, answers = front.run(text="ab")
            assert header["failure"]["message"] == "own hook"
            assert len(answers) == 1


def test_an_answer_of_a_pipeline_that_goes_on_after_it_is_a_copy(owning, tmp_path):
    body = """
    def put(self, answer, view):
        import numpy as np

        memory = np.zeros(50_000, np.uint8)
        for number in range(3):
            memory[:] = number
            super().put(Envelope("own", {"memory": memory}), view)
"""
    with ready_worker(owning(body), tmp_path) as front:
        _, answers = front.run(text="ab")
        assert [set(answer.parts["memory"]) for answer in answers] == [{0}, {1}, {2}]


def test_an_answer_that_cannot_be_sent_is_the_failure_of_its_event(owning, tmp_path):
    body = """
    def put(self, answer, view):
        super().put(view["text"] if view["text"] != "ok" else answer, view)
"""
    with ready_worker(owning(body), tmp_path) as front:
        header, _ = front.run(text="no")
        assert header["failure"]["function"] == "put"
        assert "not str. Let f_out return one of these" in header["failure"]["message"]
        assert front.run(text="ok")[0]["failure"] is None


def test_parameters_that_a_pipeline_of_its_own_refuses_are_set_in_no_slot(owning, tmp_path):
    body = """
    count = 0

    def __init__(self, *args):
        super().__init__(*args)
        Own.count += 1
        self.number = Own.count

    def set(self, **values):
        super().set(**values)
        if self.number == 3 and values["times"] > 5:
            raise ValueError("the third does not" + 3_000_000 * "!")
"""
    with ready_worker(owning(body), tmp_path, "--threads", "3") as front:
        front.set(1, times=9)
        (problem,) = front.changed()["problems"].values()
        assert problem.startswith("the third does not!")
        assert len(problem) < 10_000
        assert {front.run(text="a")[1][0].parts["repeated"] for _ in range(9)} == {"aa"}
        front.set(2, times=3)
        assert not front.changed()["problems"]
        assert {front.run(text="a")[1][0].parts["repeated"] for _ in range(9)} == {"aaa"}


# -- what a worker keeps -------------------------------------------------------------------------------------------

IMAGES = """
    import ctypes

    import numpy as np


    def invert(image):
        if image.size == 1:
            # What the allocator holds for later is no memory that the worker needs.
            ctypes.CDLL(None).malloc_trim(0)
        if image[0, 0] == 13:
            raise ValueError("unlucky")
        return 255 - image


    func_dict = {"invert": invert}
    func_io = {"invert": ("image", "inverted")}
"""


@pytest.fixture
def inverting(tmp_path):
    image = np.arange(100, dtype=np.uint8).reshape(10, 10)
    sample = {"image": image}, {"inverted": 255 - image}
    return written_bundle(tmp_path / "inverting", IMAGES, ["image"], ["inverted"], sample=sample)


def test_large_images_go_through_a_worker_unchanged_one_after_another(inverting, tmp_path):
    rng = np.random.default_rng(5)
    images = [rng.integers(14, 256, (side, side), np.uint8) for side in (1, 90, 91, 1000, 3000, 90)]
    sums = [hashlib.sha256((255 - image).tobytes()).hexdigest() for image in images]
    with ready_worker(inverting, tmp_path, "--threads", "2") as front:
        expected = {}
        for image, value in zip(images * 3, sums * 3, strict=True):
            expected[front.send_event(Envelope(type="x", parts={"image": image}))] = value
            # A worker reads when a slot is free, and this front does not read while it sends.
            if len(expected) == 2:
                header, (answer,) = front.done()
                assert hashlib.sha256(answer.parts["inverted"].tobytes()).hexdigest() == expected.pop(header["seq"])


def rss(process):
    return process.memory_info().rss


def test_a_thousand_events_leave_nothing_behind(inverting, tmp_path):
    image, bad = np.full((500, 500), 14, np.uint8), np.full((500, 500), 13, np.uint8)
    with ready_worker(inverting, tmp_path) as front:
        process = psutil.Process(front.process.pid)

        def some(count):
            for number in range(count):
                front.run(image=bad if number % 4 == 3 else image)
                if number % 50 == 0:
                    front.query("svg")
                    front.values("image", "inverted")

        some(200)
        before, files = rss(process), process.num_fds()
        some(1_000)
        # Each event has 0.5 MB of images: were one in twenty-five kept, this would be 20 MB.
        assert rss(process) - before < 10_000_000
        assert process.num_fds() == files


def test_a_worker_keeps_no_more_of_large_events_than_the_last_run_of_each_slot(inverting, tmp_path):
    with ready_worker(inverting, tmp_path) as front:
        process = psutil.Process(front.process.pid)
        before = rss(process)
        for _ in range(8):
            front.run(image=np.full((5000, 4000), 14, np.uint8))
            front.query("svg")
        # An event and its run are 40 MB; the run before it is there until the next one has ended.
        largest = rss(process)
        assert largest - before < 120_000_000
        for _ in range(3):
            front.run(image=np.full((1, 1), 14, np.uint8))
        assert largest - rss(process) > 60_000_000


def test_a_page_that_asks_all_the_time_has_each_picture_made_once_per_run(inverting, tmp_path):
    with ready_worker(inverting, tmp_path) as front:
        front.run(image=np.full((2000, 2000), 14, np.uint8))
        process = psutil.Process(front.process.pid)
        for what, more in (("svg", {}), ("view", {}), ("preview", {"token": "inverted", "max_side_px": 512})):
            first = front.query(what, **more)[1]
            before = sum(process.cpu_times()[:2])
            assert all(front.query(what, **more)[1] == first for _ in range(100))
            assert sum(process.cpu_times()[:2]) - before < 0.2
    assert Path(front.stderr).read_text() == ""


def test_a_pipeline_that_takes_events_in_a_way_of_its_own_is_served_too(owning, tmp_path):
    body = """
    def listen(self, timeout_s=0.5):
        import queue
        import threading
        import time

        def take():
            while True:
                try:
                    event = self.q_in.get_nowait() if hasattr(self.q_in, "get_nowait") else self.q_in.get(block=False)
                except queue.Empty:
                    time.sleep(0.002)
                    continue
                self.handle(event)

        threading.Thread(target=take, daemon=True).start()
"""
    with ready_worker(owning(body), tmp_path) as front:
        for text in ("a", "b"):
            assert front.run(text=text)[1][0].parts["repeated"] == text * 2
        front.set(1, times=3)
        assert front.run(text="c")[1][0].parts["repeated"] == "ccc"
        assert front.end() == 0
