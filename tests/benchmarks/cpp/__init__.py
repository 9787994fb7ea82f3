"""What does the graph cost in C++, and how long does its slowest event take, beside Python?"""

from __future__ import annotations

import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter_ns
from typing import IO

import cv2
import numpy as np
from skimage import data

import epypes as ep
from tests.benchmarks import ours
from tests.benchmarks.row import Row
from tests.benchmarks.timing import Effort
from tests.benchmarks.work import edge_graph

PYTHON, CPP = "Python", "C++"
_SIZES = ((64, 64), (640, 480))
_EVENTS = 5_000
# Blocks of both alternate, so that the machine's moods hit both.
_BLOCKS = 10
_WARM = 50

# By event: how long the run took, and the graph's overhead.
Taken = list[tuple[float, float]]


def rows(effort: Effort) -> list[Row]:
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        events = _events_program(Path(scratch))
        for width, height in _SIZES:
            photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
            image = np.ascontiguousarray(cv2.resize(photograph, (width, height)))
            path = Path(scratch) / f"{width}.png"
            cv2.imwrite(str(path), image)
            found += _rows(effort, events, image, path)
    return found


def _events_program(scratch: Path) -> Path:
    """Export the edge graph, compile it, and return the program that runs it."""
    runner = ours.runner(edge_graph(np.zeros((64, 64, 3), np.uint8)))
    runner.run(image=cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR))
    ep.promote(runner, scratch / "edges")
    project = ep.export_cpp(scratch / "edges", scratch / "project").path
    build = scratch / "build"
    configure = [
        "cmake",
        "-S",
        Path(__file__).parent,
        "-B",
        build,
        f"-DPROJECT={project}",
        "-DCMAKE_BUILD_TYPE=Release",
    ]
    for command in (configure, ["cmake", "--build", build, "--target", "events"]):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return build / "events"


def _rows(effort: Effort, events: Path, image: np.ndarray, path: Path) -> list[Row]:
    runner = ours.runner(edge_graph(image))
    blocks, size = (2, 20) if effort.quick else (_BLOCKS, _EVENTS // _BLOCKS)
    taken: dict[str, Taken] = {PYTHON: [], CPP: []}
    with ExitStack() as stack:
        process = stack.enter_context(
            subprocess.Popen([events, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        )
        assert process.stdin is not None
        stack.callback(process.stdin.close)
        _in_cpp(process, _WARM)
        _in_python(runner, image, _WARM)
        for _ in range(blocks):
            (python, count), (cpp, same) = _in_python(runner, image, size), _in_cpp(process, size)
            if count != same:
                raise AssertionError(f"{count} pixels are edges in Python, and {same} in C++.")
            taken[PYTHON] += python
            taken[CPP] += cpp
    overheads = {name: [overhead for _, overhead in each] for name, each in taken.items()}
    runs = {name: [run for run, _ in each] for name, each in taken.items()}
    name = f"{image.shape[1]} x {image.shape[0]}"
    events_text = f"{blocks * size:,} events in this process and in one of C++"
    return [
        _row(
            f"graph overhead per event, {name}",
            overheads,
            50,
            f"o_cg, the run less its functions: median of {events_text}",
        ),
        _row(f"an event of the edge graph, {name}: median", runs, 50, events_text),
        _row(f"an event of the edge graph, {name}: p99", runs, 99, events_text),
        _row(f"an event of the edge graph, {name}: the worst", runs, 100, events_text),
    ]


def _row(work: str, taken: dict[str, list[float]], percentile: float, note: str) -> Row:
    return Row(
        work,
        {name: float(np.percentile(each, percentile)) for name, each in taken.items()},
        limit=PYTHON,
        ours=CPP,
        note=note,
    )


def _in_python(runner: ep.CompGraphRunner, image: np.ndarray, count: int) -> tuple[Taken, int]:
    """Run the graph, and return the times of its events and how many pixels are edges in the last."""
    taken: Taken = []
    for _ in range(count):
        begin = perf_counter_ns()
        run = runner.run(image=image)
        end = perf_counter_ns()
        taken.append((end - begin, run.report.overhead_ns))
    return taken, cv2.countNonZero(run["edges"])


def _in_cpp(process: subprocess.Popen[str], count: int) -> tuple[Taken, int]:
    requests, answers = process.stdin, process.stdout
    assert requests is not None
    assert answers is not None
    requests.write(f"{count}\n")
    requests.flush()
    return [_pair(answers) for _ in range(count)], int(answers.readline())


def _pair(answers: IO[str]) -> tuple[float, float]:
    run, overhead = answers.readline().split()
    return float(run), float(overhead)
