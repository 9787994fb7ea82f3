"""Which sockets does a service have? One where events come in, one for answers, one for failures."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

from epypes.pipeline import Mailbox
from epypes.service.outcome import FAILURE_TOPIC
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.transport.keys import Keys, PublicKey

CONNECT: Final = "connect:"
# Answers kept for a subscriber that does not read; images are large, so this bounds the memory that one can cost.
_KEPT_ANSWERS: Final = 256


class Sockets:
    """The sockets of a service.

    Parameters
    ----------
    sub, pub, failures
        An address is bound, ``connect:ADDRESS`` is connected to.
    accept
        Whose ``put`` takes what comes.
    insecure, keys, allow
        As for ZMQSubscriber and ZMQPublisher.

    Attributes
    ----------
    subscriber, publisher, reporter
        The sockets.
    """

    def __init__(
        self,
        sub: str,
        pub: str,
        failures: str,
        accept: Any,
        *,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
    ) -> None:
        self._given = {"sub": sub, "pub": pub, "failures": failures}
        self._accept = accept
        self._secured: dict[str, Any] = {"insecure": insecure, "keys": keys, "allow": allow}
        self._rejected_before = 0
        # Sent within put, on the thread that puts.
        self._answers, self._failures = Mailbox("drop_oldest", _KEPT_ANSWERS), Mailbox("drop_oldest", _KEPT_ANSWERS)
        self._closed_at = ""
        self.subscriber = self._made_subscriber(sub)
        self.publisher = self._made_publisher(pub, self._answers, "")
        self.reporter = self._made_publisher(failures, self._failures, FAILURE_TOPIC)

    def _made_subscriber(self, address: str) -> ZMQSubscriber:
        return ZMQSubscriber(_bare(address), self._accept, "", not address.startswith(CONNECT), **self._secured)

    def _made_publisher(self, address: str, queue: Mailbox, topic: str) -> ZMQPublisher:
        bind = not address.startswith(CONNECT)
        return ZMQPublisher(_bare(address), queue, topic, bind, high_water_mark=_KEPT_ANSWERS, **self._secured)

    def start(self) -> None:
        """Open them; those that others may wait for first.

        Raises
        ------
        AddressError
            An address can't be bound.
        """
        self._closed_at = ""
        try:
            self.publisher.start()
            self.reporter.start()
            self.subscriber.start()
        except Exception:
            self.stop(1.0)
            raise

    def answer(self, item: Any) -> None:
        """Publish an answer."""
        self._answers.put(item)

    def report(self, item: Any) -> None:
        """Publish a failure."""
        self._failures.put(item)

    def close_subscriber(self, timeout_s: float) -> None:
        """Take no more events; may be called twice."""
        self._closed_at = self.addresses["sub"]
        self.subscriber.stop(timeout_s)

    def open_subscriber(self) -> None:
        """Take events again, at the address where they were taken before."""
        self._rejected_before = self.rejected
        self.subscriber = self._made_subscriber(self._closed_at)
        self.subscriber.start()
        self._closed_at = ""

    def stop(self, timeout_s: float) -> None:
        """Close them; what was published still leaves."""
        try:
            self.subscriber.stop(timeout_s)
        finally:
            try:
                self.publisher.stop(timeout_s)
            finally:
                self.reporter.stop(timeout_s)

    @property
    def addresses(self) -> dict[str, str]:
        """Where they are, ``connect:`` in front of those that connect; those that are bound once they are.

        Where events are not taken just now, it is where they were taken, and will be again.
        """
        sub = self._closed_at or self.subscriber.address
        bound = {"sub": sub, "pub": self.publisher.address, "failures": self.reporter.address}
        return {name: given if given.startswith(CONNECT) else bound[name] for name, given in self._given.items()}

    @property
    def rejected(self) -> int:
        """How many messages were no events."""
        return self._rejected_before + sum(self.subscriber.rejected.values())


def _bare(address: str) -> str:
    return address.removeprefix(CONNECT)
