"""How do functions that don't need each other run side by side, with the outcome of one after another?"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Sequence
from typing import Any

from epypes.run.call import StepFailed, call
from epypes.run.crew import hand_over
from epypes.run.draft import Draft


def execute_side_by_side(draft: Draft, wanted: bytes | None, durations_ns: dict[int, int], workers: int) -> None:
    """Run the dirty steps as ``engine.execute`` does, up to ``workers`` at once; one worker is this thread.

    If functions fail, the one that comes first in run order is the one that failed, as if they had run one after
    another: steps that come before it are run, and those that come after it leave no trace.
    """
    shift = _Shift(draft, wanted, durations_ns, workers)
    shift.work_to_the_end()
    if shift.failed is not None:
        shift.undo_what_comes_after()
        raise shift.failed


class _Shift:
    """What the workers of one run share; the lock is held but for the calls of functions."""

    def __init__(self, draft: Draft, wanted: bytes | None, durations_ns: dict[int, int], workers: int) -> None:
        program, values = draft.program, draft.values
        self.failed: StepFailed | None = None
        self._draft, self._durations_ns, self._free_workers = draft, durations_ns, workers - 1
        self._before = values.copy(), draft.dirty[:]
        self._made: dict[int, Sequence[Any]] = {}
        self._running: set[int] = set()
        self._is_over = False
        self._changed = threading.Condition()
        stale = program.downstream((place for place, dirty in enumerate(draft.dirty) if dirty), values)
        steps = sorted(place for place in stale if wanted is None or wanted[place])
        self._followers: dict[int, list[int]] = {place: [] for place in steps}
        self._waits_for: dict[int, set[int]] = {}
        for place in steps:
            makers = {program.makers[slot] for slot in program.read_by(program.steps[place], values)}
            self._waits_for[place] = makers.intersection(steps)
            for maker in self._waits_for[place]:
                self._followers[maker].append(place)
        self._ready: list[int] = []
        for place in steps:
            if not self._waits_for[place]:
                self._release(place)

    def work_to_the_end(self) -> None:
        """Work, and wait for the others, until nothing is left."""
        with self._changed:
            try:
                self._work()
                while self._running and not self._is_interrupted():
                    self._changed.wait()
                    self._work()
            except BaseException as exception:  # an interrupt while waiting; what the others still make is dropped
                self.failed = StepFailed(min(self._running, default=0), exception, 0)
            self._is_over = True

    def _is_interrupted(self) -> bool:
        """Whether a function was stopped by Ctrl-C or an exit: then nobody waits for the others."""
        return self.failed is not None and not isinstance(self.failed.exception, Exception)

    def undo_what_comes_after(self) -> None:
        """Leave the tokens as if nothing after the failed step had run."""
        if self.failed is None:
            return
        draft, failed_at = self._draft, self.failed.place
        draft.values[:], draft.dirty[:] = self._before
        for place in sorted(self._made):
            if place < failed_at:
                self._store(place)
            else:
                self._durations_ns.pop(place)

    def _help(self) -> None:
        with self._changed:
            self._work()
            self._free_workers += 1

    def _work(self) -> None:
        """Run what is ready, the first in run order first."""
        while not self._is_over and self._ready and not (self.failed and self._ready[0] > self.failed.place):
            place = heapq.heappop(self._ready)
            self._running.add(place)
            for _ in range(min(len(self._ready), self._free_workers)):
                self._free_workers -= 1
                hand_over(self._help)
            self._call(place)

    def _call(self, place: int) -> None:
        program, values = self._draft.program, self._draft.values
        failed: StepFailed | None = None
        made: Sequence[Any] = ()
        duration_ns = 0
        self._changed.release()
        try:
            made, duration_ns = call(program, program.steps[place], values)
        except StepFailed as step_failed:
            failed = step_failed
        finally:
            self._changed.acquire()
        if self._is_over:
            return
        self._running.discard(place)
        if failed is None:
            self._made[place], self._durations_ns[place] = made, duration_ns
            self._store(place)
            self._done(place)
        elif self.failed is None or place < self.failed.place:
            self.failed = failed
        if len(self._ready) > 1 or not self._running:
            self._changed.notify()

    def _store(self, place: int) -> None:
        self._draft.store(self._draft.program.steps[place], self._made[place])

    def _done(self, place: int) -> None:
        """Release what waited for a step alone."""
        for follower in self._followers[place]:
            self._waits_for[follower].discard(place)
            if not self._waits_for[follower]:
                self._release(follower)

    def _release(self, place: int) -> None:
        """Make a step ready; one that is up to date after all is passed over."""
        passed_over = [place]
        while passed_over:
            place = passed_over.pop()
            if self._draft.dirty[place]:
                heapq.heappush(self._ready, place)
                continue
            for follower in self._followers[place]:
                self._waits_for[follower].discard(place)
                if not self._waits_for[follower]:
                    passed_over.append(follower)
