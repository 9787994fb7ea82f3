"""The thread that takes events from a queue, and the settling of events that a broker keeps.

An event that a broker keeps has ``ack``, ``reject`` and ``nack``. They are looked up in its class, so that events can
be anything.
"""

from __future__ import annotations

import atexit
import logging
import queue
import threading
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, StillRunning
from epypes.pipeline.pipeline import Pipeline

# How long one take from a queue may block before the stop flag is looked at. Queues that others made can't be
# woken without putting a sentinel into them, which would be an event of theirs.
POLL_S: Final = 0.05
# Of a queue that has been empty for a while: to wake up takes up to 100 us of a core.
LONGEST_POLL_S: Final = 0.25

_log: Final = logging.getLogger("epypes.pipeline")

_left_running: weakref.WeakSet[EventLoop] = weakref.WeakSet()


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


class EventLoop:
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
            self._stop = threading.Event()
            thread = threading.Thread(target=self._loop, args=(self._stop,), name=f"epypes {self.name}", daemon=True)
            thread.start()
            self._thread = thread
            _left_running.add(self)
            return True

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop after the event under way; may be called twice, from any thread, the loop's own included.

        Events that are still in the queue stay there.

        Raises
        ------
        StillRunning
            The event under way took longer than ``timeout_s``; the functions are named.
        """
        with self._lock:
            self._stop.set()
            thread = self._thread
            _left_running.discard(self)
        if thread is None or thread is threading.current_thread():
            return
        thread.join(timeout_s)
        if thread.is_alive():
            raise StillRunning(self.name, self._busy(), timeout_s)

    def drain(self, timeout_s: float = 5.0) -> bool:
        """Work off what is in the queue, then stop; return whether that was done within ``timeout_s``."""
        self._draining.set()
        thread = self._thread
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def _loop(self, stop: threading.Event) -> None:
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
        if self.on_error is None:
            log_error("%s: an event failed", self.name, error=exception)
            return
        try:
            self.on_error(event, exception)
        except BaseException as its_own:
            log_error("%s: on_error itself failed", self.name, error=its_own)

    def __repr__(self) -> str:
        state = "running" if self.is_running else "stopped"
        return f"<EventLoop {self.name!r:.40}: {state}, {self.handled} events>"


@atexit.register
def _warn_of_running_loops() -> None:
    for loop in list(_left_running):
        if loop.is_running:
            warnings.warn(
                f"{loop.name!r} was left running. Call stop(), or use it in a with statement.",
                ResourceWarning,
                stacklevel=1,
                source=loop,
            )
