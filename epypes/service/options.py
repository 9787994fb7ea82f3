"""What is a service given when it is started, and what can't it be given?"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from epypes.errors import ServiceError
from epypes.service.ledger import Ledger, Policy
from epypes.transport.channels import Place, is_brokered, place_of

if TYPE_CHECKING:
    from epypes.transport.zeromq.curve import Keys, PublicKey

ANY_PORT: Final = "tcp://127.0.0.1:*"
CONNECT: Final = "connect:"
MOST_THREADS: Final = 64
# Answers wait for those of other replicas, and others are computed meanwhile.
_AHEAD_ORDERED: Final = 64


@dataclass(frozen=True, slots=True)
class Options:
    """How a bundle is served.

    Attributes
    ----------
    sub, pub, failures
        Where events come from, where answers go, and where failures are published with the topic ``failure``: an
        address is bound, ``connect:ADDRESS`` is connected to. ``tcp://127.0.0.1:*`` takes any free port. Or a place of
        a broker, as ``amqp://HOST/QUEUE``; see `epypes.transport.channels.place_of`.
    threads
        How many events are worked on at once; answers keep the order of the events.
    job_timeout_s
        How long an event may take, in seconds. One that takes longer has failed, and the worker is replaced.
    retries
        How often an event that killed the worker while it was alone is tried again.
    drain_timeout_s
        How long `stop` works off what was accepted, in seconds.
    mailbox_policy, mailbox_size
        What happens when more events wait: ``"drop_oldest"``, ``"latest"`` (of size 1) or ``"fault"``, which refuses
        the new one. Each that is dropped is counted and answered.
    insecure, keys, allow
        As for ZMQSubscriber and ZMQPublisher.
    store
        Where a row of each event is kept: a SQLite file or a database's URL. Nothing waits for it.
    replica
        What it is called among the services of the bundle that share the events of a broker.
    ordered
        Whether answers keep the order of the events over all replicas.
    """

    sub: str = ANY_PORT
    pub: str = ANY_PORT
    failures: str = ANY_PORT
    threads: int = 1
    job_timeout_s: float = 30.0
    retries: int = 1
    drain_timeout_s: float = 5.0
    mailbox_policy: Policy = "drop_oldest"
    # How many events wait while one is computed.
    mailbox_size: int = 8
    insecure: bool = False
    keys: Keys | str | Path | None = None
    allow: PublicKey | Collection[PublicKey] | None = None
    store: str | Path | None = None
    replica: str = ""
    ordered: bool = False

    @property
    def has_broker(self) -> bool:
        """Whether events come from a broker, who keeps each until it is answered."""
        return is_brokered(bare(self.sub))

    @property
    def is_confirmed(self) -> bool:
        """Whether it is told when an answer, or an event's end, has arrived with a broker."""
        return self.has_broker or is_brokered(bare(self.pub))

    @property
    def shows_failures(self) -> bool:
        """Whether anybody asks where failures are published: they arrive as answers at a broker anyway."""
        return not self.has_broker or self.failures != ANY_PORT

    @property
    def prefetch(self) -> int:
        """How many events of a broker it has at a time, at most.

        No more than it works on: one that waits beside them counts as delivered too when the replica is killed, and
        would be put aside in the end, without any fault of its own.
        """
        return self.threads + (_AHEAD_ORDERED if self.ordered else 0)

    def ledger(self) -> Ledger:
        """Return what keeps account of events. What a broker has delivered, there is always room for."""
        return Ledger(
            self.mailbox_policy,
            max(self.mailbox_size, self.prefetch) if self.has_broker else self.mailbox_size,
            self.threads,
            self.retries,
            waits=self.has_broker,
            is_confirmed=self.is_confirmed,
        )

    def check(self, path: str | Path) -> None:
        """Raise ServiceError, or AddressError, for what a bundle can't be served with."""
        if not 1 <= self.threads <= MOST_THREADS:
            text = f"A service works on 1 to {MOST_THREADS} events at once, not on {self.threads}."
            raise ServiceError(path, text)
        if not (math.isfinite(self.job_timeout_s) and self.job_timeout_s > 0):
            least = f"An event may take a number of seconds above 0, not {self.job_timeout_s}."
            raise ServiceError(path, f"{least} For one that takes long: 3600.")
        if not (math.isfinite(self.drain_timeout_s) and self.drain_timeout_s >= 0):
            raise ServiceError(path, f"Draining takes a number of seconds from 0, not {self.drain_timeout_s}.")
        self._check_broker(path)
        self._check_addresses(path)

    def _check_broker(self, path: str | Path) -> None:
        if not self.has_broker and (self.replica or self.ordered):
            what = "has a name as a replica" if self.replica else "keeps the order over all replicas"
            text = f"A service {what} where it shares the events of a broker: with --sub amqp://, nats:// or mqtt://."
            raise ServiceError(path, text)
        if self.has_broker and self.mailbox_policy != "drop_oldest":
            text = f"A broker keeps what waits, so mailbox {self.mailbox_policy!r} drops nothing. Leave that out."
            raise ServiceError(path, text)

    def _check_addresses(self, path: str | Path) -> None:
        # ZeroMQ would show an address that it does not know, with the password in it.
        known = [place_of(bare(address)) for address in (self.sub, self.pub, self.failures) if _is_checked(address)]
        if self.has_broker and any(_is_same(known[0], place) for place in known[1:]):
            text = f"What a service says would be its next event: --sub and another address are the same, {known[0]}."
            raise ServiceError(path, f"{text} Give answers and failures places of their own.")


def _is_checked(address: str) -> bool:
    return "://" in address and not bare(address).startswith("inproc:")


def _is_same(one: Place, other: Place) -> bool:
    """Whether what is sent to one place of a broker comes out of another."""
    return all(getattr(one, name) == getattr(other, name) for name in ("scheme", "host", "port", "vhost", "name"))


def bare(address: str) -> str:
    """Return an address without what says that it is connected to."""
    return address.removeprefix(CONNECT)
