"""The thread that takes events from a queue, and the settling of events that a broker keeps.

An event that a broker keeps has ``ack``, ``reject`` and ``nack``. They are looked up in its class, so that events can
be anything.
"""

from __future__ import annotations

import atexit
import logging
import math
import queue
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any, Final

from epypes.deprecation import OldNames, takes_old_keywords
from epypes.errors import BrokerError, StillRunning
from epypes.pipeline.pipeline import Pipeline

# How long one take from a queue may block before the stop flag is looked at. Queues that others made can't be
# woken without putting a sentinel into them, which would be an event of theirs.
POLL_S: Final = 0.05
# Of a queue that has been empty for a while: to wake up takes up to 100 us of a core.
LONGEST_POLL_S: Final = 0.25
# How long a wait without an end blocks before signals are looked at.
SIGNAL_POLL_S: Final = 0.25

_log: Final = logging.getLogger("epypes.pipeline")

# Those that have been started; one that runs is kept alive by its thread.
_started: weakref.WeakSet[EventLoop] = weakref.WeakSet()


def log_error(text: str, *parts: object, error: BaseException | None) -> None:
    """Log an error with its traceback, or without, if the exception does not let itself be shown."""
    try:
        _log.error(text, *parts, exc_info=error)
    except BaseException:  # a SystemExit of its __notes__ passes through logging, and would end the thread
        _log.error(f"{text} (its traceback can't be had)", *parts)


def is_kept(event: Any) -> bool:
    """Whether a broker keeps an event until it is acknowledged or rejected."""
    return getattr(type(event), "ack", None) is not None


def settle(event: Any, error: BaseException | None = None, text: str = "") -> None:
    """Acknowledge, reject or return an event that has such methods; raises nothing.

    Parameters
    ----------
    event
        Any object.
    error
        Why it failed; None if it did not. After a BrokerError the outcome is unknown: ``nack`` is called if the event
        has it, and otherwise nothing, so that the broker delivers it again.
    text
        The reason it is rejected with; that of the error without.
    """
    kind = type(event)
    if not is_kept(event):
        return
    if error is None:
        _call(kind.ack, event)
    elif issubclass(type(error), BrokerError):
        if hasattr(kind, "nack"):
            _call(kind.nack, event)
    else:
        reject(event, text or _text_of(error))


def reject(event: Any, reason: str) -> None:
    """Reject an event with a reason, if its class has the method; raises nothing."""
    found = getattr(type(event), "reject", None)
    if found is not None:
        _call(found, event, reason)


def _call(method: Any, event: Any, *reason: str) -> None:
    try:
        method(event, *reason)
    except KeyboardInterrupt:  # the user's, which does not concern the event
        raise
    except BaseException as exception:
        log_error("an event could not be settled", error=exception)


def _text_of(error: BaseException) -> str:
    kind = type(error).__name__
    try:
        return f"{kind}: {error}"
    except BaseException:  # an exception's own __str__ may raise
        return kind


