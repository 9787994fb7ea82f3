"""The thread of a panel, and the one place in the kernel where the latest wins: requests, and frames that wait.

A callback of a control must return at once: it may be on the thread that handles the messages of the front end. So a
request goes into a slot under its key and replaces the one that waits there, and one thread works on them in turn.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from math import inf
from operator import attrgetter
from time import monotonic
from typing import Final, NamedTuple

from epypes.errors import StillRunning

_LOG: Final = logging.getLogger(__name__)
_IDLE_S: Final = 60.0


class _Request(NamedTuple):
    """What waits under a key, from when on it may run, and whether ``Worker.wait`` waits for it."""

    key: str
    call: Callable[[], object]
    due_s: float
    is_work: bool


class Worker:
    """Runs requests on a thread of its own, the latest of each key.

    Parameters
    ----------
    name
        Of the thread.
    failed
        Is called on the worker's thread with what a request has raised; without, that is logged.

    Notes
    -----
    The thread is a daemon. It starts at the first request, and ends when there was none for a minute.
    """

    def __init__(self, name: str = "epypes-panel", failed: Callable[[BaseException], None] | None = None) -> None:
        self._name, self._failed = name, failed or self._log
        self._condition = threading.Condition()
        self._closed = False
        self._running: _Request | None = None
        self._waiting: dict[str, _Request] = {}
        # When the thread wakes by itself; 0 while it is awake.
        self._wakes_s = 0.0
        self._thread: threading.Thread | None = None

    @property
    def closed(self) -> bool:
        """Whether ``close`` has been called."""
        return self._closed

    @property
    def is_current(self) -> bool:
        """Whether the calling thread is the worker's."""
        return threading.current_thread() is self._thread

    def is_pending(self, key: str) -> bool:
        """Whether a request of this key waits or runs."""
        running = self._running
        return key in self._waiting or (running is not None and running.key == key)

    def is_superseded(self, key: str) -> bool:
        """Whether a newer request of this key waits for the one that runs, or the worker is closed."""
        return self._closed or key in self._waiting

    def post(self, key: str, request: Callable[[], object], delay_s: float = 0.0, *, is_work: bool = True) -> None:
        """Have a request run after a delay, in place of one that waits under the same key; after ``close`` nothing is.

        Parameters
        ----------
        key
            Requests of other keys are run beside it.
        request
            Is called on the worker's thread.
        delay_s
            Requests without a delay are run first; one with an infinite delay waits for ``hasten``.
        is_work
            Whether ``wait`` waits for it.
        """
        with self._condition:
            if self._closed:
                return
            due_s = monotonic() + delay_s if delay_s else 0.0
            self._waiting[key] = _Request(key, request, due_s, is_work)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name=self._name, daemon=True)
                self._thread.start()
            elif due_s < self._wakes_s:  # to wake the thread for less takes time from a run
                self._condition.notify_all()

    def hasten(self, key: str) -> bool:
        """Have the request that waits under a key run without a further delay; return whether there is one."""
        if key not in self._waiting:
            return False
        with self._condition:
            request = self._waiting.get(key)
            if request is not None:
                self._waiting[key] = request._replace(due_s=0.0)
                if self._wakes_s:
                    self._condition.notify_all()
            return request is not None

    def wait(self, timeout_s: float) -> None:
        """Return when all work has been done.

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
                raise TimeoutError(f"{self._name} is still computing after {timeout_s:g} s. Wait longer.")

    def close(self, timeout_s: float) -> None:
        """Drop what waits and end the thread; may be called twice, and from any thread.

        Raises
        ------
        StillRunning
            A function did not return within ``timeout_s``; the thread ends when it does.
        """
        with self._condition:
            self._closed = True
            self._waiting.clear()
            self._condition.notify_all()
        thread = self._thread
        if thread is None or self.is_current:
            return
        thread.join(max(0.0, timeout_s))
        if thread.is_alive():
            raise StillRunning(self._name, (), timeout_s)

    def _is_done(self) -> bool:
        requests = [*self._waiting.values(), *filter(None, [self._running])]
        return not any(request.is_work for request in requests)

    def _log(self, error: BaseException) -> None:
        _LOG.error("Work on the thread %s has failed", self._name, exc_info=error)

    def _work(self) -> None:
        while (request := self._next()) is not None:
            try:
                request()
            except BaseException as exception:  # SystemExit in a function, too, must not end the thread
                try:
                    self._failed(exception)
                except Exception:
                    _LOG.exception("A panel could not show that it has failed")

    def _next(self) -> Callable[[], object] | None:
        """Wait for the next request, and return it; None when the thread is to end."""
        with self._condition:
            self._running = None
            self._condition.notify_all()
            while not self._closed:
                request = min(self._waiting.values(), key=attrgetter("due_s"), default=None)
                now_s = monotonic()
                if request is not None and request.due_s <= now_s:
                    self._running = request
                    del self._waiting[request.key]
                    return request.call
                self._wakes_s = min(now_s + _IDLE_S, inf if request is None else request.due_s)
                is_notified = self._condition.wait(self._wakes_s - now_s)
                self._wakes_s = 0.0
                if not is_notified and not self._waiting:
                    break
            self._thread = None
            return None
