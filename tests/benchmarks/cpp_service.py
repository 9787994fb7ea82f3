"""What does a service in C++ save: the trip of the experiment, and the slowest of many events?

The paper's reason for C++ is deterministic time, so that the 99th percentile and the worst event count beside the
median. The C++ service is exported from the same bundle and compiled as its README.md says.
"""

from __future__ import annotations

import queue
import shutil
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter_ns, time
from typing import Any

import cv2
import numpy as np

import epypes as ep
from epypes.cpp import export_cpp
from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
from epypes.experiment.layouts import LAYOUTS, ChildStation, running
from epypes.experiment.nodes import REQUEST, T_VREQ, Settings
from epypes.wire import Envelope, Event, add_attribute
from tests.benchmarks.row import Row, row
from tests.benchmarks.service import ANY, _folders, _peer, _served
from tests.benchmarks.timing import Effort

CPP = "C++"
PYTHON = "Python"
_REQUESTS = 500
_EVENTS = 5_000
_WARM_UP = 50
_TIMEOUT_S = 60.0


def missing() -> str:
    """Return what is not installed here; empty if all is."""
    absent = [tool for tool in ("cmake", "g++", "protoc") if shutil.which(tool) is None]
    return f"{', '.join(absent)}: sh .ci/packages" if absent else ""


def rows(effort: Effort) -> list[Row]:
    if missing():
        return []
    with _folders() as folder:
        return [_trip(effort, folder), *_events(effort, folder)]


def _trip(effort: Effort, folder: Path) -> Row:
    """Time requests of the experiment, each node a process of its own; the vision node is in Python or in C++."""
    pair = stereo_pair()
    runner = ep.CompGraphRunner(orb_graph(), orb_hyperparameters())
    runner.run(image_1=pair[0], image_2=pair[1])
    program = _compiled(ep.promote(runner, folder / "orb", outputs=["keypoints_paired"]).path, folder)
    settings, patient = Settings(), Effort(quick=effort.quick, budget_s=60.0)
    with ExitStack() as stack:
        system = stack.enter_context(running(LAYOUTS["three"], settings))
        contenders = {
            PYTHON: _trips(system.requests, system.inbox),
            CPP: _trips(*_with_cpp_vision(stack, program, settings)),
        }
        times = patient.measure(contenders, _REQUESTS, same=False)
    note = "robot to robot; three processes, the ORB graph; OpenCV of Debian in C++, the wheel's in Python"
    return row("trip of a request, vision node in C++", times, limit=PYTHON, ours=CPP, note=note)


def _with_cpp_vision(stack: ExitStack, program: Path, settings: Settings) -> tuple[Any, Any]:
    """Run the experiment with the vision node in C++; return the queue of requests, and that of answers."""
    requests, inbox = ep.Mailbox("drop_oldest", 64), queue.SimpleQueue[Any]()
    publisher = stack.enter_context(ep.ZMQPublisher(ANY, requests))
    acquisition = ChildStation(("acquisition",), settings, inbox.put)
    stack.callback(acquisition.stop)
    pairs = acquisition.start(publisher.address)["answers"]
    _, answers = _started(stack, program, "--sub", f"connect:{pairs}")
    subscriber = stack.enter_context(ep.ZMQSubscriber(answers, inbox))
    if not subscriber.wait_joined(_TIMEOUT_S):
        raise TimeoutError("the service in C++ does not answer")
    # What is published before it has subscribed to the pairs is lost.
    while inbox.empty():
        requests.put(_request())
        try:
            inbox.get(timeout=0.2)
        except queue.Empty:
            continue
        break
    return requests, inbox


def _request() -> Event:
    event = Event(type=REQUEST, id="request")
    add_attribute(event, T_VREQ, time())
    return event


def _trips(requests: Any, inbox: Any) -> Callable[[], object]:
    def ask() -> object:
        requests.put(_request())
        return inbox.get(timeout=_TIMEOUT_S)

    return ask


def _events(effort: Effort, folder: Path) -> list[Row]:
    """Time many events of the edge graph, from the sender and back, and the run of the graph in the service."""
    image = np.random.default_rng(7).integers(0, 256, (480, 640, 3), np.uint8)
    image = cv2.GaussianBlur(image, (9, 9), 0)
    image.flags.writeable = False
    runner = ep.CompGraphRunner(_edge_graph(), {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    runner.run(image=image)
    bundle = ep.promote(runner, folder / "edges", outputs=["edges"]).path
    count = 20 if effort.quick else _EVENTS
    trips: dict[str, list[int]] = {PYTHON: [], CPP: []}
    graphs: dict[str, list[int]] = {PYTHON: [], CPP: []}
    with ExitStack() as stack:
        addresses = {PYTHON: _served(stack, bundle), CPP: _started(stack, _compiled(bundle, folder))}
        peers = {name: _peer(stack, *its) for name, its in addresses.items()}
        for number in range(-_WARM_UP, count):
            for name, (requests, answers) in peers.items():
                start_ns = perf_counter_ns()
                requests.put(Envelope("x", {"image": image}))
                answer = answers.get(timeout=_TIMEOUT_S)
                if number >= 0:
                    trips[name].append(perf_counter_ns() - start_ns)
                    graphs[name].append(answer.attributes["total_ns"])
    note = f"edge graph, 640 x 480; {count} events one after the other"
    return [
        Row(
            f"{work}, {kind}",
            {name: float(np.percentile(taken, percent)) for name, taken in durations.items()},
            limit=PYTHON,
            ours=CPP,
            note=note,
        )
        for work, durations in {"event through a service": trips, "its graph alone": graphs}.items()
        for kind, percent in {"median": 50, "p99": 99, "worst": 100}.items()
    ]


def _edge_graph() -> ep.CompGraph:
    def grayscale(image: Any) -> Any:
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

    def blur(image_gray: Any, blur_kernel: int) -> Any:
        return cv2.GaussianBlur(image_gray, (blur_kernel, blur_kernel), 0)

    def canny(image_blurred: Any, canny_lo: int, canny_hi: int) -> Any:
        return cv2.Canny(image_blurred, canny_lo, canny_hi)

    io = {
        "grayscale": ("image", "image_gray"),
        "blur": (("image_gray", "blur_kernel"), "image_blurred"),
        "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
    }
    return ep.CompGraph({"grayscale": grayscale, "blur": blur, "canny": canny}, io)


def _compiled(bundle: Path, folder: Path) -> Path:
    """Return the program of a bundle's service in C++."""
    project = folder / f"{bundle.name}_cpp"
    by_hand = [each.function for each in export_cpp(bundle, project, service=True).functions if each.is_by_hand]
    if by_hand:
        raise ValueError(f"not translated: {', '.join(by_hand)}")
    build = project / "build"
    for command in (
        ["cmake", "-S", project, "-B", build],
        ["cmake", "--build", build, "--target", f"{bundle.name}_service"],
    ):
        subprocess.run([*map(str, command)], check=True, stdout=subprocess.DEVNULL)
    return build / f"{bundle.name}_service"


def _started(stack: ExitStack, program: Path, *options: str) -> tuple[str, str]:
    """Start a service in C++; return its addresses for events and answers."""
    process = stack.enter_context(subprocess.Popen([str(program), *options], stdout=subprocess.PIPE, text=True))
    stack.callback(process.terminate)
    assert process.stdout is not None
    ready = process.stdout.readline()
    events, answers = ready.partition("events at ")[2].partition(", process")[0].split(", answers at ")
    return events, answers