class EventLoop(OldNames):
    """A daemon thread that takes events from a queue and, for each, runs a pipeline or calls a function.

    With a Pipeline it calls ``callback.run(**f_in(event))``, or ``callback.handle(event)`` of one that reacts to events
    itself (SinkPipeline, FullPipeline); with any other function ``callback(**f_in(event))``. Without f_in it calls
    ``callback(event)``.

    Parameters
    ----------
    q_in
        Anything with ``get(timeout=seconds)`` that raises ``queue.Empty``: queue.Queue, queue.SimpleQueue, Mailbox.
    callback
        A Pipeline, or a function; called on the loop's thread. A SinkPipeline or FullPipeline answers the event and
        reports its failures as when it listens itself.
    f_in
        Makes the callback's keyword arguments from an event. Events can be anything, arrays and None included.
        Without it the callback takes the event itself. An event of a broker, whose class has ``ack`` and ``reject``, is
        acknowledged when the callback has returned, and rejected when it raised; after a BrokerError the broker
        delivers it again.
    on_error
        Called with the event and the exception when f_in or the callback raises; logged without one. The loop
        goes on in any case.
    name
        For the thread's name and for errors; a pipeline's own without.

    Notes
    -----
    Semeniuta and Falkman 2019, "Reactive pipelines".
    """

    @takes_old_keywords
    def __init__(
        self,
        q_in: Any,
        callback: Callable[..., Any],
        f_in: Callable[[Any], Mapping[str, Any]] | None = None,
        *,
        on_error: Callable[[Any, BaseException], None] | None = None,
        name: str = "",
    ) -> None:
        self.q_in, self.callback, self.f_in, self.on_error = q_in, callback, f_in, on_error
        self._pipeline = callback if isinstance(callback, Pipeline) else None
        self.name = name or (self._pipeline.name if self._pipeline is not None else "EventLoop")
        self.handled = 0
        self._stop = threading.Event()
        self._draining = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    @property
    def is_running(self) -> bool:
        """Whether the thread is alive."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, timeout_s: float = 0.5) -> None:
        """Start the thread; does nothing while it runs. One that is about to end is waited for.

        Raises
        ------
        StillRunning
            It was stopped, but a function did not return within ``timeout_s``.
        """
        deadline_s = monotonic() + timeout_s
        while not self._is_started():
            ending = self._thread
            # Two threads would take from one queue, and an event could be worked on beside the next.
            if ending is not None:
                ending.join(max(0.0, deadline_s - monotonic()))
                if ending.is_alive():
                    raise StillRunning(self.name, self._busy(), timeout_s)

    def _is_started(self) -> bool:
        """Start the thread, or let it go on; return False if one has been stopped and has not ended."""
        with self._lock:
            thread = self._thread
            if thread is not None and thread.is_alive():
                self._draining.clear()
                if thread is threading.current_thread():
                    self._stop.clear()
                return not self._stop.is_set()
            self._draining.clear()
            self._stop, self._ended = threading.Event(), threading.Event()
            arguments = self._stop, self._ended
            thread = threading.Thread(target=self._loop, args=arguments, name=f"epypes {self.name}", daemon=True)
            thread.start()
            self._thread = thread
            _started.add(self)
            return True

    def stop(self, timeout_s: float = 5.0, *, drain: bool = False) -> None:
        """Stop after the event under way; may be called twice, from any thread, the loop's own included.

        Parameters
        ----------
        timeout_s
            How long it is waited for, in seconds.
        drain
            Whether the events that are in the queue are worked off before; without it they stay there. Those that are
            not worked off within ``timeout_s`` stay there too.

        Raises
        ------
        StillRunning
            The event under way, or the queue, took longer than ``timeout_s``; the functions are named.
        """
        is_late = drain and not self.drain(timeout_s)
        with self._lock:
            thread = self._thread
            is_own = thread is threading.current_thread()
            if not (drain and is_own):  # that ends when its queue is empty
                self._stop.set()
        if thread is None or is_own:
            return
        if not is_late:
            thread.join(timeout_s)
        if is_late or thread.is_alive():
            raise StillRunning(self.name, self._busy(), timeout_s)

    def drain(self, timeout_s: float = 5.0) -> bool:
        """Work off what is in the queue, then stop; return whether that was done within ``timeout_s``."""
        self._draining.set()
        with self._lock:
            thread = self._thread
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until the loop has been stopped and its thread has ended; return whether it has.

        Returns at once for a loop that does not run, and on its own thread.

        Parameters
        ----------
        timeout_s
            How long to wait, in seconds; without it, for as long as it takes. Ctrl-C raises KeyboardInterrupt.
        """
        deadline_s = math.inf if timeout_s is None else monotonic() + timeout_s
        with self._lock:
            thread, ended = self._thread, self._ended
        if thread is None or thread is threading.current_thread():
            return not self.is_running
        # Not Thread.join: before Python 3.13, one that Ctrl-C interrupts takes the thread for ended. And not without a
        # time-out: a signal that comes just before a lock is waited for is seen only when that wait ends.
        while not ended.wait(max(0.0, min(deadline_s - monotonic(), SIGNAL_POLL_S))):
            if monotonic() >= deadline_s:
                return False
        thread.join()
        return not self.is_running

    def _loop(self, stop: threading.Event, ended: threading.Event) -> None:
        try:
            self._take_events(stop)
        finally:
            ended.set()

    def _take_events(self, stop: threading.Event) -> None:
        is_stopped, poll_s, handle = stop.is_set, POLL_S, self._reaction()
        while not is_stopped():
            try:
                event = self.q_in.get(timeout=poll_s)
            except queue.Empty:
                if self._is_drained(stop):
                    return
                poll_s = min(2 * poll_s, LONGEST_POLL_S)
                continue
            except BaseException as exception:  # a queue's SystemExit must not end the thread in silence either
                log_error("%s: the queue itself failed", self.name, error=exception)
                stop.wait(POLL_S)
                continue
            try:
                handle(event)
            except BaseException as exception:  # a function's SystemExit must not end the thread in silence
                self._report(event, exception)
                self._settle(event, exception)
            else:
                if is_kept(event):
                    self._settle(event, None)
            poll_s = POLL_S
            # An event may be large: it shall not live on until another comes.
            del event
            self.handled += 1

    def _reaction(self) -> Callable[[Any], object]:
        """Return what is called with each event."""
        f_in, callback = self.f_in, self.callback
        if self._pipeline is not None:
            return self._pipeline._reaction(f_in)
        return callback if f_in is None else lambda event: callback(**f_in(event))

    def _settle(self, event: Any, exception: BaseException | None) -> None:
        if self._pipeline is None or not self._pipeline._has_settled(event):
            settle(event, exception)

    def _busy(self) -> Sequence[str]:
        return self._pipeline._busy if self._pipeline is not None else ()

    def _is_drained(self, stop: threading.Event) -> bool:
        """Whether the loop ends now that the queue is empty; from then on it counts as stopped."""
        if not self._draining.is_set():
            return False
        with self._lock:
            if self._draining.is_set():
                stop.set()
            return stop.is_set()

    def _report(self, event: Any, exception: BaseException) -> None:
        is_taken = self._pipeline is not None and self._pipeline._take_failure(
            event, exception, is_reported=self.on_error is not None
        )
        if self.on_error is None:
            if is_taken:
                return
            log_error("%s: an event failed", self.name, error=exception)
            return
        try:
            self.on_error(event, exception)
        except BaseException as its_own:
            log_error("%s: on_error itself failed", self.name, error=its_own)

    def __repr__(self) -> str:
        state = "running" if self.is_running else "stopped"
        return f"<EventLoop {self.name!r:.40}: {state}, {self.handled} events>"


