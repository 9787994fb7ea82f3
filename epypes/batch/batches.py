"""How many items make one job, so that handing it out costs little beside doing it?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

from epypes.batch.items import Item
from epypes.batch.outcome import Outcome

# As long a job takes, about: long beside the millisecond of its way, short beside a person's patience and the last
# job's, for which all others wait.
_JOB_NS: Final = 50_000_000
_MOST_ITEMS: Final = 64
# What is left is divided into so many groups per worker.
_LAST_JOBS: Final = 3
# Of arrays that wait in memory, in one job.
_MOST_BYTES: Final = 4_000_000
# One more outcome changes what is expected by so much.
_SHARE: Final = 0.2


class Batches:
    """Groups of items; the time that items take decides how many are in the next one.

    Parameters
    ----------
    items
        Taken one by one, when a group is asked for.
    workers
        How many work at once; 0: each group has one item only.
    total
        How many items there are, if that is known: the last groups are smaller, so that all workers end together.
    """

    def __init__(self, items: Iterable[Item], workers: int = 0, total: int | None = None) -> None:
        self._items, self._workers, self._total = iter(items), workers, total
        self._item_ns, self._taken = 0.0, 0

    def learn(self, outcomes: Iterable[Outcome]) -> None:
        """Take note of how long items took; those that could not be read tell nothing."""
        for took_ns in (outcome.total_ns for outcome in outcomes if outcome.total_ns):
            self._item_ns = self._item_ns + _SHARE * (took_ns - self._item_ns) if self._item_ns else took_ns

    def __iter__(self) -> Iterator[tuple[Item, ...]]:
        while batch := self._next():
            yield tuple(batch)
            # The items are in memory as long as somebody holds them.
            del batch

    def _next(self) -> list[Item]:
        batch: list[Item] = []
        most, size = self._most(), 0
        while len(batch) < most and size < _MOST_BYTES:
            item = next(self._items, None)
            if item is None:
                break
            batch.append(item)
            self._taken += 1
            size += _bytes_of(item.payload.values())
        return batch

    def _most(self) -> int:
        if not self._workers or not self._item_ns:
            return 1
        most = min(_MOST_ITEMS, int(_JOB_NS / self._item_ns))
        if self._total is not None:
            most = min(most, (self._total - self._taken) // (_LAST_JOBS * self._workers))
        return max(1, most)


def _bytes_of(values: Iterable[Any]) -> int:
    return sum(size for value in values if isinstance(size := getattr(value, "nbytes", 0), int))
