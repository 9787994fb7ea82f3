"""Starts workers, watches them, and replaces those that died or hang.

One thread, which lives as long as the service: the system ends a worker with the thread that has started it.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Final

from epypes.bundle.proof.replay_process import REPLAY_TIMEOUT_S
from epypes.errors import ServiceError
from epypes.service.bundle_info import BundleInfo
from epypes.service.dispatcher import Dispatcher
from epypes.service.parameters import ParameterControl, others_than
from epypes.service.sd_notify import Watchdog
from epypes.service.supervision.frame_socket import WorkerMessage
from epypes.service.supervision.worker_connection import WorkerConnection
from epypes.service.supervision.worker_health import DEATHS_BEFORE_FAULT, RESTART_PAUSE_S, WorkerHealth

_END_TIMEOUT_S: Final = 2.0

_log = logging.getLogger("epypes.service")


class Supervisor:
    """Starts, watches and replaces workers.

    Parameters
    ----------
    dispatcher
        Gives events to the worker.
    bundle
        The bundle that is served.
    threads
        How many events a worker works on at once.
    job_timeout_s
        How long an event may take, in seconds.
    parameters
        What a new worker computes with.
    on_change
        Called, with the lock held, when the state of the service may have changed.

    Attributes
    ----------
    bundle
        The bundle that is served.
    health
        Of the worker.
    is_rewritten
        Set while parameters are written into the bundle: a worker that is started meanwhile is not used.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        bundle: BundleInfo,
        threads: int,
        job_timeout_s: float,
        parameters: ParameterControl,
        on_change: Callable[[], None],
    ) -> None:
        self.bundle, self.health = bundle, WorkerHealth()
        self.is_rewritten = False
        self.worker: WorkerConnection | None = None
        self._dispatcher, self._threads = dispatcher, threads
        self._timeout_s = job_timeout_s
        self._parameters, self._on_change = parameters, on_change
        self._changed = dispatcher.changed
        self._to_start: deque[tuple[BundleInfo, list[WorkerConnection | Exception]]] = deque()
        self._restart_s: float | None = None
        self._loading_until_s = 0.0
        self._is_ending = False
        self._thread: threading.Thread | None = None
        self._watchdog = Watchdog()

    def start(self) -> None:
        """Start the thread, and a worker of the bundle."""
        with self._changed:
            self._is_ending = False
            self.health = WorkerHealth()
            self._restart_s = monotonic()
            self._thread = threading.Thread(target=self._run, name="epypes supervisor", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the workers, and the thread."""
        with self._changed:
            self._is_ending = True
            worker, self.worker = self.worker, None
            self._dispatcher.use(None)
            self._changed.notify_all()
        if worker is not None:
            worker.dismiss(_END_TIMEOUT_S)
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()

    def abandon(self) -> None:
        """Kill the worker without waiting for its events."""
        with self._changed:
            self._is_ending = True
            worker = self.worker
            self._changed.notify_all()
        if worker is not None:
            worker.kill()

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                due_in_s, job = self._next()
                while due_in_s is None or due_in_s > 0:
                    self._changed.wait(due_in_s)
                    due_in_s, job = self._next()
            if self._is_ending:
                return
            try:
                job()
                self._dispatcher.publish()
            except Exception:
                _log.exception("a step of the supervisor failed; the supervisor goes on")

    def _next(self) -> tuple[float | None, Callable[[], object]]:
        """Return what must be done next, and in how many seconds; None for never. With the lock held."""
        if self._is_ending:
            return 0.0, _nothing
        now_s = monotonic()
        if self.worker is None and self._restart_s is None and not self.health.is_final:
            # The last attempt to start one has failed.
            self._restart_s = now_s + RESTART_PAUSE_S
        jobs: list[tuple[float | None, Callable[[], object]]] = [
            (self._watchdog.due_in_s(), self._watchdog.send),
            (0.0 if self._to_start else None, self._start_for_deploy),
            (None if self._restart_s is None else self._restart_s - now_s, self._start_again),
            (self._dispatcher.due_in_s(self._timeout_s), self._end_stuck),
            (self._loading_until_s - now_s if self._is_loading else None, self._end_loading),
        ]
        return min(jobs, key=lambda job: math.inf if job[0] is None else job[0])

    @property
    def _is_loading(self) -> bool:
        worker = self.worker
        return worker is not None and worker is not self._dispatcher.connection and not worker.is_dismissed

    def _start_again(self) -> None:
        with self._changed:
            bundle, self._restart_s = self.bundle, None
        try:
            connection = WorkerConnection(bundle, self._threads, self._on_message, self._on_end)
        except (OSError, MemoryError, RuntimeError) as error:
            # The system lacks descriptors, memory or threads just now, which is not the worker's fault.
            with self._changed:
                self._start_later(f"The worker can't be started: {_reason(error)}")
            return
        with self._changed:
            if self._is_ending or self.worker is not None or bundle is not self.bundle:
                # Another bundle has taken over while it was started, or other values were written into it.
                self._dismiss_for_another(connection)
                return
            self.worker, self._loading_until_s = connection, monotonic() + REPLAY_TIMEOUT_S
            self.health.restarts += self.health.was_ready
            if self.health.was_ready:
                _log.info("the worker is started again: process %d, restart %d", connection.pid, self.health.restarts)
            # It may have been ready before this thread came here.
            if connection.status == "ready":
                self._begin(connection)
            elif connection.status != "loading":
                self._over(connection)

    def _end_loading(self) -> None:
        if (worker := self.worker) is not None:
            _log.error("the worker was not ready within %g s, so it is killed", REPLAY_TIMEOUT_S)
            worker.process.kill()

    # -- messages of a worker, on its receiving thread -----------------------------------------------------------------

    def _on_message(self, connection: WorkerConnection, message: WorkerMessage) -> None:
        if message.kind == "done":
            self._dispatcher.done(connection, message)
        elif message.kind == "parameters":
            self._parameters.settled(connection, message.content)
            with self._changed:
                if connection is self.worker and connection is not self._dispatcher.connection:
                    self._confirmed(connection, message.content["problems"])
            self._dispatcher.publish()
        elif message.kind == "ready":
            with self._changed:
                if connection is self.worker:
                    self._begin(connection)
                self._changed.notify_all()
            self._dispatcher.publish()

    def _begin(self, connection: WorkerConnection) -> None:
        """Give events to a worker that is ready. With the lock held."""
        if connection.bundle is not self.bundle or self.is_rewritten:
            # Its values are written back meanwhile: another one reads them.
            self._dismiss_for_another(connection)
            return
        if connection.about.get("digest") != self.bundle.digest:
            connection.kill()
            self._fault(f"{self.bundle.path} is not the bundle any more that is served. Deploy it, or restore it.")
            return
        parameters = self._parameters.for_new_worker()
        if parameters is None:
            self._use(connection)
        else:
            # It gets events once it has confirmed them.
            connection.post_parameters(*parameters)

    def _dismiss_for_another(self, connection: WorkerConnection) -> None:
        """End a worker of what is not served any more; start another if there is none. With the lock held."""
        self.worker = None if self.worker is connection else self.worker
        connection.kill()
        if self.worker is None and not self._is_ending:
            self._restart_s = monotonic() + RESTART_PAUSE_S

    def _confirmed(self, connection: WorkerConnection, problems: Mapping[str, str]) -> None:
        """Give events to a worker if it has taken the parameters of the one before. With the lock held."""
        if not problems:
            self._use(connection)
            return
        self.worker, connection.is_dismissed = None, True
        connection.process.kill()
        why = " ".join(f"{token!r}: {problem}" for token, problem in problems.items())
        self._fault(f"A new worker does not take the parameters of the last one. {why}")

    def _use(self, connection: WorkerConnection) -> None:
        health = self.health
        health.was_ready, health.trouble, health.stuck, health.ready_s = True, "", "", monotonic()
        if health.fault:
            health.fault = ""
            self._dispatcher.refuse("")
        self._dispatcher.use(connection)
        self._on_change()

    def _on_end(self, connection: WorkerConnection) -> None:
        with self._changed:
            try:
                if connection is self.worker:
                    self._over(connection)
            finally:
                self._changed.notify_all()
        self._dispatcher.publish()

    def _over(self, connection: WorkerConnection) -> None:
        """Note that the worker is gone. With the lock held."""
        self.worker = None
        answered = self._dispatcher.answered_in_row
        if connection.status == "refused":
            self._dispatcher.worker_ended()
            self._fault(" ".join(connection.reasons))
        elif connection.is_dismissed:
            self._dispatcher.worker_ended()
            self._died(self.health.stuck or connection.process.ending, answered, has_cause=True)
        else:
            # An event that kills workers becomes a dead letter in the end: such deaths must not make a fault.
            has_event = bool(self._dispatcher.running)
            self._dispatcher.worker_died(connection.process.ending, connection.process.died_in)
            self._died(connection.process.ending, answered, has_cause=has_event)

    def _died(self, why: str, answered: int, *, has_cause: bool = False) -> None:
        """Start another worker after a while. With the lock held."""
        health = self.health
        if self._is_ending or health.is_final:
            return
        health.count_death(monotonic(), answered, has_cause=has_cause)
        if health.deaths >= DEATHS_BEFORE_FAULT:
            health.fault = f"{health.deaths} workers ended in a row as soon as they were started. The last: {why}"
            self._dispatcher.refuse(f"it can't be served: {health.fault[:300]}")
        self._start_later(why)

    def _start_later(self, why: str) -> None:
        """Start a worker after a while that grows with each failure. With the lock held."""
        if self._is_ending:
            return
        pause_s = self.health.next_pause_s()
        self.health.trouble = f"{why}. Another one is started."
        _log.warning("%s; another one is started in %g s", why, pause_s)
        self._restart_s = monotonic() + pause_s
        self._changed.notify_all()
        self._on_change()

    def refuse(self, why: str) -> None:
        """End the worker, and start none any more: the bundle can't be served any longer. With the lock held."""
        if self.worker is not None:
            self.worker.kill()
        self._fault(why)

    def _fault(self, why: str) -> None:
        """Start no worker any more: what is wrong does not pass by itself. With the lock held."""
        if self._is_ending:
            return
        self.health.fault, self.health.is_final = why, True
        self._restart_s = None
        _log.error("the bundle is not served any more: %s", why)
        self._dispatcher.refuse(f"it can't be served: {why[:300]}")
        self._on_change()

    # -- events that take too long -------------------------------------------------------------------------------------

    def _end_stuck(self) -> None:
        connection = self._dispatcher.connection
        overdue = [event.seq for event in self._dispatcher.overdue(self._timeout_s)]
        if connection is None or not overdue:
            return
        report = connection.hang_report(overdue)
        with self._changed:
            function = self._dispatcher.fail_stuck(report, overdue, self._timeout_s)
            if function is None:
                # They were done, or have not taken so long, and the worker goes on.
                return
            where = f"Function {function!r}" if function else "The worker"
            how = " The process was stopped." if connection.process.is_stopped else ""
            self.health.stuck = f"{where} did not return within {self._timeout_s:g} s.{how} The worker is replaced"
            connection.is_dismissed = True
            self._on_change()
        _log.error("%s", self.health.stuck)
        connection.process.kill()

    # -- another bundle -----------------------------------------------------------------------------------------------

    def load(self, bundle: BundleInfo) -> WorkerConnection:
        """Start a worker of another bundle beside the one that is served; return it when it has proved the bundle.

        Raises
        ------
        ServiceError
            It refused the bundle, or died; the text says why.
        """
        started: list[WorkerConnection | Exception] = []
        with self._changed:
            self._to_start.append((bundle, started))
            self._changed.notify_all()
            self._changed.wait_for(lambda: started or self._is_ending)
            connection = started[0] if started else ServiceError(bundle.path, "The service stops.")
            if not isinstance(connection, WorkerConnection):
                raise connection
            is_over = self._changed.wait_for(
                lambda: connection.status != "loading" or self._is_ending, REPLAY_TIMEOUT_S
            )
        if connection.status == "ready" and connection.about.get("digest") == bundle.digest:
            return connection
        connection.kill()
        if connection.status == "ready":
            why = "it was changed while it was loaded. Deploy it again."
        elif connection.status == "refused":
            why = " ".join(connection.reasons)
        else:
            why = (
                connection.process.ending
                or f"it was not loaded {'in time' if not is_over else 'while the service stops'}"
            )
        raise ServiceError(bundle.path, why)

    def _start_for_deploy(self) -> None:
        with self._changed:
            bundle, started = self._to_start.popleft()
        try:
            made: WorkerConnection | Exception = WorkerConnection(bundle, self._threads, self._on_message, self._on_end)
        except (OSError, MemoryError, RuntimeError) as error:
            made = ServiceError(bundle.path, f"A worker can't be started: {_reason(error)}.")
        with self._changed:
            started.append(made)
            self._changed.notify_all()

    def can_switch(self, connection: WorkerConnection) -> bool:
        """Whether a worker can take over: it has not ended meanwhile, and neither has the service."""
        return not self._is_ending and connection.status == "ready"

    def switch(self, connection: WorkerConnection) -> None:
        """Give events to the worker of another bundle from now on; the one before is ended. With no event in flight."""
        with self._changed:
            before, self.worker = self.worker, connection
            self.bundle, self._restart_s = connection.bundle, None
            restarts = self.health.restarts
            self.health = WorkerHealth(was_ready=True, restarts=restarts)
            self._dispatcher.refuse("")
            parameters = self._parameters.for_new_worker()
            if parameters is not None:
                # The worker has proved the bundle's own values; others were accepted by workers of other replicas.
                connection.post_parameters(parameters[0], others_than(connection.bundle.entries, parameters[1]))
            self._use(connection)
        if before is not None:
            threading.Thread(
                target=before.dismiss, args=(_END_TIMEOUT_S,), name="epypes last worker", daemon=True
            ).start()


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "there is no memory left"
    return getattr(error, "strerror", None) or str(error)


def _nothing() -> None:
    """Do nothing: the thread ends."""
