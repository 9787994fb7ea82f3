"""When are new values computed, and on which thread?

A callback of a control must return at once: it may be on the thread that answers the front end. So values go into one
slot, newer ones over older ones, and one thread per panel takes all of them at a time.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from time import monotonic, perf_counter_ns
from typing import Any, Final

from epypes.errors import StillRunning

_LOG: Final = logging.getLogger(__name__)


class Worker:
    """Computes values on a thread of its own; the latest win, and the last are always computed.

    Parameters
    ----------
    compute
        Is called on the worker's thread with the merged values and the time (``perf_counter_ns``) at which the newest
        of them was submitted. What it raises is logged, and the worker goes on.
    name
        Of the thread.

    Notes
    -----
    The thread is a daemon and starts with the first values.
    """

    def __init__(self, compute: Callable[[Mapping[str, Any], int], None], name: str = "epypes-panel") -> None:
        self._compute = compute
        self._name = name
        self._condition = threading.Condition()
        self._pending: dict[str, Any] | None = None
        self._changed_ns = 0
        self._busy = False
        self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def idle(self) -> bool:
        """Whether everything that was submitted has been computed."""
        return self._pending is None and not self._busy

    @property
    def closed(self) -> bool:
        """Whether ``close`` has been called."""
        return self._closed

    def submit(self, values: Mapping[str, Any]) -> None:
        """Merge values into those that wait, and return at once; after ``close`` they are dropped."""
        with self._condition:
            if self._closed:
                return
            self._pending = {**(self._pending or {}), **values}
            self._changed_ns = perf_counter_ns()
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name=self._name, daemon=True)
                self._thread.start()
            self._condition.notify_all()

    def wait(self, timeout_s: float) -> None:
        """Return when everything that was submitted has been computed.

        Raises
        ------
        TimeoutError
            It took longer than ``timeout_s``.
        RuntimeError
            Called on the worker's own thread, which would wait for itself.
        """
        if threading.current_thread() is self._thread:
            raise RuntimeError("A function of the graph can't wait for the panel that runs it.")
        with self._condition:
            if not self._condition.wait_for(lambda: self.idle, timeout_s):
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
            self._pending = None
            self._condition.notify_all()
        thread = self._thread
        if thread is None or thread is threading.current_thread():
            return
        thread.join(max(0.0, deadline_s - monotonic()))
        if thread.is_alive():
            raise StillRunning(self._name, (), timeout_s)

    def _work(self) -> None:
        while True:
            with self._condition:
                self._busy = False
                self._condition.notify_all()
                self._condition.wait_for(lambda: self._closed or self._pending is not None)
                if self._closed or self._pending is None:
                    return
                values, changed_ns = self._pending, self._changed_ns
                self._pending, self._busy = None, True
            try:
                self._compute(values, changed_ns)
            except BaseException:  # SystemExit in a function, too, must not end the thread that others wait for
                _LOG.exception("The panel could not show %s", ", ".join(values) or "its picture")
