"""What does a graph cost beside the paper's ORB graph, one function after the other and two at a time?"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter_ns
from typing import Any

import cv2
import numpy as np
from skimage import data

import epypes as ep
from tests.benchmarks.functions import STRAIGHT, TIMED
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times

THREADS = "hand, 2 threads"
PARALLEL = "EPypes, workers=2"
_ROUNDS = 60
_OPTIONS = ("nfeatures", "scaleFactor", "nlevels", "edgeThreshold", "WTA_K", "scoreType", "patchSize", "fastThreshold")
_ORB = dict(zip(_OPTIONS, (500, 1.2, 8, 31, 2, cv2.ORB_HARRIS_SCORE, 31, 20), strict=True))
_HPARAMS = {**_ORB, "mask_1": None, "mask_2": None, "normType": cv2.NORM_HAMMING, "crossCheck": True}


def detect_and_describe_features(image: np.ndarray, mask: np.ndarray | None, *options: Any) -> tuple[Any, np.ndarray]:
    orb = cv2.ORB_create(**dict(zip(_OPTIONS, options, strict=True)))
    return orb.detectAndCompute(image, mask)


def match(descriptors_1: np.ndarray, descriptors_2: np.ndarray, norm_type: int, cross_check: bool) -> list[Any]:
    matches = cv2.BFMatcher(norm_type, cross_check).match(descriptors_1, descriptors_2)
    return sorted(matches, key=lambda found: found.distance)


def gather_keypoints(keypoints_1: Any, keypoints_2: Any, matches: list[Any]) -> np.ndarray:
    pairs = [(*keypoints_1[found.queryIdx].pt, *keypoints_2[found.trainIdx].pt) for found in matches]
    return np.array(pairs, np.float32).reshape(-1, 4)


def orb_graph() -> ep.CompGraph:
    return ep.CompGraph(
        {
            "detect_and_describe_features_1": detect_and_describe_features,
            "detect_and_describe_features_2": detect_and_describe_features,
            "match": match,
            "gather_keypoints": gather_keypoints,
        },
        {
            "detect_and_describe_features_1": (("image_1", "mask_1", *_OPTIONS), ("keypoints_1", "descriptors_1")),
            "detect_and_describe_features_2": (("image_2", "mask_2", *_OPTIONS), ("keypoints_2", "descriptors_2")),
            "match": (("descriptors_1", "descriptors_2", "normType", "crossCheck"), "matches"),
            "gather_keypoints": (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired"),
        },
    )


def rows(effort: Effort) -> list[Row]:
    left, right, _ = data.stereo_motorcycle()
    pair = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
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


def _parallel(pair: list[np.ndarray]) -> Callable[[], np.ndarray]:
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
