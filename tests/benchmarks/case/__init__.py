"""What does the paper's case system cost beside hand-written processes, request by request in turn?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times

if TYPE_CHECKING:
    from tests.benchmarks.case.measured import Contender

_PAPER = "the case system"


def rows(effort: Effort) -> list[Row]:
    from tests.benchmarks.case.measured import EPYPES, EPYPES_THREADS, HAND, HAND_THREADS, PUBLISHED, measured

    contenders = measured(effort)
    hand, ours = contenders[HAND], contenders[EPYPES]
    published = {PUBLISHED: contenders[PUBLISHED]} if PUBLISHED in contenders else {}
    pair, threads = {HAND: hand, OURS: ours}, {HAND: contenders[HAND_THREADS], OURS: contenders[EPYPES_THREADS]}
    return [
        row(f"{_PAPER}: trip", _times(pair, "t_trip"), goal=Goal("ratio", 1.03)),
        row(f"{_PAPER}: trip, two at a time", _times(threads, "t_trip"), goal=Goal("ratio", 1.1)),
        row(f"{_PAPER}: o_network", _times(pair, "o_network"), goal=Goal("ratio", 1.2)),
        _mode_row("vision.o_cg", {**pair, **published}, Goal("total", 60_000), "paper 0.3 ms"),
        _mode_row("vision.o_epypes", {**pair, **published}, Goal("ratio", 1.7), "paper 0.02 ms"),
        Row(
            f"{_PAPER}: CPU per request", {name: found.cpu_ns for name, found in pair.items()}, goal=Goal("ratio", 1.05)
        ),
        Row(
            f"{_PAPER}: CPU of one idle second",
            {name: found.idle_cpu_ns for name, found in pair.items()},
            goal=Goal("total", 5_000_000),
            note="the busiest process; paper's own program 92 to 100 % of a core",
        ),
    ]


def _times(contenders: Mapping[str, Contender], column: str) -> Times:
    return Times({name: found.durations[column] for name, found in contenders.items()})


def _mode_row(column: str, contenders: Mapping[str, Contender], goal: Goal, note: str) -> Row:
    from epypes.experiment.results import lognormal_fit

    modes = {name: lognormal_fit(list(found.durations[column].values())).mode for name, found in contenders.items()}
    return Row(f"{_PAPER}: {column}, mode", modes, goal=goal, note=note)
