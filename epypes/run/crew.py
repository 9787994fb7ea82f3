"""Which threads help to run functions side by side?"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from contextvars import copy_context
from typing import Final

# A thread that has had nothing to do for so long ends. Starting one takes some 100 us.
_IDLE_S: Final = 10.0


class _Helper:
    """A daemon thread that takes one job after another."""

    def __init__(self) -> None:
        self.jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="epypes helper", daemon=True).start()

    def _work(self) -> None:
        while True:
            try:
                job = self.jobs.get(timeout=_IDLE_S)
            except queue.Empty:
                with _lock:
                    if self in _idle:
                        _idle.remove(self)
                        return
                continue  # a job is on its way
            job()
            del job  # it holds the tokens of a run
            with _lock:
                _idle.append(self)


_lock = threading.Lock()
_idle: list[_Helper] = []


def hand_over(job: Callable[[], None]) -> None:
    """Have a job done on another thread, in the context of this one; it must not raise."""
    with _lock:
        helper = _idle.pop() if _idle else None
    context = copy_context()  # numpy's errstate, for one, belongs to the context
    (helper or _Helper()).jobs.put(lambda: context.run(job))


def _forget_threads() -> None:
    """Begin anew in a forked process, which has none of its parent's threads."""
    global _lock
    _lock = threading.Lock()
    _idle.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)
