"""Where is it measured: which brokers are there, and what are places called at each?"""

from __future__ import annotations

import importlib
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from tests.benchmarks.brokers import amqp_by_hand, mqtt_by_hand, nats_by_hand, zmq_by_hand
from tests.benchmarks.brokers.parties import Meeting


@dataclass(frozen=True)
class Venue:
    """A transport.

    Attributes
    ----------
    name
        As the table shows it.
    by_hand
        The module that uses its client.
    server
        The module of tests/brokers that starts its broker; empty if there is none.
    replicas
        How many share the work, each time.
    settings
        What that module's ``server`` is told.
    """

    name: str
    by_hand: ModuleType
    server: str = ""
    replicas: Sequence[int] = (1, 3)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.name

    @property
    def is_brokered(self) -> bool:
        """Whether somebody keeps messages and shares them out."""
        return bool(self.server)

    def missing(self) -> str:
        """Return why it can't be measured; empty if it can."""
        if not self.server or importlib.import_module(f"tests.brokers.{self.server}").is_installed():
            return ""
        return f"{self.name} is not installed"

    @contextmanager
    def opened(self) -> Iterator[Callable[[str], tuple[Meeting, Meeting]]]:
        """Run its broker; give what makes a place to meet by hand, and one for us, with a name of their own."""
        if not self.server:
            yield lambda name: (_ports(), _ports())
            return
        with importlib.import_module(f"tests.brokers.{self.server}").server(**self.settings) as broker:
            yield lambda name: _places(broker, name)


def _places(broker: Any, name: str) -> tuple[Meeting, Meeting]:
    hand = Meeting(f"{name}-hand-events", f"{name}-hand-answers", broker.port, broker.user, broker.password)
    events, answers = (broker.address(f"{name}-{what}", create="true") for what in ("events", "answers"))
    return hand, Meeting(events, answers)


def _ports() -> Meeting:
    with ExitStack() as stack:
        held = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        events, answers = (f"tcp://127.0.0.1:{each.getsockname()[1]}" for each in held)
    return Meeting(events, answers)


# As it comes: those for tests have it write all that it has with each message.
_USUAL = {"settings": {"autosave_on_changes": "false", "autosave_interval": 1800, "log_type": "error"}}
ALL = (
    Venue("ZeroMQ", zmq_by_hand, replicas=(1,)),
    Venue("RabbitMQ", amqp_by_hand, "rabbitmq"),
    Venue("NATS JetStream", nats_by_hand, "nats"),
    Venue("MQTT", mqtt_by_hand, "mosquitto", settings=_USUAL),
)


def present() -> list[Venue]:
    """Return those that can be measured here."""
    return [venue for venue in ALL if not venue.missing()]
