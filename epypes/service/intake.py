"""Does a service take events, and work on those that it has? Pause, drain, and what is left at the end."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

from epypes.service.dispatch import Dispatcher
from epypes.service.sockets import Sockets
from epypes.service.stuck import whereabouts

_PAUSE: Final = "pause"

_log = logging.getLogger("epypes.service")


class Intake:
    """Where events come in, which can be closed and held up.

    Parameters
    ----------
    dispatcher, sockets
        Of the service.
    changed
        Called when its state may be another one.

    Attributes
    ----------
    is_draining
        Whether it takes no more events.
    is_stopping
        Whether it will not again, since the service stops.
    """

    def __init__(self, dispatcher: Dispatcher, sockets: Sockets, changed: Callable[[], None]) -> None:
        self._dispatcher, self._sockets, self._changed = dispatcher, sockets, changed
        self.is_draining = self.is_stopping = False

    @property
    def is_paused(self) -> bool:
        """Whether events wait since somebody asked for it."""
        return self._dispatcher.is_held(_PAUSE)

    def pause(self) -> None:
        """Have events wait in the mailbox."""
        self._dispatcher.hold(_PAUSE)
        _log.info("paused: events wait")
        self._changed()

    def resume(self) -> None:
        """Work on events again, and take them, after `pause` and `close`."""
        self._dispatcher.let_go(_PAUSE)
        if self.is_draining:
            self._sockets.open_subscriber()
            self.is_draining = False
        _log.info("resumed: events are taken and worked on")
        self._changed()

    def close(self, timeout_s: float, *, for_good: bool = False) -> None:
        """Take no more events."""
        self.is_draining, self.is_stopping = True, for_good
        _log.info("%s: no more events are taken", "stopping" if for_good else "draining")
        # First of all, so that nobody sends more.
        self._changed()
        self._sockets.close_subscriber(timeout_s)
        self._dispatcher.let_go(_PAUSE)

    def work_off(self, timeout_s: float) -> bool:
        """Wait until everything is resolved that was accepted; return whether it is.

        Others may resume the service meanwhile, or stop it, and then nothing is waited for.
        """
        ledger, was_stopping = self._dispatcher.ledger, self.is_stopping

        def is_over() -> bool:
            return ledger.is_empty or not self.is_draining or self.is_stopping != was_stopping

        self._dispatcher.wait_for(is_over, timeout_s)
        return ledger.is_empty

    def give_up(self) -> None:
        """Report what could not be worked off, with the functions that it is in."""
        link, running = self._dispatcher.link, [entry.seq for entry in self._dispatcher.ledger.running()]
        functions = whereabouts(link, running).functions if link is not None and running else {}
        if running and link is not None:
            link.is_dismissed = True
            link.process.kill()
        self._dispatcher.give_up("the service stops", functions)
        self._dispatcher.publish()
