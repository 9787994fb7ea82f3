"""Who writes, so that whoever has something to keep waits for no disk and no database?

One thread, which begins with the first thing that waits and ends when nothing does. What waits, and when it is due, is
decided by what is handed in: failures of a service by cause, rows of a series in a line.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from time import monotonic
from typing import Any, Final, Protocol, TypeVar

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# While somebody waits for it, what failed is tried again so often.
_FLUSHING_S: Final = 0.1


class Waiting(Protocol):
    """What waits to be written. Not for threads: the writer holds its lock. Times are in seconds."""

    def __len__(self) -> int: ...

    def take(self, now_s: float, *, at_once: bool = False) -> Any:
        """Return what is to be written now, None if nothing is; ``at_once`` does not wait until it is due."""

    def due_in_s(self, now_s: float) -> float | None:
        """Return in how many seconds the next is to be written; None if nothing waits."""


class Writer:
    """Writes what waits on a thread of its own.

    Parameters
    ----------
    name
        Of the thread.
    waiting
        What waits.
    write
        Called on the thread with what was taken. What it raises is logged, and the next is written.
    begin
        Called on the thread when it begins.
    """

    def __init__(
        self, name: str, waiting: Waiting, write: Callable[[Any], object], begin: Callable[[], object] = lambda: None
    ) -> None:
        self._name, self._waiting, self._write, self._begin = name, waiting, write, begin
        self._turn = threading.Condition()
        self._is_writing, self._is_flushing = False, 0
        self._thread: threading.Thread | None = None

    def put(self, change: Callable[[float], _T]) -> _T:
        """Change what waits, and have it written; return at once what the change returns.

        Parameters
        ----------
        change
            Called with the time, while no other changes it.
        """
        with self._turn:
            found = change(monotonic())
            self._start()
            self._turn.notify_all()
        return found

    def _start(self) -> None:
        if self._thread is None and self._waiting:
            thread = threading.Thread(target=self._write_all, name=self._name, daemon=True)
            try:
                thread.start()
            except RuntimeError:
                # No more threads, or the interpreter ends: it waits for the next that is put.
                return
            self._thread = thread

    def flush(self, timeout_s: float = 5.0) -> bool:
        """Have all that waits written now; return whether that was done in time."""
        with self._turn:
            self._is_flushing += 1
            self._start()
            self._turn.notify_all()
            try:
                return self._turn.wait_for(lambda: not self._waiting and not self._is_writing, timeout_s)
            finally:
                self._is_flushing -= 1

    def _write_all(self) -> None:
        self._begin()
        while (found := self._next()) is not None:
            try:
                self._write(found)
            except Exception:  # the next must be written, whatever was wrong with this one
                _log.exception("%s could not write", self._name)
            finally:
                # So that its memory is given back while the next is waited for.
                found = None
                with self._turn:
                    self._is_writing = False
                    self._turn.notify_all()

    def _next(self) -> Any:
        """Return what is to be written, once it is due; None if nothing waits any more."""
        with self._turn:
            while (due_in_s := self._waiting.due_in_s(monotonic())) is not None:
                found = self._waiting.take(monotonic(), at_once=self._is_flushing > 0)
                if found is not None:
                    self._is_writing = True
                    return found
                self._turn.wait(min(due_in_s, _FLUSHING_S) if self._is_flushing else due_in_s)
            self._thread = None
            return None
