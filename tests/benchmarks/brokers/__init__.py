"""What does a message cost that a broker carries, beside the broker's own client used by hand?

Both sides do the same: an event is put into a work queue and confirmed; a replica, a process of its own, takes it,
answers with what came, has the answer confirmed, and only then acknowledges the event; events and answers have an id.
By hand that is one thread, or one event loop; our replica is a pipeline between a subscriber and a publisher. Who asks
is a program of one thread on both sides, ours by the three methods of a channel; what it costs to ask through a
publisher and a subscriber of one's own, whose queues take a switch of threads, is shown beside it. ZeroMQ has no
broker: nobody keeps, confirms or shares, so its limit is a bare loop over two sockets, and no goal is set there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from time import perf_counter_ns

import numpy as np

from tests.benchmarks.brokers import ours, over_channels, served, venues
from tests.benchmarks.brokers.parties import Asker, Meeting, replicas
from tests.benchmarks.brokers.venues import Venue
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times

HAND = "by hand"
_GOALS: Mapping[str, Goal] = {"1 kB": Goal("ratio", 2.0), "1 MB": Goal("ratio", 1.25)}
_TRIPS = 300
_ROUNDS = 9
# By name: a side of the square image of bytes, and how many of them are one round.
_SIZES: Mapping[str, tuple[int, int]] = {"1 kB": (32, 300), "1 MB": (1000, 50)}
_FEW, _WARM = 12, 60

Place = Callable[[str], tuple[Meeting, Meeting]]


def rows(effort: Effort, present: Sequence[Venue] | None = None) -> list[Row]:
    """Measure all that are installed."""
    found: list[Row] = []
    for venue in venues.present() if present is None else present:
        with venue.opened() as place:
            for count in venue.replicas[:1] if effort.quick else venue.replicas:
                found += _pipelines(effort, venue, place, count)
            if venue.is_brokered:
                found += _services(effort, venue, place, venue.replicas[0 if effort.quick else -1])
    return found


def _pipelines(effort: Effort, venue: Venue, place: Place, count: int) -> list[Row]:
    """Measure pipelines in code: the same bytes as by hand, and envelopes with an array."""
    by_hand, own = place(f"bench{count}")
    who = f"{venue.name}, {_counted(count)}"
    with _by_hand(venue, by_hand, count) as hand, replicas(ours, own, count):
        found: list[Row] = []
        if venue.is_brokered:
            with closing(over_channels.Asker(own, count)) as asker:
                found += _rows(effort, who, hand, asker, _GOALS)
            if count > 1:
                return found
            who += ", queues at both ends"
        with closing(ours.TwinsAsker(own, count)) as asker:
            found += _rows(effort, who, hand, asker, {})
            if count == 1:
                asker.is_plain = False
                found += [_trip(effort, f"{who}, an array of {size}", size, hand, asker, None) for size in _SIZES]
    return found


def _services(effort: Effort, venue: Venue, place: Place, count: int) -> list[Row]:
    """Measure `epypes serve`, which computes the half of an image, so that its answers are a quarter of the size."""
    by_hand, own = place("served")
    who = f"{venue.name}, {_counted(count)} of epypes serve"
    with (
        _by_hand(venue, by_hand, count) as hand,
        served.services(own, count),
        closing(ours.TwinsAsker(own, count)) as asker,
    ):
        asker.is_plain = False
        return [
            _trip(effort, f"{who}, an array of 1 kB", "1 kB", hand, asker, None),
            _rate(effort, f"{who}, an array of 1 kB", "1 kB", hand, asker, None),
        ]


def _counted(count: int) -> str:
    return f"{count} replica{'s' * (count > 1)}"


@contextmanager
def _by_hand(venue: Venue, meeting: Meeting, count: int) -> Iterator[Asker]:
    venue.by_hand.prepare(meeting)
    with ExitStack() as stack:
        stack.enter_context(replicas(venue.by_hand, meeting, count))
        asker = venue.by_hand.Asker(meeting, count)
        stack.callback(asker.close)
        yield asker


def _rows(effort: Effort, who: str, hand: Asker, asker: Asker, goals: Mapping[str, Goal]) -> Iterator[Row]:
    for size in _SIZES:
        yield _trip(effort, f"{who}, {size}", size, hand, asker, goals.get(size))
        yield _rate(effort, f"{who}, {size}", size, hand, asker, goals.get(size))


def _image(size: str) -> np.ndarray:
    side_px = _SIZES[size][0]
    image = np.zeros((side_px, side_px), np.uint8)
    # As what a function returns is: nobody can change it, so that it can be sent without a copy.
    image.flags.writeable = False
    return image


def _trip(effort: Effort, work: str, size: str, hand: Asker, asker: Asker, goal: Goal | None) -> Row:
    """Measure from when an event is sent until its answer has come, one after the other."""
    image = _image(size)
    for each in (hand, asker):
        # So that every replica has had its first, which is slow.
        each.ask_many(image, _FEW if effort.quick else _WARM)
    contenders = {HAND: lambda: hand.ask(image), OURS: lambda: asker.ask(image)}
    return row(f"{work}: trip", effort.measure(contenders, _TRIPS, same=False), goal=goal)


def _rate(effort: Effort, work: str, size: str, hand: Asker, asker: Asker, goal: Goal | None) -> Row:
    """Measure how long an event takes when many are on their way, sent by as many as there are replicas."""
    image, count = _image(size), _FEW if effort.quick else _SIZES[size][1]
    contenders = {HAND: hand.ask_many, OURS: asker.ask_many}
    times = Times({name: {} for name in contenders})
    # The first round does not count.
    for index in range(-1, 2 if effort.quick else _ROUNDS):
        # Who comes first finds other caches than who comes second.
        for name, ask_many in sorted(contenders.items(), reverse=bool(index % 2)):
            start_ns = perf_counter_ns()
            ask_many(image, count)
            if index >= 0:
                times.durations_ns[name][index] = (perf_counter_ns() - start_ns) / count
    rates = {name: 1e9 / taken_ns for name, taken_ns in times.medians_ns.items()}
    note = f"{rates[OURS]:,.0f} events a second; by hand {rates[HAND]:,.0f}"
    return row(f"{work}: time per event", times, goal=goal, note=note)
