"""What does a graph cost beside the paper's ORB graph, one function after the other and two at a time?"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter_ns

import cv2
import numpy as np

import epypes as ep
from epypes.experiment.graph import (
    OPTIONS,
    detect_and_describe_features,
    gather_keypoints,
    match,
    orb_graph,
    orb_hyperparameters,
    stereo_pair,
)
from tests.benchmarks.functions import STRAIGHT, TIMED
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times

THREADS = "hand, 2 threads"
PARALLEL = "EPypes, workers=2"
_ROUNDS = 60
_HPARAMS = orb_hyperparameters()
_ORB = {name: _HPARAMS[name] for name in OPTIONS}


def rows(effort: Effort) -> list[Row]:
    pair = stereo_pair()
    runner, graph_ns, hand_ns = ep.CompGraphRunner(orb_graph(), _HPARAMS), [], []

    def graph() -> np.ndarray:
        run = runner.run(image_1=pair[0], image_2=pair[1])
        graph_ns.append(run.report.overhead_ns)
        return run["keypoints_paired"]

    contenders = {STRAIGHT: lambda: _straight(*pair), TIMED: lambda: _timed(*pair, hand_ns), OURS: graph}
    with ThreadPoolExecutor(2) as pool:
        contenders[THREADS] = lambda: _in_threads(*pair, pool)
        contenders[PARALLEL] = _parallel(pair)
        times = effort.measure(contenders, _ROUNDS)
    overheads = Times({TIMED: _of_rounds(hand_ns, times, TIMED), OURS: _of_rounds(graph_ns, times, OURS)})
    return [
        row("ORB graph, one after the other", times, functions=4, limit=STRAIGHT),
        row("ORB graph, overhead reported", overheads, functions=4, goal=Goal("total", 20_000), limit=TIMED),
        _parallel_row(times),
    ]


def _of_rounds(overheads_ns: list[int], times: Times, name: str) -> dict[int, float]:
    """Return the overheads by round, without the warm-up's, which came first."""
    taken = times.durations_ns[name]
    return dict(zip(taken, overheads_ns[-len(taken) :], strict=True))


def _parallel(pair: tuple[np.ndarray, np.ndarray]) -> Callable[[], np.ndarray]:
    runner = ep.CompGraphRunner(orb_graph(), _HPARAMS, workers=2)
    return lambda: runner.run(image_1=pair[0], image_2=pair[1])["keypoints_paired"]


def _parallel_row(times: Times) -> Row:
    name, goal = "ORB graph, two at a time", Goal("ratio", 1.1)
    saved = times.medians_ns[THREADS] / times.medians_ns[STRAIGHT]
    note = f"limit: two threads by hand, {saved:.2f} of the straight line"
    return row(name, times, functions=4, goal=goal, limit=THREADS, ours=PARALLEL, note=note)


def _straight(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    keypoints_1, descriptors_1 = detect_and_describe_features(left, None, *_ORB.values())
    keypoints_2, descriptors_2 = detect_and_describe_features(right, None, *_ORB.values())
    matches = match(descriptors_1, descriptors_2, cv2.NORM_HAMMING, True)
    return gather_keypoints(keypoints_1, keypoints_2, matches)


def _timed(left: np.ndarray, right: np.ndarray, overheads_ns: list[int]) -> np.ndarray:
    """Do the same with a clock at every function; note the time that no function took."""
    durations_ns = []
    begin_ns = start_ns = perf_counter_ns()
    keypoints_1, descriptors_1 = detect_and_describe_features(left, None, *_ORB.values())
    durations_ns.append(perf_counter_ns() - start_ns)
    start_ns = perf_counter_ns()
    keypoints_2, descriptors_2 = detect_and_describe_features(right, None, *_ORB.values())
    durations_ns.append(perf_counter_ns() - start_ns)
    start_ns = perf_counter_ns()
    matches = match(descriptors_1, descriptors_2, cv2.NORM_HAMMING, True)
    durations_ns.append(perf_counter_ns() - start_ns)
    start_ns = perf_counter_ns()
    paired = gather_keypoints(keypoints_1, keypoints_2, matches)
    durations_ns.append(perf_counter_ns() - start_ns)
    overheads_ns.append(perf_counter_ns() - begin_ns - sum(durations_ns))
    return paired


def _in_threads(left: np.ndarray, right: np.ndarray, pool: ThreadPoolExecutor) -> np.ndarray:
    first = pool.submit(detect_and_describe_features, left, None, *_ORB.values())
    second = pool.submit(detect_and_describe_features, right, None, *_ORB.values())
    (keypoints_1, descriptors_1), (keypoints_2, descriptors_2) = first.result(), second.result()
    matches = match(descriptors_1, descriptors_2, cv2.NORM_HAMMING, True)
    return gather_keypoints(keypoints_1, keypoints_2, matches)
