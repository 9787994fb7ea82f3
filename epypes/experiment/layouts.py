"""How are the three nodes spread over processes?

A layout says nothing else: nodes, functions, graphs, f_in and f_out are the same in all of them. The robot is in the
calling process.
"""

from __future__ import annotations

import queue
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from epypes.errors import ExperimentError
from epypes.experiment.components import Settings
from epypes.experiment.process import ChildStation
from epypes.experiment.station import KEPT, START_TIMEOUT_S, Station, address_for, guard_of
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber


@dataclass(frozen=True, slots=True)
class Layout:
    """Which nodes share a process.

    Attributes
    ----------
    processes
        For each process its nodes, in the order in which an event passes them. Nodes of one process are joined by
        queues, processes by sockets.
    in_children
        Whether these are processes of their own; otherwise there is one, the caller's.
    """

    processes: tuple[tuple[str, ...], ...]
    in_children: bool

    @property
    def scheme(self) -> str:
        """Of the sockets' addresses."""
        return "tcp" if self.in_children else "inproc"


LAYOUTS: Final[Mapping[str, Layout]] = MappingProxyType(
    {
        "paper": Layout((("acquisition", "vision"),), in_children=True),
        "one": Layout((("acquisition", "vision"),), in_children=False),
        "three": Layout((("acquisition",), ("vision",)), in_children=True),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """The two queues that the robot stands between, while everything runs.

    Attributes
    ----------
    requests
        Takes Events.
    inbox
        Gives answers (bytes), failures (Envelopes), and an ExperimentError when a process has ended.
    stations
        The other nodes, by process.
    """

    requests: Any
    inbox: Any
    stations: tuple[Station | ChildStation, ...]

    def described(self) -> dict[str, Mapping[str, Any]]:
        """Return what the nodes compute, by name."""
        return {name: node for station in self.stations for name, node in station.described().items()}


@contextmanager
def running(layout: Layout, settings: Settings) -> Iterator[System]:
    """Run the nodes of a layout while the block runs.

    Raises
    ------
    ExperimentError
        A process or a node does not start.
    """
    requests = Mailbox("drop_oldest", KEPT)
    inbox: Any = queue.SimpleQueue()
    with ExitStack() as stack:
        guard = guard_of(settings, bind=True)
        publisher = stack.enter_context(ZMQPublisher(address_for(layout.scheme), requests, **guard))
        stations: list[Station | ChildStation] = []
        for names in layout.processes:
            station = (
                ChildStation(names, settings, inbox.put)
                if layout.in_children
                else Station(names, settings, layout.scheme)
            )
            stack.callback(station.stop)
            stations.append(station)
        source = publisher.address
        heard = []
        for station in stations:
            addresses = station.start(source)
            source = addresses["answers"]
            heard.append(addresses["failures"])
        for address in (source, *heard):
            subscriber = stack.enter_context(ZMQSubscriber(address, inbox, **guard_of(settings, bind=False)))
            if not subscriber.wait_joined(START_TIMEOUT_S):
                raise ExperimentError("robot", f"Nobody publishes at {address}.")
        yield System(requests, inbox, tuple(stations))
