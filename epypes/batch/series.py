"""Series: the items of a graph with state run in order, each with the state that the one before it has left."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace

from epypes.batch.items import Item
from epypes.batch.job import Job, Setting, State
from epypes.batch.results import Outcome

# A series and a setting of it, by identity.
Done = tuple[Hashable, int]


@dataclass(slots=True, eq=False)
class _Chain:
    """Runs of one series with some settings: one item at a time.

    Attributes
    ----------
    job
        Has the settings with which each item is run, and the states that the next item begins with.
    waiting
        The items that have not begun.
    pending
        How many outcomes of the item that runs are still to come.
    """

    job: Job
    waiting: deque[Item] = field(default_factory=deque)
    pending: int = 0


class SeriesRuns:
    """What can be run now of several series: iterate over it to get jobs.

    Series, and the parts of the settings, run side by side. Where all items that have come wait for others of their
    series, None is given: report outcomes, then iterate on.

    Parameters
    ----------
    items
        With the keys of their series; taken one by one.
    parts
        A job for each part of the settings, whose item and states are still to be set; parts run side by side.
    state
        What each series begins with.
    room
        How many items are taken ahead at most, for series that are busy.
    done
        The series and settings that are not run, since their outcomes are known: key, ``id(setting)``.
    """

    def __init__(
        self,
        items: Iterable[Item],
        parts: Sequence[Job],
        state: State,
        room: float,
        done: AbstractSet[Done] = frozenset(),
    ) -> None:
        self._items, self._parts, self._state = iter(items), parts, state
        self._room, self._done = room * len(parts), done
        self._chains: dict[Hashable, list[_Chain]] = {}
        self._ready: deque[_Chain] = deque()
        self._waiting = 0
        self._running: dict[tuple[int, int], tuple[_Chain, int]] = {}

    def __iter__(self) -> Iterator[Job | None]:
        is_over = False
        while True:
            while not (self._ready or is_over) and self._waiting < self._room:
                item = next(self._items, None)
                is_over = item is None
                if item is not None:
                    self._take(item)
                del item
            if self._ready:
                yield self._begin(self._ready.popleft())
            elif is_over and not self._waiting:
                return
            else:
                yield None

    def _take(self, item: Item) -> None:
        if item.series not in self._chains:
            chains = self._chains[item.series] = []
            for part in self._parts:
                left = tuple(one for one in part.settings if (item.series, id(one)) not in self._done)
                if left:
                    chains.append(_Chain(replace(part, settings=left, states=(self._state,) * len(left))))
        for chain in self._chains[item.series]:
            chain.waiting.append(item)
            self._waiting += 1
            if not chain.pending and len(chain.waiting) == 1:
                self._ready.append(chain)

    def _begin(self, chain: _Chain) -> Job:
        job = replace(chain.job, item=chain.waiting.popleft())
        self._waiting -= 1
        chain.pending = len(job.settings)
        for place, setting in enumerate(job.settings):
            self._running[job.item.number, id(setting)] = chain, place
        return job

    def settle(self, outcomes: Iterable[Outcome]) -> list[Outcome]:
        """Take what has been run: the next item of its series can begin; return the outcomes without their states."""
        settled = []
        for outcome in outcomes:
            chain, place = self._running.pop((outcome.number, id(outcome.setting)))
            if outcome.state:  # what could not be run at all has left none
                states = chain.job.states
                chain.job = replace(chain.job, states=(*states[:place], outcome.state, *states[place + 1 :]))
            chain.pending -= 1
            if not chain.pending and chain.waiting:
                self._ready.append(chain)
            settled.append(replace(outcome, state={}))
        return settled


def whole_series(
    items: Iterable[Item], settings: Sequence[Setting], found: Callable[[Item], list[Outcome | None]]
) -> tuple[list[Outcome], frozenset[Done]]:
    """Return the outcomes of the series of which all are known, and which these are.

    A series of which some are missing is run from its beginning, since the state amid it is not stored.

    Parameters
    ----------
    items
        With the keys of their series.
    settings
        With which they are run.
    found
        Returns the known outcomes of an item, by setting.
    """
    columns: dict[Done, list[Outcome]] = {}
    missing: set[Done] = set()
    for item in items:
        for setting, outcome in zip(settings, found(item), strict=True):
            key = item.series, id(setting)
            if outcome is None:
                missing.add(key)
                columns.pop(key, None)
            elif key not in missing:
                columns.setdefault(key, []).append(outcome)
    return [outcome for column in columns.values() for outcome in column], frozenset(columns)
