"""What do two workers cost where there is nothing to gain?"""

from __future__ import annotations

from tests.benchmarks import ours
from tests.benchmarks.row import Goal, Row, row
from tests.benchmarks.timing import Effort
from tests.benchmarks.work import Work, chain, fan

ONE, TWO = "EPypes, workers=1", "EPypes, workers=2"
_ROUNDS = 1000


def rows(effort: Effort) -> list[Row]:
    return [
        _row(effort, "workers=2 beside 1: chain of 100", chain(100)),
        _row(effort, "workers=2 beside 1: 1 -> 50 -> 1", fan(50)),
    ]


def _row(effort: Effort, name: str, work: Work) -> Row:
    contenders = {ONE: ours.run(work, workers=1), TWO: ours.run(work, workers=2)}
    times = effort.measure(contenders, _ROUNDS)
    return row(name, times, functions=len(work.functions), goal=Goal("ratio", 1.1), limit=ONE, ours=TWO)
