"""How do the nodes of one process stand between its sockets?

Nodes of one process are joined by in-process queues. At its edges what travels is turned into messages and back:
the nodes see no difference.
"""

from __future__ import annotations

import queue
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final

from epypes.errors import ExperimentError
from epypes.experiment.components import NODES, Component, Settings
from epypes.experiment.messages import Request, envelope_of, pair_of
from epypes.pipeline import Mailbox
from epypes.transport import ZMQPublisher, ZMQSubscriber, read_keys

START_TIMEOUT_S: Final = 30.0
# What waits to be sent while a publisher is not there: more than ever does, since the robot asks one thing at a time.
KEPT: Final = 64

# What the first node of a process takes from its subscriber, and what the last gives to its publisher.
_FROM_SOCKET: Final[Mapping[str, Callable[[Any], Any]]] = {"acquisition": Request, "vision": pair_of}
_TO_SOCKET: Final[Mapping[str, Callable[[Any], Any]]] = {"acquisition": envelope_of, "vision": lambda answer: answer}


class Adapted:
    """The putting end of a queue, which turns every item into something else."""

    def __init__(self, queue: Any, convert: Callable[[Any], Any]) -> None:
        self._queue, self._convert = queue, convert

    def put(self, item: Any, block: bool = True) -> None:
        """Convert an item, and put it on the queue."""
        self._queue.put(self._convert(item), block=block)


class Station:
    """The nodes of one process, with a subscriber before them, a publisher after them, and one for failures.

    Parameters
    ----------
    names
        The nodes in the order in which an event passes them.
    settings
        What they are made with.
    scheme
        ``"tcp"``, or ``"inproc"`` for sockets within this process.
    """

    def __init__(self, names: Sequence[str], settings: Settings, scheme: str) -> None:
        self._scheme, self._settings = scheme, settings
        self._running = ExitStack()
        self._q_in: Any = queue.SimpleQueue()
        # Mailboxes, whose items are sent by the thread that puts them: no other one has to wake up for that.
        self._q_out, self._q_failures = Mailbox("drop_oldest", KEPT), Mailbox("drop_oldest", KEPT)
        joints = [self._q_in, *(queue.SimpleQueue() for _ in names[1:]), Adapted(self._q_out, _TO_SOCKET[names[-1]])]
        self.nodes = [
            NODES[name](before, after, settings)
            for name, before, after in zip(names, joints[:-1], joints[1:], strict=True)
        ]
        self._entrance = Adapted(self._q_in, _FROM_SOCKET[names[0]])
        for node in self.nodes:
            node.on_error = self._q_failures.put

    def start(self, source: str) -> dict[str, str]:
        """Start everything, and take events from an address; return the addresses of answers and of failures.

        Raises
        ------
        AddressError
            The address can't be connected to.
        ExperimentError
            A camera gives no frame, or nobody answers at the address.
        """
        enter = self._running.enter_context
        bound, joined = guard_of(self._settings, bind=True), guard_of(self._settings, bind=False)
        answers = enter(ZMQPublisher(address_for(self._scheme), self._q_out, **bound))
        failures = enter(ZMQPublisher(address_for(self._scheme), self._q_failures, topic="failures", **bound))
        for node in reversed(self.nodes):
            enter(node)
        for node in self.nodes:
            if not node.wait_until_ready(START_TIMEOUT_S):
                raise ExperimentError(node.name, f"The {node.name} node has no images after {START_TIMEOUT_S:g} s.")
        subscriber = enter(ZMQSubscriber(source, self._entrance, **joined))
        if not subscriber.wait_joined(START_TIMEOUT_S):
            raise ExperimentError(self.nodes[0].name, f"Nobody publishes at {source}.")
        return {"answers": answers.address, "failures": failures.address}

    def stop(self) -> None:
        """Stop everything; may be called twice."""
        self._running.close()

    def described(self) -> dict[str, Mapping[str, Any]]:
        """Return what the nodes compute, by name: the same in every layout."""
        return {node.name: described(node) for node in self.nodes}


def described(node: Component) -> Mapping[str, Any]:
    """Return the graph of a node, and where its functions, f_in and f_out are defined."""
    return {
        "functions": {name: _place(function) for name, function in node.cg.functions.items()},
        "func_io": {name: str(io) for name, io in node.cg.func_io.items()},
        "f_in": _place(node.f_in),
        "f_out": [_place(node.f_out), _place(node.pack)],
    }


def _place(function: Any) -> str:
    return f"{function.__module__}.{function.__qualname__}"


def guard_of(settings: Settings, *, bind: bool) -> dict[str, Any]:
    """Return ``keys`` and ``allow`` for a socket of a node: all nodes have one pair, and know each other by it.

    Raises
    ------
    KeysError
        The keys can't be read.
    """
    if not settings.keys:
        return {}
    own = read_keys(settings.keys)
    return {"keys": own, "allow": [own, *settings.allow] if bind else own}


def address_for(scheme: str) -> str:
    """Return an address that can be bound: a free port of this machine, or a new name within this process."""
    return "tcp://127.0.0.1:*" if scheme == "tcp" else f"inproc://epypes-{uuid.uuid4().hex}"
