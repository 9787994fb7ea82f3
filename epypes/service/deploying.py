"""How does another bundle take the place of the one that is served? Proved beside it, between two events, or not."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from epypes.errors import BundleError, DeployRefused, ServiceError
from epypes.service.dispatch import Dispatcher
from epypes.service.link import Link
from epypes.service.notify import notify, reloading
from epypes.service.served import Served, differing_ports, read_served
from epypes.service.supervisor import Supervisor
from epypes.service.tuning import Tuning

_HOLD: Final = "deploy"
# Beyond the longest time of an event: for a worker that is stuck to be noticed and killed.
_GRACE_S: Final = 5.0


class Deployer:
    """Exchanges the bundle of a service.

    Parameters
    ----------
    dispatcher, supervisor, tuning
        Of the service.
    job_timeout_s
        How long an event may take: so long the switch waits for it.
    """

    def __init__(self, dispatcher: Dispatcher, supervisor: Supervisor, tuning: Tuning, job_timeout_s: float) -> None:
        self._dispatcher, self._supervisor, self._tuning = dispatcher, supervisor, tuning
        self._timeout_s = job_timeout_s + _GRACE_S
        self._turn = threading.Lock()
        self._before: Served | None = None

    def deploy(self, path: str | Path) -> None:
        """Serve another bundle from now on, with its own parameters.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or has other ports; the one that is served goes on.
        ServiceError
            Another one is being deployed.
        """
        self._alone(path, lambda: _read(path))

    def rollback(self) -> None:
        """Serve the bundle again that was served before.

        Raises
        ------
        DeployRefused
            There was none, or it is not any more what it was.
        """
        self._alone(self._supervisor.served.path, self._read_before)

    def _alone(self, path: str | Path, read: Callable[[], Served]) -> None:
        if not self._turn.acquire(blocking=False):
            raise ServiceError(path, "Another bundle is being deployed. Wait until that is done.")
        try:
            reloading()
            self._deploy(read())
        finally:
            self._turn.release()
            notify("READY=1")
            self._dispatcher.publish()

    def _read_before(self) -> Served:
        before = self._before
        if before is None:
            raise DeployRefused(self._supervisor.served.path, ["No bundle was served before this one."])
        found = _read(before.path)
        if found.digest != before.digest:
            raise DeployRefused(before.path, ["It was changed since it was served. Deploy it, if it shall be served."])
        return found

    def _deploy(self, served: Served) -> None:
        now = self._supervisor.served
        reasons = differing_ports(now.settings, served.settings)
        if reasons:
            raise DeployRefused(served.path, reasons)
        try:
            link = self._supervisor.load(served)
        except ServiceError as error:
            raise DeployRefused(served.path, [str(error)]) from error
        self._dispatcher.hold(_HOLD)
        try:
            self._switch(link)
        finally:
            self._dispatcher.let_go(_HOLD)
        self._before = now

    def _switch(self, link: Link) -> None:
        """Let the worker of the other bundle take over when no event is in flight."""
        with self._dispatcher.changed:
            ended = self._dispatcher.wait_for(lambda: not self._dispatcher.ledger.running(), self._timeout_s)
            if ended and self._supervisor.can_switch(link):
                self._tuning.take_over(link.served.entries)
                self._supervisor.switch(link)
                return
        why = f"The event that is worked on has not ended within {self._timeout_s:g} s."
        if ended:
            why = link.process.ending or "The service stops."
        link.dismiss(0.0)
        raise DeployRefused(link.served.path, [why])


def _read(path: str | Path) -> Served:
    try:
        return read_served(path)
    except BundleError as error:
        raise DeployRefused(path, [str(error)]) from error
