"""What does serving cost: the way through front and worker, and two slots beside two threads by hand?

The limit of the first is the same pipeline between the same sockets in one process. What a process of its own costs is
what lets a function crash, hang or hold the interpreter, and the service go on.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import cv2
import numpy as np

import epypes as ep
from epypes.experiment.graph import OPTIONS, orb_graph, orb_hyperparameters, stereo_pair
from epypes.service import Service
from epypes.wire import Envelope
from tests.benchmarks.orb import _straight
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times
from tests.service.bundles import written_bundle

ANY = "tcp://127.0.0.1:*"
IN_PROCESS = "in one process"
BY_HAND = "hand, 2 threads"
SERVED = "EPypes, threads=2"
CALLS = "Python calls"
FILES = "files"
_EVENTS = 60
_OUTSTANDING = 6


@contextmanager
def _folders() -> Iterator[Path]:
    """Have states and failures of these services stand apart from those of the user's."""
    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="epypes-bench-") as folder:
        os.environ.update(XDG_RUNTIME_DIR=folder, XDG_STATE_HOME=folder)
        try:
            yield Path(folder)
        finally:
            os.environ.clear()
            os.environ.update(before)


def rows(effort: Effort) -> list[Row]:
    with _folders() as folder:
        runner = ep.CompGraphRunner(ep.CompGraph({"half": cv2.pyrDown}, {"half": ("image", "out")}))
        runner.run(image=np.zeros((8, 8), np.uint8))
        small = ep.promote(runner, folder / "half").path
        return [
            _latency(effort, small, "1 kB through a service", np.zeros((32, 32), np.uint8), 300),
            _latency(effort, small, "1 MB through a service", np.zeros((1000, 1000), np.uint8), 150),
            _throughput(effort, folder),
            _calls(effort, folder),
        ]


def _latency(effort: Effort, bundle: Path, name: str, image: np.ndarray, rounds: int) -> Row:
    image.flags.writeable = False
    with ExitStack() as stack:
        contenders = {
            IN_PROCESS: _asking(stack, *_in_process(stack, bundle), {"image": image}),
            OURS: _asking(stack, *_served(stack, bundle), {"image": image}),
        }
        times = effort.measure(contenders, rounds)
    return row(name, times, limit=IN_PROCESS)


def _in_process(stack: ExitStack, bundle: Path) -> tuple[str, str]:
    """Serve a bundle by its pipeline alone; return the addresses for events and answers."""
    q_in, q_out = ep.Mailbox("drop_oldest", 8), ep.Mailbox("drop_oldest", 8)
    publisher = stack.enter_context(ep.ZMQPublisher(ANY, q_out))
    subscriber = stack.enter_context(ep.ZMQSubscriber(ANY, q_in, bind=True))
    stack.enter_context(ep.load_pipeline(bundle, q_in, q_out))
    return subscriber.address, publisher.address


def _served(stack: ExitStack, bundle: Path, **options: Any) -> tuple[str, str]:
    state = stack.enter_context(Service(bundle, **options)).service_state
    return state.sub, state.pub


def _peer(stack: ExitStack, sub: str, pub: str) -> tuple[ep.Mailbox, queue.SimpleQueue[Any]]:
    requests, answers = ep.Mailbox("block", 100), queue.SimpleQueue[Any]()
    subscriber = stack.enter_context(ep.ZMQSubscriber(pub, answers))
    publisher = stack.enter_context(ep.ZMQPublisher(sub, requests, bind=False))
    if not (subscriber.wait_joined(10) and publisher.wait_for_subscriber(10)):
        raise TimeoutError("nobody is there")
    return requests, answers


def _asking(stack: ExitStack, sub: str, pub: str, payload: Mapping[str, Any]) -> Callable[[], Any]:
    requests, answers = _peer(stack, sub, pub)

    def ask() -> Any:
        requests.put(Envelope(type="x", parts=payload))
        return answers.get(timeout=10).parts["out"]

    return ask


