"""Who starts workers, watches over them, and replaces those that died or are stuck?

One thread, that lives as long as the service: the system ends a worker with the thread that has started it.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any, Final

from epypes.bundle.replay import REPLAY_TIMEOUT_S
from epypes.errors import ServiceError
from epypes.service.dispatch import Dispatcher
from epypes.service.health import DEATHS_BEFORE_FAULT, GOOD_EVENTS, PAUSE_S, Health
from epypes.service.link import SETTLING, Link, Message
from epypes.service.notify import Watchdog
from epypes.service.parameters import others_than
from epypes.service.served import Served
from epypes.service.stuck import whereabouts

_END_S: Final = 2.0

_log = logging.getLogger("epypes.service")


class Supervisor:
    """Starts, watches and replaces workers.

    ``is_rewritten`` is for who writes into the bundle: a worker that is started meanwhile is not used.

    Parameters
    ----------
    dispatcher
        Who gives events to the worker.
    served
        The bundle.
    threads
        How many events a worker works on at once.
    job_timeout_s
        How long an event may take, in seconds.
    parameters
        Returns the revision and all values, by token as in pipeline.toml, that a new worker must take; None if those
        of its bundle will do.
    on_change
        Called when the state may be another one.
    hear
        Called with what a worker says of parameters.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        served: Served,
        threads: int,
        job_timeout_s: float,
        parameters: Callable[[], tuple[int, Mapping[str, Any]] | None],
        on_change: Callable[[], None],
        hear: Callable[[Link, Mapping[str, Any]], None],
    ) -> None:
        self.served, self.health = served, Health()
        self.is_rewritten = False
        self.worker: Link | None = None
        self._dispatcher, self._threads = dispatcher, threads
        self._timeout_s, self._timeout_ns = job_timeout_s, int(job_timeout_s * 1e9)
        self._parameters, self._on_change, self._hear_more = parameters, on_change, hear
        self._changed = dispatcher.changed
        self._to_start: deque[tuple[Served, list[Link | Exception]]] = deque()
        self._restart_s: float | None = None
        self._loading_until_s = 0.0
        self._is_ending = False
        self._thread: threading.Thread | None = None
        self._watchdog = Watchdog()

    def start(self) -> None:
        """Begin, with a worker of the bundle."""
        with self._changed:
            self._is_ending = False
            self.health = Health()
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
            worker.dismiss(_END_S)
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()

    def abandon(self) -> None:
        """Kill the worker: what it has is not waited for."""
        with self._changed:
            self._is_ending = True
            worker = self.worker
            self._changed.notify_all()
        if worker is not None:
            worker.is_dismissed = True
            worker.process.kill()

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                job = self._next()
                while job is None:
                    self._changed.wait(self._wait_s())
                    job = self._next()
            if self._is_ending:
                return
            try:
                job()
                self._dispatcher.publish()
            except Exception:
                _log.exception("the supervisor goes on")

    def _wait_s(self) -> float | None:
        """Return how long there is nothing to do, if nothing changes; None for ever. With the lock held."""
        now_s = monotonic()
        due_in_s = self._dispatcher.due_in_s(self._timeout_ns)
        self._dispatcher.is_unwatched = due_in_s is None
        waits = [due_in_s, self._watchdog.due_in_s()]
        if self._restart_s is not None:
            waits.append(self._restart_s - now_s)
        if self._is_loading:
            waits.append(self._loading_until_s - now_s)
        known = [wait for wait in waits if wait is not None]
        return max(min(known), 0.0) if known else None

    def _next(self) -> Callable[[], object] | None:
        """Return what is to be done now. With the lock held."""
        now_s = monotonic()
        if self._is_ending:
            return _nothing
        if (told_in_s := self._watchdog.due_in_s()) is not None and told_in_s <= 0:
            return self._watchdog.tell
        if self._to_start:
            return self._start_for_deploy
        if self.worker is None and self._restart_s is None and not self.health.is_final:
            # What was to start one has failed.
            self._restart_s = now_s + PAUSE_S
        if self._restart_s is not None and self._restart_s <= now_s:
            self._restart_s = None
            return self._start_again
        due_in_s = self._dispatcher.due_in_s(self._timeout_ns)
        if self._dispatcher.link is not None and due_in_s is not None and due_in_s <= 0:
            return self._end_stuck
        if self._is_loading and self._loading_until_s <= now_s:
            return self._end_loading
        return None

    @property
    def _is_loading(self) -> bool:
        return self.worker is not None and self.worker is not self._dispatcher.link

    def _start_again(self) -> None:
        with self._changed:
            served = self.served
        try:
            link = Link(served, self._threads, self._hear, self._gone)
        except (OSError, MemoryError, RuntimeError) as error:
            # The system lacks descriptors, memory or threads just now, which is not the worker's fault.
            with self._changed:
                self._start_later(f"The worker can't be started: {_reason(error)}")
            return
        with self._changed:
            if self._is_ending or self.worker is not None or served is not self.served:
                # Another bundle has taken over while it was started, or other values were written into it.
                self._dismiss_for_another(link)
                return
            self.worker, self._loading_until_s = link, monotonic() + REPLAY_TIMEOUT_S
            self.health.restarts += self.health.was_ready
            if self.health.was_ready:
                _log.info("the worker is started again: process %d, restart %d", link.pid, self.health.restarts)
            # It may have been ready before this thread came here.
            if link.status == "ready":
                self._begin(link)
            elif link.status != "loading":
                self._over(link)

    def _end_loading(self) -> None:
        if (worker := self.worker) is not None:
            _log.error("the worker has not proved its bundle within %g s, so it is killed", REPLAY_TIMEOUT_S)
            worker.process.kill()

    # -- what a worker says, on its own thread ----------------------------------------------------------------------

    def _hear(self, link: Link, message: Message) -> None:
        header, frames = message
        kind = header.get("kind")
        if kind == "done":
            self._dispatcher.done(link, header, frames)
            with self._changed:
                self.health.deaths = 0
                if self._dispatcher.answered_in_row >= GOOD_EVENTS:
                    self.health.pauses = 0
        elif kind in SETTLING:
            self._hear_more(link, header)
            with self._changed:
                if link is self.worker and link is not self._dispatcher.link:
                    self._confirmed(link, header.get("problems") or {})
            self._dispatcher.publish()
        elif kind == "ready":
            with self._changed:
                if link is self.worker:
                    self._begin(link)
                self._changed.notify_all()
            self._dispatcher.publish()

    def _begin(self, link: Link) -> None:
        """Give events to a worker that is ready. With the lock held."""
        if link.served is not self.served or self.is_rewritten:
            # Its values are written back meanwhile: another one reads them.
            self._dismiss_for_another(link)
            return
        if link.about.get("digest") != self.served.digest:
            link.is_dismissed = True
            link.process.kill()
            self._fault(f"{self.served.path} is not the bundle any more that is served. Deploy it, or restore it.")
            return
        parameters = self._parameters()
        if parameters is None:
            self._use(link)
        else:
            # It gets events once it has confirmed them.
            link.tell_parameters(*parameters)

    def _dismiss_for_another(self, link: Link) -> None:
        """End a worker of what is not served any more; start another if there is none. With the lock held."""
        self.worker = None if self.worker is link else self.worker
        link.is_dismissed = True
        link.process.kill()
        if self.worker is None and not self._is_ending:
            self._restart_s = monotonic() + PAUSE_S

    def _confirmed(self, link: Link, problems: Mapping[str, str]) -> None:
        """Give events to a worker if it has taken the parameters of the one before. With the lock held."""
        if not problems:
            self._use(link)
            return
        self.worker, link.is_dismissed = None, True
        link.process.kill()
        why = " ".join(f"{token!r}: {problem}" for token, problem in problems.items())
        self._fault(f"A new worker does not take the parameters of the last one. {why}")

    def _use(self, link: Link) -> None:
        health = self.health
        health.was_ready, health.trouble, health.stuck, health.ready_s = True, "", "", monotonic()
        if health.fault:
            health.fault = ""
            self._dispatcher.refuse("")
        self._dispatcher.use(link)
        self._on_change()

    def _gone(self, link: Link) -> None:
        with self._changed:
            try:
                if link is self.worker:
                    self._over(link)
            finally:
                self._changed.notify_all()
        self._dispatcher.publish()

    def _over(self, link: Link) -> None:
        """Note that the worker is gone. With the lock held."""
        self.worker = None
        if link.status == "refused":
            self._dispatcher.worker_ended()
            self._fault(" ".join(link.reasons))
        elif link.is_dismissed:
            self._dispatcher.worker_ended()
            self._died(self.health.stuck or link.process.ending, has_cause=True)
        else:
            # Of an event it may die again and again: each is put aside in the end, so that it gets on.
            has_event = bool(self._dispatcher.ledger.running())
            self._dispatcher.worker_died(link.process.ending, link.process.died_in)
            self._died(link.process.ending, has_cause=has_event)

    def _died(self, why: str, *, has_cause: bool = False) -> None:
        """Start another worker after a while. With the lock held."""
        health = self.health
        if self._is_ending or health.is_final:
            return
        health.count_death(monotonic(), has_cause=has_cause)
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

    def _fault(self, why: str) -> None:
        """Start no worker any more: what is wrong does not pass by itself. With the lock held."""
        if self._is_ending:
            return
        self.health.fault, self.health.is_final = why, True
        self._restart_s = None
        _log.error("the bundle is not served any more: %s", why)
        self._dispatcher.refuse(f"it can't be served: {why[:300]}")
        self._on_change()

    # -- what takes too long ----------------------------------------------------------------------------------------

    def _end_stuck(self) -> None:
        link = self._dispatcher.link
        overdue = [entry.seq for entry in self._dispatcher.overdue(self._timeout_ns)]
        if link is None or not overdue:
            return
        where = whereabouts(link, overdue)
        with self._changed:
            stuck = self._dispatcher.still_stuck(where, overdue, self._timeout_ns)
            if stuck is None:
                # They were done, or have not taken so long, and the worker goes on.
                return
            self._dispatcher.fail_stuck(stuck, where.functions, self._timeout_s)
            named = next((name for seq in stuck if (name := where.functions[seq])), "")
            told = f"Function {named!r}" if named else "The worker"
            how = " The process was stopped." if link.process.is_stopped else ""
            self.health.stuck = f"{told} did not return within {self._timeout_s:g} s.{how} The worker is replaced"
            link.is_dismissed = True
            self._on_change()
        _log.error("%s", self.health.stuck)
        link.process.kill()

    # -- another bundle -----------------------------------------------------------------------------------------------

    def load(self, served: Served) -> Link:
        """Start a worker of another bundle beside the one that is served; return it when it has proved the bundle.

        Raises
        ------
        ServiceError
            It refused the bundle, or died; the text says why.
        """
        started: list[Link | Exception] = []
        with self._changed:
            self._to_start.append((served, started))
            self._changed.notify_all()
            self._changed.wait_for(lambda: started or self._is_ending)
            link = started[0] if started else ServiceError(served.path, "The service stops.")
            if not isinstance(link, Link):
                raise link
            is_over = self._changed.wait_for(lambda: link.status != "loading" or self._is_ending, REPLAY_TIMEOUT_S)
        if link.status == "ready" and link.about.get("digest") == served.digest:
            return link
        link.is_dismissed = True
        link.process.kill()
        if link.status == "ready":
            why = "it was changed while it was loaded. Deploy it again."
        elif link.status == "refused":
            why = " ".join(link.reasons)
        else:
            why = link.process.ending or f"it was not loaded {'in time' if not is_over else 'while the service stops'}"
        raise ServiceError(served.path, why)

    def _start_for_deploy(self) -> None:
        with self._changed:
            served, started = self._to_start.popleft()
        try:
            made: Link | Exception = Link(served, self._threads, self._hear, self._gone)
        except (OSError, MemoryError, RuntimeError) as error:
            made = ServiceError(served.path, f"A worker can't be started: {_reason(error)}.")
        with self._changed:
            started.append(made)
            self._changed.notify_all()

    def can_switch(self, link: Link) -> bool:
        """Whether a worker can take over: it has not ended meanwhile, and neither has the service."""
        return not self._is_ending and link.status == "ready"

    def switch(self, link: Link) -> None:
        """Give events to the worker of another bundle from now on; the one before is ended. With no event in flight."""
        with self._changed:
            before, self.worker = self.worker, link
            self.served, self._restart_s = link.served, None
            restarts = self.health.restarts
            self.health = Health(was_ready=True, restarts=restarts)
            self._dispatcher.refuse("")
            parameters = self._parameters()
            if parameters is not None:
                # Its own values it has proved; others are those that other workers of this bundle have taken.
                link.tell_parameters(parameters[0], others_than(link.served.entries, parameters[1]))
            self._use(link)
        if before is not None:
            threading.Thread(target=before.dismiss, args=(_END_S,), name="epypes last worker", daemon=True).start()


def _reason(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "there is no memory left"
    return getattr(error, "strerror", None) or str(error)


def _nothing() -> None:
    """Do nothing: the thread ends."""
