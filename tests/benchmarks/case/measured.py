"""How are the case system and hand-written processes asked in turn, and what do they cost meanwhile?"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from epypes.experiment.layouts import LAYOUTS, running
from epypes.experiment.nodes import Settings
from epypes.experiment.results import durations_of
from epypes.experiment.run import Robot
from epypes.wire import attributes
from tests.benchmarks.case.by_hand import ByHand
from tests.benchmarks.timing import Effort

HAND, EPYPES, HAND_THREADS, EPYPES_THREADS = "by hand", "EPypes", "by hand, two threads", "EPypes, workers=2"
# Left out where `make bench` has not installed it.
PUBLISHED, PUBLISHED_FOLDER = "EPypes 0.1.1", Path(sys.prefix, "published")
_ROUNDS, _WARM_ROUNDS, _IDLE_S = 250, 10, 5.0
_QUICK_ROUNDS, _QUICK_IDLE_S = 3, 0.2

Ask = Callable[[], dict[str, float]]


@dataclass
class Contender:
    """A running system: how it is asked, its other processes, and what was measured."""

    ask: Ask
    pids: tuple[int, ...]
    durations: dict[str, dict[int, float]] = field(default_factory=dict)
    cpu_ns: float = 0.0
    idle_cpu_ns: float = 0.0

    def take(self, round_: int | None) -> None:
        """Ask once, and write down what it took unless that was a warm-up."""
        own = time.process_time_ns()
        answer = self.ask()
        if round_ is None:
            return
        self.cpu_ns += time.process_time_ns() - own
        for name, duration in answer.items():
            self.durations.setdefault(name, {})[round_] = duration * 1e9


def measured(effort: Effort) -> Mapping[str, Contender]:
    """Ask all of them in turn, then let all of them rest."""
    rounds, idle_s = (_QUICK_ROUNDS, _QUICK_IDLE_S) if effort.quick else (_ROUNDS, _IDLE_S)
    with ExitStack() as stack:
        contenders = {
            HAND: stack.enter_context(_by_hand(ByHand(1))),
            EPYPES: stack.enter_context(_epypes(1)),
            HAND_THREADS: stack.enter_context(_by_hand(ByHand(2))),
            EPYPES_THREADS: stack.enter_context(_epypes(2)),
        }
        if PUBLISHED_FOLDER.is_dir():
            published = ByHand(str(PUBLISHED_FOLDER), "published_vision")
            contenders[PUBLISHED] = stack.enter_context(_by_hand(published))
        for _ in range(_WARM_ROUNDS):
            for contender in contenders.values():
                contender.take(None)
        _count_cpu(contenders, -1)
        for round_ in range(rounds):
            for contender in contenders.values():
                contender.take(round_)
        _count_cpu(contenders, 1)
        for contender in contenders.values():
            contender.cpu_ns /= rounds
        _rest(contenders, idle_s)
    return contenders


def _count_cpu(contenders: Mapping[str, Contender], sign: int) -> None:
    for contender in contenders.values():
        contender.cpu_ns += sign * sum(map(cpu_ns, contender.pids))


def _rest(contenders: Mapping[str, Contender], idle_s: float) -> None:
    """Measure the CPU time of the busiest idle process of each, per second; ours has the robot in this one."""
    pids = {pid for contender in contenders.values() for pid in contender.pids} | {os.getpid()}
    before = {pid: cpu_ns(pid) for pid in pids}
    threading.Event().wait(idle_s)
    taken = {pid: (cpu_ns(pid) - before[pid]) / idle_s for pid in pids}
    for name, contender in contenders.items():
        own = [taken[os.getpid()]] if name == EPYPES else []
        contender.idle_cpu_ns = max(own + [taken[pid] for pid in contender.pids])


def cpu_ns(pid: int) -> int:
    """Return the CPU time that a process has taken, to the nanosecond: Linux has a clock for each process."""
    return time.clock_gettime_ns(~pid << 3 | 2)


@contextmanager
def _by_hand(system: ByHand) -> Iterator[Contender]:
    with system:

        def ask() -> dict[str, float]:
            t_trip, answer = system.ask()
            return durations_of(t_trip, attributes(answer))

        yield Contender(ask, (system.process.pid,))


@contextmanager
def _epypes(workers: int) -> Iterator[Contender]:
    with running(LAYOUTS["paper"], Settings(workers=workers)) as system:
        robot = Robot(system.requests, system.inbox)

        def ask() -> dict[str, float]:
            answer = robot.ask()
            if answer.failure:
                raise RuntimeError(answer.failure)
            return durations_of(answer.t_trip, answer.attributes)

        yield Contender(ask, tuple(station.pid for station in system.stations))
