"""The state of a service, computed from facts in one place, and what changes it: pause, drain, resume, stop.

There are no transitions that could be missed: whenever a fact may have changed, `Lifecycle.check` computes the state
anew and notifies listeners if it differs.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final, Literal

from epypes.errors import EpypesError
from epypes.service.dispatcher import Dispatcher
from epypes.service.endpoints import Endpoints
from epypes.service.result_publisher import ResultPublisher
from epypes.service.sd_notify import notify
from epypes.service.supervision.worker_health import WorkerHealth

State = Literal["LOADING", "READY", "PAUSED", "DEGRADED", "DRAINING", "FAULTED", "STOPPED"]
# In these states other replicas are better off with a broker's events.
_UNABLE: Final = ("STOPPED", "LOADING", "FAULTED")

_PAUSE: Final = "pause"
_LEAVE_TIMEOUT_S: Final = 5.0
_CHECK_PERIOD_S: Final = 0.1

_log = logging.getLogger("epypes.service")


class Lifecycle:
    """Computes the state of a service, and opens and closes its intake of events.

    Parameters
    ----------
    dispatcher, endpoints, results
        Of the service.
    health
        Returns the health of the worker.

    Attributes
    ----------
    is_running
        Whether the service was started and has not stopped.
    is_draining
        Whether it takes no more events.
    is_stopping
        Whether it drains since it stops.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        endpoints: Endpoints,
        results: ResultPublisher,
        health: Callable[[], WorkerHealth],
    ) -> None:
        self._dispatcher, self._endpoints, self._results = dispatcher, endpoints, results
        self._health = health
        self.is_running = self.is_draining = self.is_stopping = False
        self._lock = threading.Lock()
        self._published: tuple[State, str] = ("STOPPED", "")

    # -- the state ----------------------------------------------------------------------------------------------------

    def state(self) -> tuple[State, str]:
        """Return the state, and a sentence that says why; empty where there is nothing to say."""
        if not self.is_running:
            return "STOPPED", ""
        if self.is_draining:
            return "DRAINING", "It takes no more events, and works on those that it has."
        health = self._health()
        if health.fault:
            return "FAULTED", health.fault
        if self._dispatcher.connection is None:
            if health.was_ready:
                return "DEGRADED", health.trouble or "The worker is started again."
            return "LOADING", health.trouble or "The bundle is loaded, and its samples are replayed."
        if trouble := self._endpoints.trouble:
            return "DEGRADED", trouble
        if self._dispatcher.is_held(_PAUSE):
            return "PAUSED", "Events wait until it is resumed."
        return "READY", ""

    def check(self) -> None:
        """Compute the state, and notify listeners and systemd by the next `publish` if it differs. With the lock."""
        found = self.state()
        if found == self._published:
            return
        before, self._published = self._published, found
        data = {"state": found[0], "reason": found[1]}
        self._dispatcher.publish_later(lambda: self._results.notify("state", data))
        if found[0] == "READY":
            self._dispatcher.publish_later(lambda: notify("READY=1"))
        self._dispatcher.changed.notify_all()
        if (before[0] in _UNABLE) != (found[0] in _UNABLE):
            self._follow()

    def changed(self) -> None:
        """Compute the state, and publish it now. Without the lock."""
        with self._dispatcher.lock:
            self.check()
        self._dispatcher.publish()

    # -- the intake of events -----------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Have events wait in the mailbox, or at their broker, where other replicas may take them."""
        self._dispatcher.hold(_PAUSE)
        self._follow()
        _log.info("paused: events wait")
        self.changed()

    def resume(self) -> None:
        """Take events and work on them again, after `pause` and `close`."""
        self._dispatcher.release(_PAUSE)
        if self.is_draining:
            with self._lock:
                self._dispatcher.is_closed = False
                self._endpoints.events.start()
            self.is_draining = False
        else:
            self._follow()
        _log.info("resumed: events are taken and worked on")
        self.changed()

    def close(self, timeout_s: float, *, is_stopping: bool = False) -> None:
        """Take no more events."""
        self.is_draining, self.is_stopping = True, is_stopping
        _log.info("%s: no more events are taken", "stopping" if is_stopping else "draining")
        # First of all, so that senders hear of it.
        self.changed()
        self._dispatcher.is_closed = True
        with self._lock:
            self._endpoints.events.pause(timeout_s)
        self._dispatcher.release(_PAUSE)

    def leave(self, timeout_s: float) -> None:
        """Leave events to other consumers of the broker's queue, also those that it has delivered."""
        with self._lock:
            self._endpoints.events.leave(timeout_s)

    def _follow(self) -> None:
        """Take a broker's events if they will be worked on, and leave them to others otherwise; returns at once.

        To end a connection may take a while, and its thread may wait for the caller's lock.
        """
        if self._endpoints.events.is_broker:
            threading.Thread(target=self._take_or_leave, name="epypes intake", daemon=True).start()

    def _take_or_leave(self) -> None:
        with self._lock:
            try:
                if self._is_able():
                    self._dispatcher.is_closed = False
                    self._endpoints.events.start()
                elif not self.is_draining:
                    self._leave_unbegun()
            except EpypesError as error:
                _log.error("%s", error)

    def _is_able(self) -> bool:
        is_held = self.is_draining or self._dispatcher.is_held(_PAUSE)
        return not is_held and self.state()[0] not in _UNABLE

    def _leave_unbegun(self) -> None:
        """Leave to others the events that are not begun, once those are answered that are."""
        dispatcher = self._dispatcher
        dispatcher.is_closed = True
        while dispatcher.in_flight:
            dispatcher.wait_for(lambda: not dispatcher.in_flight, _CHECK_PERIOD_S)
            if self.is_draining or self._is_able():
                dispatcher.is_closed = self.is_draining
                return
        dispatcher.give_up("")
        self._endpoints.events.leave(_LEAVE_TIMEOUT_S)

    # -- the end ------------------------------------------------------------------------------------------------------

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until every accepted event is resolved; return whether it is.

        Ends early if another thread resumes the service, or stops it.
        """
        was_stopping = self.is_stopping

        def is_over() -> bool:
            return self._dispatcher.is_empty or not self.is_draining or self.is_stopping != was_stopping

        self._dispatcher.wait_for(is_over, timeout_s)
        return self._dispatcher.is_empty

    def give_up(self) -> None:
        """Answer unfinished events with a failure that names their function; or return them to their broker."""
        dispatcher, connection = self._dispatcher, self._dispatcher.connection
        running, functions = [event.seq for event in dispatcher.running], {}
        if running and connection is not None:
            if not self._endpoints.events.is_broker:
                functions = dict(connection.hang_report(running).functions)
            connection.kill()
        dispatcher.give_up("the service stops", functions)
        dispatcher.publish()

    def stopped(self) -> None:
        """Note that the service has stopped."""
        self.is_running = self.is_draining = self.is_stopping = self._dispatcher.is_closed = False
        self.changed()
