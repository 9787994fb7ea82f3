"""Who is told when a service is in another state? Listeners, whoever waits for it, and systemd."""

from __future__ import annotations

from collections.abc import Callable

from epypes.service.desk import Desk
from epypes.service.dispatch import Dispatcher
from epypes.service.notify import notify
from epypes.service.states import Facts, State, state_of


class Announcer:
    """Knows the state of a service, and tells when it is another one.

    Parameters
    ----------
    dispatcher, desk
        Of the service.
    facts
        Returns what the state is told from.
    follow
        Called with the state before and the one now, with the lock held; it must return at once.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        desk: Desk,
        facts: Callable[[], Facts],
        follow: Callable[[State, State], object],
    ) -> None:
        self._dispatcher, self._desk, self._facts, self._follow = dispatcher, desk, facts, follow
        self._told: tuple[State, str] = ("STOPPED", "")

    def state(self) -> tuple[State, str]:
        """Return the state, and why."""
        return state_of(self._facts())

    def look(self) -> None:
        """Tell listeners if the state is another one. With the lock held."""
        found = self.state()
        if found == self._told:
            return
        before, self._told = self._told, found
        data = {"state": found[0], "reason": found[1]}
        self._dispatcher.tell(lambda: self._desk.tell("state", data))
        self._dispatcher.changed.notify_all()
        self._follow(before[0], found[0])
        if found[0] == "READY":
            self._dispatcher.tell(lambda: notify("READY=1"))

    def changed(self) -> None:
        """Look, and tell now. Without the lock."""
        with self._dispatcher.changed:
            self.look()
        self._dispatcher.publish()
