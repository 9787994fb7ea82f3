"""The number of items in one job."""

from __future__ import annotations

import numpy as np

from epypes.batch.executors import JobSizes
from epypes.batch.items import Item
from epypes.batch.results import Outcome

_MS = 1_000_000


def items(count, image=None):
    return [Item(number, f"#{number}", {"image": image}) for number in range(count)]


def sizes(batches, *, each_ms):
    found = []
    for batch in batches:
        found.append(len(batch))
        batches.learn(Outcome(item.number, item.name, total_ns=int(each_ms * _MS)) for item in batch)
    return found


def test_quick_items_go_many_at_a_time_and_the_last_ones_few():
    found = sizes(JobSizes(items(1000), 2, 1000), each_ms=1)
    assert sum(found) == 1000
    assert found[0] == 1
    assert max(found) == 50
    assert found == [found[0], *sorted(found[1:], reverse=True)]
    assert found[-1] == 1


def test_slow_items_go_one_by_one():
    assert sizes(JobSizes(items(10), 2), each_ms=80) == [1] * 10


def test_where_nothing_is_handed_out_items_go_one_by_one():
    assert sizes(JobSizes(items(10)), each_ms=1) == [1] * 10


def test_large_images_go_a_few_at_a_time():
    found = sizes(JobSizes(items(20, np.zeros(2_000_000, np.uint8)), 2), each_ms=1)
    assert max(found) == 2


def test_items_that_could_not_be_read_tell_nothing_of_the_others():
    batches = JobSizes(items(100), 2)
    batches.learn([Outcome(0, "#0", total_ns=25 * _MS), *(Outcome(n, f"#{n}") for n in range(1, 50))])
    assert len(next(iter(batches))) == 2
