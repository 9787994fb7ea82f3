"""Does a service take events, and work on those that it has? Pause, drain, and what is left at the end."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

from epypes.errors import EpypesError
from epypes.service.dispatch import Dispatcher
from epypes.service.sockets import Sockets
from epypes.service.stuck import whereabouts

_PAUSE: Final = "pause"
_LEAVE_S: Final = 5.0
_LOOK_S: Final = 0.1

_log = logging.getLogger("epypes.service")


class Intake:
    """Where events come in, which can be closed and held up.

    Parameters
    ----------
    dispatcher, sockets
        Of the service.
    changed
        Called when its state may be another one.
    is_of_use
        Returns whether events are worked on, now or soon.

    Attributes
    ----------
    is_draining
        Whether it takes no more events.
    is_stopping
        Whether it will not again, since the service stops.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        sockets: Sockets,
        changed: Callable[[], None],
        is_of_use: Callable[[], bool],
    ) -> None:
        self._dispatcher, self._sockets = dispatcher, sockets
        self._changed, self._is_of_use = changed, is_of_use
        self.is_draining = self.is_stopping = False
        self._turn = threading.Lock()

    @property
    def is_paused(self) -> bool:
        """Whether events wait since somebody asked for it."""
        return self._dispatcher.is_held(_PAUSE)

    def pause(self) -> None:
        """Have events wait in the mailbox, or at their broker, where others may take them."""
        self._dispatcher.hold(_PAUSE)
        self.follow()
        _log.info("paused: events wait")
        self._changed()

    def resume(self) -> None:
        """Work on events again, and take them, after `pause` and `close`."""
        self._dispatcher.let_go(_PAUSE)
        if self.is_draining:
            self._open()
            self.is_draining = False
        else:
            self.follow()
        _log.info("resumed: events are taken and worked on")
        self._changed()

    def close(self, timeout_s: float, *, for_good: bool = False) -> None:
        """Take no more events."""
        self.is_draining, self.is_stopping = True, for_good
        _log.info("%s: no more events are taken", "stopping" if for_good else "draining")
        # First of all, so that nobody sends more.
        self._changed()
        self._dispatcher.is_closed = True
        with self._turn:
            self._sockets.entrance.close(timeout_s)
        self._dispatcher.let_go(_PAUSE)

    def _open(self) -> None:
        with self._turn:
            self._dispatcher.is_closed = False
            self._sockets.entrance.start()

    def leave(self, timeout_s: float) -> None:
        """Leave events to whoever else takes them from the broker, also those that it had sent already."""
        with self._turn:
            self._sockets.entrance.leave(timeout_s)

    def follow(self) -> None:
        """Take a broker's events if they will be worked on, and leave them to others if not; returns at once.

        On a thread of its own: to end a connection may take a while, and its thread may wait for who says this.
        """
        if self._dispatcher.ledger.waits:
            threading.Thread(target=self._follow, name="epypes intake", daemon=True).start()

    def _follow(self) -> None:
        with self._turn:
            try:
                if self._is_wanted():
                    self._dispatcher.is_closed = False
                    self._sockets.entrance.start()
                elif not self.is_draining:
                    self._leave_rest()
            except EpypesError as error:
                _log.error("%s", error)

    def _is_wanted(self) -> bool:
        return not (self.is_draining or self.is_paused) and self._is_of_use()

    def _leave_rest(self) -> None:
        """Leave to others what is not begun, once that is answered which is."""
        ledger = self._dispatcher.ledger
        self._dispatcher.is_closed = True
        while ledger.in_flight:
            self._dispatcher.wait_for(lambda: not ledger.in_flight, _LOOK_S)
            if self.is_draining or self._is_wanted():
                self._dispatcher.is_closed = self.is_draining
                return
        self._dispatcher.give_up("")
        self._sockets.entrance.leave(_LEAVE_S)

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
        """Report what could not be worked off, with the functions that it is in; or give it back to its broker."""
        ledger, link = self._dispatcher.ledger, self._dispatcher.link
        running = [entry.seq for entry in ledger.running()]
        is_told = link is not None and running and not ledger.waits
        functions = whereabouts(link, running).functions if link is not None and is_told else {}
        if running and link is not None:
            link.is_dismissed = True
            link.process.kill()
        self._dispatcher.give_up("the service stops", functions)
        self._dispatcher.publish()
