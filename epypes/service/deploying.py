"""How does another bundle take the place of the one that is served? Proved beside it, between two events, or not."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from epypes.bundle.seal import check_seal
from epypes.errors import BundleError, DeployRefused, ServiceError
from epypes.service.dispatch import Dispatcher
from epypes.service.link import Link
from epypes.service.notify import notify, reloading
from epypes.service.parameters import differing_values
from epypes.service.served import Served, differing_ports, read_served
from epypes.service.supervisor import Supervisor
from epypes.service.tuning import Tuning

if TYPE_CHECKING:
    from epypes.bundle.writeback import WriteBack

_HOLD: Final = "deploy"
# Beyond the longest time of an event: for a worker that is stuck to be noticed and killed.
_GRACE_S: Final = 5.0
_DIGITS: Final = 12

_T = TypeVar("_T")

_log = logging.getLogger("epypes.service")


class Deployer:
    """Exchanges the bundle of a service.

    Parameters
    ----------
    dispatcher, supervisor, tuning
        Of the service.
    job_timeout_s
        How long an event may take: so long the switch waits for it.
    tell
        Told, as listeners are, what is served now.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        supervisor: Supervisor,
        tuning: Tuning,
        job_timeout_s: float,
        tell: Callable[[str, dict[str, Any]], None],
    ) -> None:
        self._tell = tell
        self._dispatcher, self._supervisor, self._tuning = dispatcher, supervisor, tuning
        self._timeout_s = job_timeout_s + _GRACE_S
        self._turn = threading.Lock()
        self._before: Served | None = None

    def deploy(self, path: str | Path) -> list[str]:
        """Serve another bundle from now on, with its own parameters; return which values are others now.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or has other ports; the one that is served goes on.
        ServiceError
            Another one is being deployed.
        """
        return self._alone(path, lambda: self._deploy(_read(path), "deployed"))

    def rollback(self) -> list[str]:
        """Serve the bundle again that was served before; return which values are others now.

        The one that is served now is the one before then: twice is there and back.

        Raises
        ------
        DeployRefused
            There was none, or it is not any more what it was.
        """
        path = self._supervisor.served.path
        return self._alone(path, lambda: self._deploy(self._read_before(), "rolled back to"))

    def write_back(self, *, dry_run: bool) -> WriteBack:
        """Write the parameters into the bundle that is served, whose new digest is the one that is served then.

        Raises
        ------
        BundleError
            The bundle was changed, or can't be written.
        ServiceError
            Another one is being deployed.
        """
        return self._alone(self._supervisor.served.path, lambda: self._write_back(dry_run))

    def _write_back(self, dry_run: bool) -> WriteBack:
        from epypes.bundle.entries import read
        from epypes.bundle.writeback import write_back

        before = self._supervisor.served
        if check_seal(before.path) != before.digest:
            text = f"{before.path} is not the bundle any more that is served. Deploy it first, or restore it."
            raise BundleError(before.path, text)
        values = {token: read(entry) for token, entry in self._tuning.current.entries.items()}
        self._supervisor.is_rewritten = not dry_run
        try:
            found = write_back(before.path, values, dry_run=dry_run)
            if not dry_run and found.diff:
                self._take_over(before, found.digest)
        finally:
            self._supervisor.is_rewritten = False
        return found

    def _take_over(self, before: Served, digest: str) -> None:
        """Go on with the bundle into which the parameters were written, which its worker has already."""
        after = read_served(before.path)
        if after.digest != digest:
            text = f"{before.path} was promoted anew just after the values were written. Deploy it."
            raise BundleError(before.path, text)
        with self._dispatcher.changed:
            self._supervisor.served = self._tuning.served = after
            self._tell_served("wrote parameters back into", before)

    def _tell_served(self, how: str, before: Served) -> None:
        """Tell what is served now. With the lock held."""
        now = self._supervisor.served
        _log.info("%s %s (%s), before %s (%s)", how, now.path, _short(now), before.path, _short(before))
        data = {"bundle": str(now.path), "digest": now.digest}
        self._dispatcher.tell(lambda: self._tell("deployed", data))

    def _alone(self, path: str | Path, work: Callable[[], _T]) -> _T:
        if not self._turn.acquire(blocking=False):
            raise ServiceError(path, "Another bundle is being deployed. Wait until that is done.")
        try:
            reloading()
            return work()
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
            why = (
                f"It can't be rolled back to {before.path}, which was changed since it was served: it was "
                f"{_short(before)}, and is {_short(found)}. If it shall be served: epypes deploy {before.path}."
            )
            raise DeployRefused(before.path, [why])
        return found

    def _deploy(self, served: Served, how: str) -> list[str]:
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
            values = self._switch(link, how)
        finally:
            self._dispatcher.let_go(_HOLD)
        self._before = now
        return values

    def _switch(self, link: Link, how: str) -> list[str]:
        """Let the worker of the other bundle take over when no event is in flight; return which values that changes."""
        with self._dispatcher.changed:
            ended = self._dispatcher.wait_for(lambda: not self._dispatcher.ledger.running(), self._timeout_s)
            if ended and self._supervisor.can_switch(link):
                before = self._supervisor.served
                tuned = self._tuning.current.entries
                self._tuning.take_over(link.served)
                values = differing_values(before.entries, tuned, self._tuning.current.entries)
                self._supervisor.switch(link)
                self._tell_served(how, before)
                return values
        why = f"The event that is worked on has not ended within {self._timeout_s:g} s."
        if ended:
            why = link.process.ending or "The service stops."
        link.dismiss(0.0)
        raise DeployRefused(link.served.path, [why])


def _short(served: Served) -> str:
    return served.digest[:_DIGITS]


def _read(path: str | Path) -> Served:
    try:
        return read_served(path)
    except BundleError as error:
        raise DeployRefused(path, [str(error)]) from error
