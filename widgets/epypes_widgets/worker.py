"""When are new values computed, and on which thread?

A callback of a control must return at once: it may be on the thread that answers the front end. So values go into one
slot of the session, newer ones over older ones, and one thread per panel takes all of them at a time.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from time import monotonic, perf_counter_ns
from typing import Final

from epypes.errors import StillRunning

_LOG: Final = logging.getLogger(__name__)
_IDLE_S: Final = 60.0


class Worker:
    """Computes on a thread of its own when it is asked to; once after any number of times that it was asked.

    Parameters
    ----------
    compute
        Is called on the worker's thread with the time (``perf_counter_ns``) at which it was asked for last.
    failed
        Is called on the worker's thread with what ``compute``, or a function that was put off, has raised.
    name
        Of the thread.

    Notes
    -----
    The thread is a daemon and starts when it is asked for first.
    """

    def __init__(
        self,
        compute: Callable[[int], None],
        failed: Callable[[BaseException], None],
        name: str = "epypes-panel",
    ) -> None:
        self._compute, self._failed, self._name = compute, failed, name
        self._condition = threading.Condition()
        self._is_asked = False
        self._asked_ns = 0
        self._busy = self._is_computing = False
        self._closed = False
        self._put_off: dict[str, tuple[float, Callable[[], None], bool]] = {}
        self._wakes_s = 0.0
        self._thread: threading.Thread | None = None

    @property
    def idle(self) -> bool:
        """Whether everything that was asked for has been computed."""
        return not self._is_asked and not self._is_computing

    @property
    def closed(self) -> bool:
        """Whether ``close`` has been called."""
        return self._closed

    @property
    def is_current(self) -> bool:
        """Whether the thread that asks is the worker's."""
        return threading.current_thread() is self._thread

    def ask(self) -> None:
        """Have everything computed that is wanted now, and return at once; after ``close`` nothing is."""
        with self._condition:
            if self._closed:
                return
            self._is_asked = True
            self._asked_ns = perf_counter_ns()
            self._wake()

    def later(self, key: str, delay_s: float, function: Callable[[], None], *, is_work: bool = False) -> None:
        """Call a function on the worker's thread after a delay, when nothing is to be computed.

        One that was put off under the same key is replaced. ``wait`` waits for those that are work.
        """
        with self._condition:
            if self._closed:
                return
            due_s = monotonic() + delay_s
            self._put_off[key] = (due_s, function, is_work)
            # A thread that is woken takes time from the one that computes, so it is left alone if it wakes by itself.
            if due_s < self._wakes_s or self._thread is None:
                self._wake()

    def wait(self, timeout_s: float) -> None:
        """Return when everything that was asked for has been computed, and the work that was put off is done.

        Raises
        ------
        TimeoutError
            It took longer than ``timeout_s``.
        RuntimeError
            Called on the worker's own thread, which would wait for itself.
        """
        if self.is_current:
            raise RuntimeError("A function of the graph can't wait for the panel that runs it.")
        with self._condition:
            if not self._condition.wait_for(self._is_done, timeout_s):
                raise TimeoutError(f"The panel is still computing after {timeout_s:g} s. Wait longer.")

    def close(self, timeout_s: float) -> None:
        """Drop what waits and end the thread; may be called twice, and from any thread.

        Raises
        ------
        StillRunning
            A function did not return within ``timeout_s``; the thread ends when it does.
        """
        deadline_s = monotonic() + timeout_s
        with self._condition:
            self._closed = True
            self._is_asked = False
            self._put_off.clear()
            self._condition.notify_all()
        thread = self._thread
        if thread is None or self.is_current:
            return
        thread.join(max(0.0, deadline_s - monotonic()))
        if thread.is_alive():
            raise StillRunning(self._name, (), timeout_s)

    def _is_done(self) -> bool:
        return self.idle and not self._busy and not any(is_work for _, _, is_work in self._put_off.values())

    def _wake(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name=self._name, daemon=True)
            self._thread.start()
        self._condition.notify_all()

    def _work(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except BaseException as exception:  # SystemExit in a function, too, must not end the thread
                self._report(exception)

    def _report(self, exception: BaseException) -> None:
        try:
            self._failed(exception)
        except Exception:
            _LOG.exception("A panel could not show that it has failed")

    def _next(self) -> Callable[[], None] | None:
        """Wait for something to do, and return it; None when the worker is closed."""
        with self._condition:
            self._busy = self._is_computing = False
            self._condition.notify_all()
            while not self._closed:
                if self._is_asked:
                    asked_ns = self._asked_ns
                    self._is_asked, self._busy, self._is_computing = False, True, True
                    return lambda: self._compute(asked_ns)
                key = min(self._put_off, key=lambda key: self._put_off[key][0], default=None)
                due_s = math.inf if key is None else self._put_off[key][0]
                wait_s = due_s - monotonic()
                if key is not None and wait_s <= 0:
                    self._busy = True
                    return self._put_off.pop(key)[1]
                self._wakes_s = due_s
                is_told = self._condition.wait(min(wait_s, _IDLE_S))
                self._wakes_s = 0.0
                if key is None and not is_told and not self._is_asked and not self._put_off:
                    break  # a panel that nobody uses keeps no thread; one is started when it is asked again
            self._thread = None
            return None
