"""What does a function cost in a graph?"""

from __future__ import annotations

from collections.abc import Callable

from tests.benchmarks import by_hand, ours, peers
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort
from tests.benchmarks.work import Work, chain, fan

STRAIGHT = "straight line"
TIMED = "hand, timed"
_ROUNDS = 2000


def rows(effort: Effort) -> list[Row]:
    gathered = fan(50)
    gather = gathered.functions["gather"]
    return [
        _row(
            effort, "chain of 100 trivial functions", chain(100), by_hand.straight_chain(100), by_hand.timed_chain(100)
        ),
        _row(
            effort, "1 -> 50 -> 1 trivial functions", gathered, by_hand.straight_fan(50, gather),
            by_hand.timed_fan(50, gather),
        ),
    ]  # fmt: skip


def _row(effort: Effort, name: str, work: Work, straight: Callable[[], int], timed: Callable[[], int]) -> Row:
    others = {name: peer.run for name, peer in peers.built(effort, work).items()}
    times = effort.measure({STRAIGHT: straight, TIMED: timed, OURS: ours.run(work), **others}, _ROUNDS)
    return row(name, times, functions=len(work.functions), goal=Goal("per function", 450), limit=STRAIGHT)