def _throughput(effort: Effort, folder: Path) -> Row:
    """Time per pair of images, by two threads of a hand-written loop and by a service with two slots."""
    pair, hparams = stereo_pair(), orb_hyperparameters()
    runner = ep.CompGraphRunner(orb_graph(), hparams)
    expected = runner.run(image_1=pair[0], image_2=pair[1])["keypoints_paired"]
    bundle = ep.promote(runner, folder / "orb", outputs=["keypoints_paired"]).path
    for image in pair:
        image.flags.writeable = False
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(2))
        peer = _peer(stack, *_served(stack, bundle, threads=2, mailbox_size=_OUTSTANDING))
        contenders = {
            BY_HAND: lambda: list(pool.map(lambda _: _straight(*pair), range(_EVENTS)))[-1],
            SERVED: lambda: _through(*peer, pair),
        }
        durations = _in_turn(contenders, 2 if effort.quick else 5, expected)
    note = f"per pair of images, {_EVENTS} in a row; options {', '.join(OPTIONS)}"
    goal = Goal("ratio", 1 / 0.9)
    return row("ORB graph, served by two slots", Times(durations), goal=goal, limit=BY_HAND, ours=SERVED, note=note)


def _through(requests: ep.Mailbox, answers: queue.SimpleQueue[Any], pair: tuple[np.ndarray, np.ndarray]) -> Any:
    """Have pairs of images answered, some of which are always on their way; return the last answer."""
    for number in range(_EVENTS + _OUTSTANDING):
        if number < _EVENTS:
            requests.put(Envelope(type="x", parts={"image_1": pair[0], "image_2": pair[1]}))
        if number >= _OUTSTANDING:
            last = answers.get(timeout=60).parts["keypoints_paired"]
    return last


def _in_turn(
    contenders: Mapping[str, Callable[[], Any]], rounds: int, expected: np.ndarray
) -> dict[str, dict[int, float]]:
    """Return nanoseconds per event by contender and round, after a round that does not count."""
    durations: dict[str, dict[int, float]] = {name: {} for name in contenders}
    for number in range(rounds + 1):
        for name, work in contenders.items():
            start_ns = perf_counter_ns()
            result = work()
            if number:
                durations[name][number] = (perf_counter_ns() - start_ns) / _EVENTS
            if not np.array_equal(result, expected):
                raise ValueError(f"{name} computes something else")
    return durations


_MARK = 255
_COUNTED = """
    import sys

    import cv2


    def half(image):
        counter = sys.modules.get("call_counter")
        if counter is not None and image[0, 0] == 255:
            counter.dump()
        return cv2.pyrDown(image)


    func_dict = {"half": half}
    func_io = {"half": ("image", "out")}
"""


def _calls(effort: Effort, folder: Path) -> Row:
    """Python calls per event in the front and the worker, and how many files they are in."""
    events = 20 if effort.quick else 200
    image = np.zeros((32, 32), np.uint8)
    sample = {"image": image}, {"out": cv2.pyrDown(image)}
    bundle = written_bundle(folder / "counted", _COUNTED, ["image"], ["out"], sample=sample)
    os.environ["CALL_COUNTS"] = str(folder / "calls.json")
    with (
        subprocess.Popen(
            [sys.executable, "-m", "tests.benchmarks.call_counter", "front", str(bundle)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as front,
        ExitStack() as stack,
    ):
        assert front.stdin is not None
        assert front.stdout is not None
        stack.callback(front.stdin.close)
        requests, answers = _peer(stack, *json.loads(front.stdout.readline()))
        before = _marked(front, requests, answers, folder)
        for _ in range(events - 1):
            requests.put(Envelope(type="x", parts={"image": image}))
            answers.get(timeout=60)
        after = _marked(front, requests, answers, folder)
    # What happens now and then, as a heartbeat, is left out: it is in no file that every event passes.
    calls = {file: count / events for file, count in (after - before).items() if count >= events / 2}
    return Row(
        "Python calls per event, front and worker",
        {CALLS: sum(calls.values()), FILES: float(len(calls))},
        goal=Goal("total", 150),
        limit=FILES,
        ours=CALLS,
        note="of one event of 1 kB; at most 150 calls in 20 files",
        unit="count",
    )


def _marked(
    front: subprocess.Popen[str], requests: ep.Mailbox, answers: queue.SimpleQueue[Any], folder: Path
) -> Counter[str]:
    """Return the calls so far, by file, of the front and the worker."""
    requests.put(Envelope(type="x", parts={"image": np.full((32, 32), _MARK, np.uint8)}))
    answers.get(timeout=60)
    assert front.stdin is not None
    assert front.stdout is not None
    front.stdin.write("\n")
    front.stdin.flush()
    return Counter(json.loads(front.stdout.readline())) + Counter(json.loads((folder / "calls.json").read_text()))
