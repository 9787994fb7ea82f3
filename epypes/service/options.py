"""Options of a service, and which of them exclude each other."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from epypes.errors import ServiceError
from epypes.service.event_states import StatePer
from epypes.transport.address import Address, is_broker, parse_address

if TYPE_CHECKING:
    from opentelemetry.trace import TracerProvider

    from epypes.transport.zeromq.curve import Keys, PublicKey

MailboxPolicy = Literal["latest", "drop_oldest", "fault"]
POLICIES: Final = get_args(MailboxPolicy)
STATES_PER: Final = get_args(StatePer)
ANY_PORT: Final = "tcp://127.0.0.1:*"
MAX_THREADS: Final = 64


@dataclass(frozen=True, slots=True)
class Options:
    """How a bundle is served.

    Attributes
    ----------
    sub, pub, failures
        Addresses where events come from, where answers go, and where failures are published with the topic
        ``failure``: an address is bound, ``connect:ADDRESS`` is connected to. ``tcp://127.0.0.1:*`` takes any free
        port. Or the address of a broker, as ``amqp://HOST/QUEUE``.
    threads
        How many events are worked on at once; answers keep the order of the events, with a state per source that of the
        events of each source.
    job_timeout_s
        How long an event may take, in seconds. An event that takes longer has failed, and the worker is replaced.
    retries
        How often an event that killed the worker while it was alone is tried again.
    drain_timeout_s
        How long `stop` works on accepted events, in seconds.
    mailbox_policy, mailbox_size
        What happens when more events wait: ``"drop_oldest"``, ``"latest"`` (of size 1) or ``"fault"``, which refuses
        the new one. Each event that is dropped is counted and answered.
    insecure, keys, allow
        As for ZMQSubscriber and ZMQPublisher.
    store
        Where a row of each event is kept: a SQLite file or a database's URL. Nothing waits for it.
    replica
        Name among the services of the bundle that share the events of a broker.
    state_per
        Of a bundle with state between events: ``"one"`` state for all events, or one for each ``"source"`` of them.
    partitioned
        Whether the broker delivers all events of one source to one replica, so that replicas may have state.
    tracer_provider
        Of OpenTelemetry: each event is a span of it; None for that which is set for this process, if there is one.
        Give it a BatchSpanProcessor: a SimpleSpanProcessor has the service wait for its exporter, span by span.
    """

    sub: str = ANY_PORT
    pub: str = ANY_PORT
    failures: str = ANY_PORT
    threads: int = 1
    job_timeout_s: float = 30.0
    retries: int = 1
    drain_timeout_s: float = 5.0
    mailbox_policy: MailboxPolicy = "drop_oldest"
    mailbox_size: int = 8
    insecure: bool = False
    keys: Keys | str | Path | None = None
    allow: PublicKey | Collection[PublicKey] | None = None
    store: str | Path | None = None
    replica: str = ""
    state_per: StatePer = "one"
    partitioned: bool = False
    tracer_provider: TracerProvider | None = None

    @property
    def has_broker(self) -> bool:
        """Whether events come from a broker, which keeps each until it is answered."""
        return is_broker(self.sub)

    @property
    def shows_failures(self) -> bool:
        """Whether the address of failures is shown: with a broker failures arrive as answers anyway."""
        return not self.has_broker or self.failures != ANY_PORT

    @property
    def prefetch(self) -> int:
        """How many events of a broker the service has at a time, at most.

        No more than it works on: a broker counts the delivery of an event that waits beside them when the replica is
        killed, too, and would make it a dead letter in the end.
        """
        return self.threads

    @property
    def capacity(self) -> int:
        """How many events may wait. There is always room for the events that a broker has delivered."""
        return max(self.mailbox_size, self.prefetch) if self.has_broker else self.mailbox_size

    def check(self, path: str | Path) -> None:
        """Raise ServiceError, or AddressError, for what a bundle can't be served with."""
        if not 1 <= self.threads <= MAX_THREADS:
            text = f"A service works on 1 to {MAX_THREADS} events at once, not on {self.threads}."
            raise ServiceError(path, text)
        if not (math.isfinite(self.job_timeout_s) and self.job_timeout_s > 0):
            least = f"An event may take a number of seconds above 0, not {self.job_timeout_s}."
            raise ServiceError(path, f"{least} For one that takes long: 3600.")
        if not (math.isfinite(self.drain_timeout_s) and self.drain_timeout_s >= 0):
            raise ServiceError(path, f"Draining takes a number of seconds from 0, not {self.drain_timeout_s}.")
        if self.mailbox_policy not in POLICIES:
            known = ", ".join(map(repr, POLICIES))
            text = f"A service has no mailbox of policy {self.mailbox_policy!r}, and can't make its peers wait."
            raise ServiceError(self.mailbox_policy, f"{text} Take {known}.")
        if self.mailbox_size < 1 or (self.mailbox_policy == "latest" and self.mailbox_size != 1):
            text = f"A mailbox with policy {self.mailbox_policy!r} can't have size {self.mailbox_size}."
            raise ServiceError(self.mailbox_size, text)
        if not self.has_broker and self.replica:
            text = "A service has a name as a replica where it shares the events of a broker: with --sub amqp://,"
            raise ServiceError(path, f"{text} nats:// or mqtt://.")
        if self.has_broker and self.mailbox_policy != "drop_oldest":
            text = f"A broker keeps what waits, so mailbox {self.mailbox_policy!r} drops nothing. Leave that out."
            raise ServiceError(path, text)
        if self.state_per not in STATES_PER:
            known = " or ".join(map(repr, STATES_PER))
            raise ServiceError(self.state_per, f"State is kept per {known}, not per {self.state_per!r:.80}.")
        if self.partitioned and not (self.has_broker and self.state_per == "source"):
            text = "Events are partitioned by source where a broker delivers them, and each source has a state:"
            raise ServiceError(path, f"{text} with --state-per source, and --sub amqp://, nats:// or mqtt://.")
        # ZeroMQ would show an address that it does not know, with the password in it.
        addresses = [parse_address(each) for each in (self.sub, self.pub, self.failures)]
        if self.has_broker and any(_is_same(addresses[0], place) for place in addresses[1:]):
            text = (
                f"The answers of a service would be its next events: --sub and another address are the same, "
                f"{addresses[0]}. Give answers and failures addresses of their own."
            )
            raise ServiceError(path, text)


def _is_same(one: Address, other: Address) -> bool:
    """Whether what is sent to one address of a broker comes out of another."""
    return all(getattr(one, name) == getattr(other, name) for name in ("scheme", "host", "port", "vhost", "name"))