def wait(timeout_s: float | None = None) -> bool:
    """Wait until every event loop and listening pipeline of this process has stopped; return whether they have.

    Their threads are daemons, so a program that only starts pipelines would end at once. Ctrl-C stops all of them, each
    after its event under way, and ends the wait.

    Parameters
    ----------
    timeout_s
        How long to wait, in seconds; without it, for as long as it takes.

    Raises
    ------
    StillRunning
        After Ctrl-C: an event under way took longer than five seconds.
    """
    deadline_s = None if timeout_s is None else monotonic() + timeout_s
    try:
        # Those that are started meanwhile count too.
        while running := _running_elsewhere():
            if not running[0].join(None if deadline_s is None else max(0.0, deadline_s - monotonic())):
                return False
    except KeyboardInterrupt:
        running = _running_elsewhere()
        for loop in running:
            loop._stop.set()
        for loop in running:
            loop.stop()
            if loop._pipeline is not None:
                loop._pipeline.stop()  # its nodes too
    return True


def _running_elsewhere() -> list[EventLoop]:
    """Return the loops that run on other threads than this one."""
    here = threading.current_thread()
    return [loop for loop in list(_started) if loop.is_running and loop._thread is not here]


@atexit.register
def _warn_of_running_loops() -> None:
    for loop in list(_started):
        if loop.is_running and not loop._stop.is_set():
            # Logged, since a ResourceWarning is hidden by default, and a program that ends at once should say why.
            _log.warning(
                "%r was left running when the program ended, and has ended with it. To keep the program running, let "
                "it end with ep.wait(). Else call stop(), or use a with statement.",
                loop.name,
            )
