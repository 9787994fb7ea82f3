"""Where do a service's events come from, and where do answers and failures go? To sockets, or to brokers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from time import monotonic
from typing import Any, Final

from epypes.service.desk import Arrived
from epypes.service.entrances import Accepting, BrokerEntrance, SocketEntrance, entrance_of
from epypes.service.exits import BrokerExit, SocketExit, exit_to
from epypes.service.options import Options
from epypes.service.outcome import FAILURE_TOPIC

# For one end, however late it is.
_LEAST_S: Final = 0.5


class Sockets:
    """The ends of a service.

    Parameters
    ----------
    options
        Of the service: addresses and keys.
    accept
        Who takes what comes.
    on_change
        Called when a broker is away, or there again.

    Attributes
    ----------
    entrance, answers
        Where events come from, and where answers go.
    """

    def __init__(self, options: Options, accept: Accepting, on_change: Callable[[], object]) -> None:
        secured = {name: getattr(options, name) for name in ("insecure", "keys", "allow")}
        self.entrance = entrance_of(options, accept, secured, on_change)
        self.answers = exit_to(options.pub, "", secured, on_change)
        self._failures = exit_to(options.failures, FAILURE_TOPIC, secured, on_change)

    def start(self) -> None:
        """Open them; those that others may wait for first.

        Raises
        ------
        AddressError
            An address can't be bound, or a broker can't be reached.
        """
        try:
            self.answers.start()
            self._failures.start()
            self.entrance.open()
        except Exception:
            self.stop(1.0)
            raise

    def answer(self, item: Any, id: str, then: Arrived) -> None:  # noqa: A002 - as everywhere
        """Publish an answer, which is known by an id; tell when it has arrived."""
        self.answers.publish(item, id, then)

    def report(self, item: Any) -> None:
        """Publish a failure."""
        self._failures.publish(item, "", lambda error: None)

    def stop(self, timeout_s: float) -> None:
        """Close them, within one time for all; what was published still leaves.

        Brokers that may not answer have equal shares of it.
        """
        until_s, following = monotonic() + timeout_s, 0
        with ExitStack() as closing:
            # The last that is pushed is the first that is called; all are, whichever of them fails.
            for end in (self._failures, self.answers, self.entrance):
                closing.callback(_stop, end, until_s, 1 + following)
                following += isinstance(end, BrokerEntrance | BrokerExit)

    @property
    def addresses(self) -> dict[str, str]:
        """Where they are, ``connect:`` in front of those that connect; those that are bound once they are."""
        ends = {"sub": self.entrance, "pub": self.answers, "failures": self._failures}
        return {name: end.address for name, end in ends.items()}

    @property
    def trouble(self) -> str:
        """Why a broker is not there; empty if all are."""
        return self.entrance.trouble or self.answers.trouble or self._failures.trouble


def _stop(end: SocketEntrance | BrokerEntrance | SocketExit | BrokerExit, until_s: float, shares: int) -> None:
    end.stop(max((until_s - monotonic()) / shares, _LEAST_S))
