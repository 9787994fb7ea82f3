"""How does a service take part in a group? By what it does with its events and its parameters; or it stands alone."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

from epypes.service.desk import Desk
from epypes.service.dispatch import Dispatcher
from epypes.service.entrances import BrokerEntrance, SocketEntrance
from epypes.service.group.group import Group
from epypes.service.group.membership import Heard, Member, summary, told
from epypes.service.ledger import Entry
from epypes.service.options import Options, bare
from epypes.service.parameters import Parameters
from epypes.service.tuning import Tuning
from epypes.transport.channels import place_of

_JOINING: Final = "joining the group"
# So long events wait at most for the replica to read what the others have agreed on.
_JOIN_S: Final = 5.0
_MOST_REASON: Final = 500


@dataclass(frozen=True, slots=True)
class Parts:
    """What of a service its group is told, and acts on.

    Attributes
    ----------
    options
        How it is served.
    dispatcher, desk, tuning
        Its events, who tells what has become of them, its parameters.
    about
        Returns what its name, state, counts and address are, as fields of `Member`.
    entrance
        Where its events come from.
    changed
        Called when the service's state may be another one.
    """

    options: Options
    dispatcher: Dispatcher
    desk: Desk
    tuning: Tuning
    about: Callable[[], Mapping[str, Any]]
    entrance: SocketEntrance | BrokerEntrance
    changed: Callable[[], object]

    def member(self, id: str = "") -> Member:  # noqa: A002
        """Return what there is to say of this service."""
        said = dict(self.about())
        said["reason"] = str(said.get("reason", ""))[:_MOST_REASON]
        ours: dict[str, Any] = {"replica": self.options.replica, "host": socket.gethostname(), "pid": os.getpid()}
        ours["ordered"] = self.options.ordered
        served: dict[str, Any] = {"digest": self.tuning.digest, "revision": self.tuning.current.revision}
        return Member(id, **ours, **served, **said)


class Alone:
    """A service that shares its events with nobody."""

    is_joining = False

    def __init__(self, parts: Parts) -> None:
        self._parts = parts

    def start(self) -> None:
        """Do nothing."""

    def give_up(self) -> None:
        """Do nothing."""

    def stop(self, timeout_s: float) -> None:
        """Do nothing."""

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change parameters; see `Service.set_parameters`."""
        return self._parts.tuning.set(values, revision)

    def told(self) -> dict[str, Any]:
        """Return what there is to know of the group, of which this is the one member; JSON-ready."""
        present = [Heard(self._parts.member(), 0.0)]
        heard = {"trouble": "", "rejected": 0, "members": [told(present[0], is_self=True)], "lost": []}
        return {"is_shared": False, **summary(present), **heard}

    def counts(self) -> dict[str, int]:
        """Return what is counted besides: nothing."""
        return {}


class Peers:
    """A service that shares the events of a broker with other replicas of its bundle.

    Attributes
    ----------
    is_joining
        Whether its events wait until the parameters are read that the others have agreed on.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._place = place_of(bare(parts.options.sub))
        self._overtaking: set[int] = set()
        self._joining_until_s = 0.0
        self.is_joining = False
        self._group = self._made()
        parts.tuning.agreed = lambda digest: self._group.agreement.taken_over(digest)
        parts.dispatcher.on_accepted = lambda event: self._group.arrived(event)
        parts.dispatcher.on_done = self._done
        if parts.options.ordered:
            parts.desk.in_turn = self._in_turn

    def _made(self) -> Group:
        options, parts = self._parts.options, self._parts
        timeout_s = options.job_timeout_s if options.ordered else None
        seen, make_room = parts.entrance.seen, parts.entrance.make_room
        return Group(self._place, parts.member, parts.tuning, seen, self._changed, make_room, timeout_s)

    # -- beginning and end --------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Take part, as soon as the broker is there; events wait for a while until the others' parameters are known."""
        self._group = self._made()
        self._joining_until_s, self.is_joining = monotonic() + _JOIN_S, True
        self._parts.dispatcher.hold(_JOINING)
        self._group.start()

    def give_up(self) -> None:
        """Let no more answers through that wait for their turn: their events are given back."""
        self._group.give_up()

    def stop(self, timeout_s: float) -> None:
        """Leave the group; bounded by ``timeout_s``."""
        self._group.stop(timeout_s)
        self._let_go()

    def _changed(self) -> None:
        if self.is_joining and (self._group.agreement.is_current or monotonic() > self._joining_until_s):
            self._let_go()

    def _let_go(self) -> None:
        self.is_joining = False
        self._parts.dispatcher.let_go(_JOINING)
        self._parts.changed()

    # -- events -------------------------------------------------------------------------------------------------------

    def _in_turn(self, entry: Entry, publish: Callable[[], object]) -> None:
        def let_through(has_overtaken: bool) -> None:
            if has_overtaken:
                self._overtaking.add(entry.seq)
            publish()

        self._group.wait_turn(entry.event, let_through)

    def _done(self, entry: Entry, acknowledge: Callable[[], object]) -> None:
        has_overtaken = entry.seq in self._overtaking
        self._overtaking.discard(entry.seq)
        # What was put aside nobody else may call done: if the broker has not heard of it, it would be no dead letter.
        is_aside = entry.outcome == "dead_letters"
        self._group.done(entry.event, has_overtaken, is_aside=is_aside, acknowledge=acknowledge)

    # -- what is asked ------------------------------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change parameters in all replicas; see `Service.set_parameters`."""
        return self._group.agreement.set(values, revision)

    def told(self) -> dict[str, Any]:
        """Return what there is to know of the group, JSON-ready."""
        return {"is_shared": True, **self._group.told()}

    def counts(self) -> dict[str, int]:
        """Return how many answers have overtaken others, where they keep their order."""
        return {"overtaken": self._group.overtaken} if self._parts.options.ordered else {}


def peers_of(parts: Parts) -> Alone | Peers:
    """Return how a service takes part in a group, if there can be one."""
    return Peers(parts) if parts.options.has_broker else Alone(parts)
