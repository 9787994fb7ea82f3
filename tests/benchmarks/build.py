"""What does building a graph cost, up to the first result?"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import partial

import epypes as ep
from tests.benchmarks import by_hand, ours, peers
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times
from tests.benchmarks.work import chain

_ROUNDS = 50
_DEEP = 20_000
_ALL_PEERS = tuple(peer.name for peer in peers.ALL)


def rows(effort: Effort) -> list[Row]:
    small = _times(effort, 200)
    thousand = _times(effort, 1_000, without=("pipefunc",))
    large = _times(effort, 10_000, without=_ALL_PEERS)
    title = "build and first result, {:,} functions".format
    deep = "pipefunc needs 30 s; recursion limit raised for Hamilton"
    return [
        row(title(200), small, functions=200),
        row(title(1_000), thousand, functions=1_000, note="" if effort.quick else deep),
        row(title(10_000), large, functions=10_000, goal=Goal("ratio", 4)),
        _linearity(thousand, large),
        _union(effort),
    ]


def _times(effort: Effort, count: int, without: Collection[str] = ()) -> Times:
    work = chain(count)
    others = {peer.name: peer(work).first_result for peer in peers.present(effort, without)}
    contenders = {
        "by hand": partial(by_hand.first_result, work),
        OURS: partial(ours.first_result, work),
        **others,
    }
    with _recursion_limit(_DEEP):
        return effort.measure(contenders, _ROUNDS)


@contextmanager
def _recursion_limit(limit: int) -> Iterator[None]:
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(limit)
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


def _linearity(thousand: Times, large: Times) -> Row:
    """Compare the cost of a function in a large and in a small graph."""
    few = {f"{name} at 1,000": thousand.medians_ns[name] / 1_000 for name in ("by hand", OURS)}
    many = {f"{name} at 10,000": large.medians_ns[name] / 10_000 for name in ("by hand", OURS)}
    by_hand_grows = many["by hand at 10,000"] / few["by hand at 1,000"]
    return Row(
        "building, per function: 1,000 and 10,000",
        {**few, **many},
        limit=f"{OURS} at 1,000",
        ours=f"{OURS} at 10,000",
        note=f"limit: EPypes at 1,000; by hand {by_hand_grows:.2f} times",
    )


def _union(effort: Effort) -> Row:
    name, goal = "union of two graphs of 1,000 functions", Goal("ratio", 2)
    first, second = chain(1_000), chain(1_000, prefix="other_")
    one, other = (ep.CompGraph(work.functions, work.io) for work in (first, second))
    contenders = {
        "by hand": lambda: ep.CompGraph({**first.functions, **second.functions}, {**first.io, **second.io}).sink_tokens,
        OURS: lambda: ep.union(one, other).sink_tokens,
    }
    return row(name, effort.measure(contenders, _ROUNDS), functions=2_000, goal=goal)
