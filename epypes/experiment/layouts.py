"""Layouts: how the three nodes are spread over processes.

Nodes, functions, graphs, f_in and f_out are the same in all of them. The robot is in the calling process.
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
from epypes.experiment.stations import (
    QUEUE_SIZE,
    START_TIMEOUT_S,
    ChildStation,
    Station,
    curve_options,
    new_address,
)
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


LAYOUTS: Final[Mapping[str, Layout]] = MappingProxyType(
    {
        "paper": Layout((("acquisition", "vision"),), in_children=True),
        "one": Layout((("acquisition", "vision"),), in_children=False),
        "three": Layout((("acquisition",), ("vision",)), in_children=True),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """A running layout, with the two queues of the robot.

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


@contextmanager
def running(layout: Layout, settings: Settings) -> Iterator[System]:
    """Run the nodes of a layout while the block runs.

    Raises
    ------
    ExperimentError
        A process or a node does not start.
    """
    requests = Mailbox("drop_oldest", QUEUE_SIZE)
    inbox: Any = queue.SimpleQueue()
    scheme = "tcp" if layout.in_children else "inproc"
    stations: list[Station | ChildStation] = []
    with ExitStack() as stack:
        publisher = ZMQPublisher(new_address(scheme), requests, **curve_options(settings, bind=True))
        stack.enter_context(publisher)
        for names in layout.processes:
            in_child = layout.in_children
            stations.append(ChildStation(names, settings, inbox.put) if in_child else Station(names, settings, scheme))
            stack.callback(stations[-1].stop)
        source, failures = publisher.address, []
        for station in stations:
            addresses = station.start(source)
            source = addresses["answers"]
            failures.append(addresses["failures"])
        for address in (source, *failures):
            subscriber = stack.enter_context(ZMQSubscriber(address, inbox, **curve_options(settings, bind=False)))
            if not subscriber.wait_joined(START_TIMEOUT_S):
                raise ExperimentError("robot", f"Nothing is published at {address}.")
        yield System(requests, inbox, tuple(stations))
