"""What does a map over many images cost beside loops, pools and a cluster written by hand?

Bundles are made and processes are up before it is timed, on both sides; each row is the time per image of 200 crops.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from time import perf_counter_ns

import cv2
import numpy as np
from skimage import data

import epypes as ep
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times

_CROPS = 200
_SIDE_PX = 120
_ROUNDS = 7
_HPARAMS = {"code": cv2.COLOR_BGR2GRAY, "d": 19, "sigma_color": 60, "sigma_space": 8, "lo": 40, "hi": 120}


def by_hand(crop: np.ndarray) -> int:
    """Count edge pixels of a crop; about 5 ms."""
    gray = cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY)
    smooth = cv2.bilateralFilter(cv2.bilateralFilter(gray, 19, 60, 8), 19, 60, 8)
    return cv2.countNonZero(cv2.Canny(smooth, 40, 120))


def graph() -> ep.CompGraph:
    functions = {
        "gray": cv2.cvtColor,
        "smooth": cv2.bilateralFilter,
        "smooth_again": cv2.bilateralFilter,
        "canny": cv2.Canny,
        "count": cv2.countNonZero,
    }
    options = ("d", "sigma_color", "sigma_space")
    return ep.CompGraph(
        functions,
        {
            "gray": (("image", "code"), "image_gray"),
            "smooth": (("image_gray", *options), "smoothed"),
            "smooth_again": (("smoothed", *options), "smooth_twice"),
            "canny": (("smooth_twice", "lo", "hi"), "edges"),
            "count": ("edges", "edge_pixels"),
        },
    )


def crops() -> list[np.ndarray]:
    """Return parts of real photographs, each with memory of its own."""
    photographs = [cv2.cvtColor(image, cv2.COLOR_RGB2BGR) for image in (data.astronaut(), data.coffee(), data.rocket())]
    found = [
        photograph[y : y + _SIDE_PX, x : x + _SIDE_PX].copy()
        for photograph in photographs
        for y in range(0, photograph.shape[0] - _SIDE_PX, 60)
        for x in range(0, photograph.shape[1] - _SIDE_PX, 40)
    ]
    return found[:_CROPS]


def rows(effort: Effort) -> list[Row]:
    images, runner = crops(), ep.CompGraphRunner(graph(), _HPARAMS)
    images = images[: 20 if effort.quick else _CROPS]

    def ours(executor: object = None) -> Callable[[], list[int]]:
        return lambda: [outcome.values["edge_pixels"] for outcome in ep.map(runner, images, executor, progress=False)]

    with ExitStack() as stack:
        # Beside other workers, further threads of OpenCV only take turns.
        stack.callback(cv2.setNumThreads, cv2.getNumThreads())
        cv2.setNumThreads(1)
        threads = stack.enter_context(ThreadPoolExecutor(2))
        processes = stack.enter_context(
            ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), cv2.setNumThreads, (1,))
        )
        found = [
            _row(effort, "one after another", lambda: list(map(by_hand, images)), ours()),
            _row(effort, "2 threads", lambda: list(threads.map(by_hand, images)), ours(threads)),
            _row(effort, "2 processes", lambda: list(processes.map(by_hand, images)), ours(processes)),
        ]
        client = _cluster(stack)
        client.run(cv2.setNumThreads, 1)
        by_client = _row(
            effort,
            "a Dask cluster of 2",
            lambda: client.gather(client.map(by_hand, images, pure=False)),
            ours(client.get_executor()),
        )
    return [*found, by_client]


def _cluster(stack: ExitStack) -> object:
    from distributed import Client, LocalCluster

    options = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    cluster = stack.enter_context(LocalCluster(n_workers=2, threads_per_worker=1, **options))
    return stack.enter_context(Client(cluster))


def _row(effort: Effort, who: str, hand: Callable[[], list[int]], ours: Callable[[], list[int]]) -> Row:
    durations_ns = _in_turn({"by hand": hand, OURS: ours}, 2 if effort.quick else _ROUNDS)
    return row(f"map, {who}", Times(durations_ns), goal=Goal("ratio", 1.1), note=f"per image, {_CROPS} crops")


def _in_turn(contenders: Mapping[str, Callable[[], list[int]]], rounds: int) -> dict[str, dict[int, float]]:
    """Return nanoseconds per image by contender and round, after a round that does not count."""
    durations_ns: dict[str, dict[int, float]] = {name: {} for name in contenders}
    expected = None
    for number in range(rounds + 1):
        # Who comes first finds other caches than who comes second.
        for name, work in sorted(contenders.items(), reverse=bool(number % 2)):
            start_ns = perf_counter_ns()
            result = work()
            taken_ns = perf_counter_ns() - start_ns
            expected = result if expected is None else expected
            if result != expected:
                raise ValueError(f"{name} computes something else")
            if number:
                durations_ns[name][number] = taken_ns / len(result)
    return durations_ns
