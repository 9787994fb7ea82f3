"""Deploying: another bundle replaces the one that is served, between two events, once a worker has proved it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from epypes.bundle.manifest import check_manifest
from epypes.errors import BundleError, DeployRefused, ServiceError
from epypes.service.bundle_info import BundleInfo, differing_ports, read_bundle_info
from epypes.service.dispatcher import Dispatcher
from epypes.service.event_states import Delays, StateChoice, change_of_state
from epypes.service.parameters import ParameterControl, differing_values
from epypes.service.sd_notify import notify, notify_reloading
from epypes.service.supervision.supervisor import Supervisor
from epypes.service.supervision.worker_connection import WorkerConnection

if TYPE_CHECKING:
    from epypes.bundle.writeback import WriteBack

_HOLD: Final = "deploy"
# Beyond the job time-out: for a worker that hangs to be noticed and killed.
_GRACE_S: Final = 5.0
_DIGITS: Final = 12

_T = TypeVar("_T")

_log = logging.getLogger("epypes.service")


class Deployer:
    """Replaces the bundle of a service.

    Parameters
    ----------
    dispatcher, supervisor, parameters
        Of the service.
    job_timeout_s
        How long an event may take: the switch waits for it.
    notify_listeners
        Called with ``"deployed"`` and what is served now.
    why_refused
        Returns why a bundle can't be served with the options of the service; empty if it can.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        supervisor: Supervisor,
        parameters: ParameterControl,
        job_timeout_s: float,
        notify_listeners: Callable[[str, dict[str, Any]], None],
        why_refused: Callable[[BundleInfo], str],
    ) -> None:
        self._notify_listeners, self._why_refused = notify_listeners, why_refused
        self._dispatcher, self._supervisor, self._parameters = dispatcher, supervisor, parameters
        self._timeout_s = job_timeout_s + _GRACE_S
        self._lock = threading.Lock()
        self._before: BundleInfo | None = None

    def deploy(self, path: str | Path, state: StateChoice | None = None) -> list[str]:
        """Serve another bundle from now on, with its own parameters; return a line for each value that changed.

        Parameters
        ----------
        state
            What becomes of the state between events. Without, it is kept if both bundles have the same delays.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or has other ports, or can't keep the state; the bundle that is
            served goes on.
        ServiceError
            A deploy, a rollback or a write-back is running already.
        """
        return self._exclusive(path, lambda: self._deploy(_read(path), "deployed", state))

    def rollback(self, state: StateChoice | None = None) -> list[str]:
        """Serve the bundle again that was served before; return a line for each value that changed.

        The bundle that is served now is the one before then, so a second rollback undoes the first.

        Raises
        ------
        DeployRefused
            There was none, or it was changed since.
        """
        path = self._supervisor.bundle.path
        return self._exclusive(path, lambda: self._deploy(self._read_before(), "rolled back to", state))

    def write_back(self, *, dry_run: bool) -> WriteBack:
        """Write the parameters into the bundle that is served, whose new digest is the one that is served then.

        Raises
        ------
        BundleError
            The bundle was changed, or can't be written.
        ServiceError
            A deploy, a rollback or a write-back is running already.
        """
        return self._exclusive(self._supervisor.bundle.path, lambda: self._write_back(dry_run))

    def _write_back(self, dry_run: bool) -> WriteBack:
        from epypes.bundle.settings import decode_value
        from epypes.bundle.writeback import write_back

        before = self._supervisor.bundle
        if check_manifest(before.path) != before.digest:
            text = f"{before.path} is not the bundle any more that is served. Deploy it first, or restore it."
            raise BundleError(before.path, text)
        values = {token: decode_value(entry) for token, entry in self._parameters.current.entries.items()}
        self._supervisor.is_rewritten = not dry_run
        try:
            found = write_back(before.path, values, dry_run=dry_run)
            if not dry_run and found.diff:
                self._take_over(before, found.digest)
        finally:
            self._supervisor.is_rewritten = False
        return found

    def _take_over(self, before: BundleInfo, digest: str) -> None:
        """Go on with the bundle into which the parameters were written, which its worker computes with already."""
        after = read_bundle_info(before.path)
        if after.digest != digest:
            text = f"{before.path} was promoted anew just after the values were written. Deploy it."
            raise BundleError(before.path, text)
        with self._dispatcher.lock:
            self._supervisor.bundle = self._parameters.bundle = after
            self._publish_deployed("wrote parameters back into", before)

    def _publish_deployed(self, how: str, before: BundleInfo) -> None:
        """Log and publish what is served now. With the lock held."""
        now = self._supervisor.bundle
        _log.info("%s %s (%s), before %s (%s)", how, now.path, _short(now), before.path, _short(before))
        data = {"bundle": str(now.path), "digest": now.digest}
        self._dispatcher.publish_later(lambda: self._notify_listeners("deployed", data))

    def _exclusive(self, path: str | Path, work: Callable[[], _T]) -> _T:
        if not self._lock.acquire(blocking=False):
            raise ServiceError(path, "A deploy, a rollback or a write-back is running already. Wait until it is done.")
        try:
            notify_reloading()
            return work()
        finally:
            self._lock.release()
            notify("READY=1")
            self._dispatcher.publish()

    def _read_before(self) -> BundleInfo:
        before = self._before
        if before is None:
            raise DeployRefused(self._supervisor.bundle.path, ["No bundle was served before this one."])
        found = _read(before.path)
        if found.digest != before.digest:
            why = (
                f"It can't be rolled back to {before.path}, which was changed since it was served: it was "
                f"{_short(before)}, and is {_short(found)}. To serve it: epypes deploy {before.path}."
            )
            raise DeployRefused(before.path, [why])
        return found

    def _deploy(self, bundle: BundleInfo, how: str, state: StateChoice | None) -> list[str]:
        now = self._supervisor.bundle
        reasons = [*differing_ports(now.settings, bundle.settings), *filter(None, [self._why_refused(bundle)])]
        if reasons:
            raise DeployRefused(bundle.path, reasons)
        try:
            connection = self._supervisor.load(bundle)
        except ServiceError as error:
            raise DeployRefused(bundle.path, [str(error)]) from error
        is_kept, line = change_of_state(self._dispatcher.delays, _delays(connection), state)
        if state == "keep" and not is_kept:
            connection.dismiss(0.0)
            raise DeployRefused(bundle.path, [f"It can't go on with the {line}. Deploy it with the state reset."])
        self._dispatcher.hold(_HOLD)
        try:
            values = self._switch(connection, how, state)
        finally:
            self._dispatcher.release(_HOLD)
        self._before = now
        return values

    def _switch(self, connection: WorkerConnection, how: str, state: StateChoice | None) -> list[str]:
        """Let the worker of the other bundle take over when no event is worked on; return the changed values."""
        with self._dispatcher.lock:
            ended = self._dispatcher.wait_for(lambda: not self._dispatcher.running, self._timeout_s)
            if ended and self._supervisor.can_switch(connection):
                before = self._supervisor.bundle
                tuned = self._parameters.current.entries
                self._parameters.take_over(connection.bundle)
                values = differing_values(before.entries, tuned, self._parameters.current.entries)
                is_kept, line = change_of_state(self._dispatcher.delays, _delays(connection), state)
                if not is_kept:
                    self._dispatcher.reset_state()
                self._supervisor.switch(connection)
                self._publish_deployed(how, before)
                return values + [line] * bool(line)
        why = f"The event that is worked on has not ended within {self._timeout_s:g} s."
        if ended:
            why = connection.process.ending or "The service stops."
        connection.dismiss(0.0)
        raise DeployRefused(connection.bundle.path, [why])


def _delays(connection: WorkerConnection) -> Delays:
    delays: Delays = connection.about.get("delays", {})
    return delays


def _short(bundle: BundleInfo) -> str:
    return bundle.digest[:_DIGITS]


def _read(path: str | Path) -> BundleInfo:
    try:
        return read_bundle_info(path)
    except BundleError as error:
        raise DeployRefused(path, [str(error)]) from error
