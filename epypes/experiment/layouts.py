"""Layouts: how the three nodes are spread over processes, and the processes that run them.

Nodes, functions, graphs, f_in and f_out are the same in all layouts. The robot is in the calling process. Nodes of one
process are joined by in-process queues, processes by sockets.

A `ChildStation` starts ``python -m epypes.experiment.layouts``. It writes one line of JSON to the standard input of
the process: the nodes, their settings, and the address of their events. The process runs a `Station`, and writes one
line of JSON to its standard output: the addresses of its answers and failures. For each further line it writes the CPU
time that it has taken. It ends when its standard input is closed, which happens however its parent ends, so it never
outlives its parent.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from epypes.errors import EpypesError, ExperimentError
from epypes.experiment.nodes import COMPONENTS, Settings
from epypes.pipeline import Mailbox
from epypes.transport import Publisher, Subscriber

_START_TIMEOUT_S: Final = 30.0
# Messages that wait while a publisher is not connected: more than ever do, since the robot makes one request at a time.
_QUEUE_SIZE: Final = 64
# Longer than what a station waits for inside, whose error says better what was missing.
_ANSWER_TIMEOUT_S: Final = 3 * _START_TIMEOUT_S
_STOP_TIMEOUT_S: Final = 5.0
_PRINTED_CHARACTERS: Final = 100_000

# For each process of its own its nodes, in the order in which an event passes them; without such a process, they run in
# the caller's.
LAYOUTS: Final[Mapping[str, tuple[tuple[str, ...], ...]]] = MappingProxyType(
    {"paper": (("acquisition", "vision"),), "one": (), "three": (("acquisition",), ("vision",))}
)
# By transport an address for several processes, and one for a single process, each with room for a name of its own.
TRANSPORTS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "zeromq": ("tcp://127.0.0.1:*", "inproc://epypes-{}"),
        "dds": ("dds://0/epypes_{}",) * 2,
        "zenoh": ("zenoh://127.0.0.1/epypes/{}",) * 2,
    }
)


class Station:
    """The nodes of one process, with a subscriber before them, a publisher after them, and one for failures.

    Parameters
    ----------
    names
        The nodes in the order in which an event passes them.
    settings
        The options of the nodes.
    address
        Of `TRANSPORTS`.
    """

    cpu_s = 0.0

    def __init__(self, names: Sequence[str], settings: Settings, address: str) -> None:
        self._address, self._running = address, contextlib.ExitStack()
        self._q_in: Any = queue.SimpleQueue()
        # Mailboxes, whose items are sent by the thread that puts them: no other one has to wake up for that.
        self._q_out, self._q_failures = Mailbox("drop_oldest", _QUEUE_SIZE), Mailbox("drop_oldest", _QUEUE_SIZE)
        queues = [self._q_in, *(queue.SimpleQueue() for _ in names[1:]), self._q_out]
        self.nodes = [COMPONENTS[name](queues[i], queues[i + 1], settings) for i, name in enumerate(names)]
        for node in self.nodes:
            node.on_error = self._q_failures.put

    def start(self, source: str) -> dict[str, str]:
        """Start everything, and take events from an address; return the addresses of answers and of failures.

        Raises
        ------
        AddressError
            The address can't be connected to.
        ExperimentError
            A camera gives no frame, or nothing is published at the address.
        """
        enter = self._running.enter_context
        answers = enter(Publisher(_new_address(self._address), self._q_out))
        failures = enter(Publisher(_new_address(self._address), self._q_failures, topic="failures"))
        for node in reversed(self.nodes):
            enter(node)
        for node in self.nodes:
            if not node.wait_until_ready(_START_TIMEOUT_S):
                raise ExperimentError(node.name, f"The {node.name} node has no images after {_START_TIMEOUT_S:g} s.")
        subscriber = enter(Subscriber(source, self._q_in))
        if not subscriber.wait_joined(_START_TIMEOUT_S):
            raise ExperimentError(self.nodes[0].name, f"Nothing is published at {source}.")
        return {"answers": answers.address, "failures": failures.address}

    def stop(self) -> None:
        """Stop everything; may be called twice."""
        self._running.close()


def _new_address(address: str) -> str:
    """Return an address with a name that no other one has; a port of ZeroMQ is found when it is bound."""
    return address.format(uuid.uuid4().hex)


class ChildStation:
    """The nodes of one process, in a process of their own; started and stopped like a Station.

    The process is spawned at once, so that several load their libraries side by side.

    Parameters
    ----------
    names
        The nodes in the order in which an event passes them.
    settings
        The options of the nodes.
    address
        Of `TRANSPORTS`.
    on_end
        Called with an ExperimentError on a thread of its own, when the process ends and was not asked to.
    """

    def __init__(
        self, names: Sequence[str], settings: Settings, address: str, on_end: Callable[[ExperimentError], None]
    ) -> None:
        self.names, self.name, self.addresses = tuple(names), " and ".join(names), {"answers": "", "failures": ""}
        self._settings, self._address, self._on_end, self._stopping = settings, address, on_end, False
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        # A file takes any amount without a reader, as a pipe does not.
        self._printed = tempfile.NamedTemporaryFile()  # noqa: SIM115 - closed by stop()
        self._process: subprocess.Popen[str] = subprocess.Popen(
            [sys.executable, "-m", "epypes.experiment.layouts"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            text=True,
            # Ctrl+C is for this process, which then ends the others in order.
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._stdin: Any = self._process.stdin
        self._stdout: Any = self._process.stdout
        self._watcher = threading.Thread(target=self._watch, name=f"epypes {self.name}", daemon=True)
        self._watcher.start()

    def start(self, source: str) -> dict[str, str]:
        """Start everything; return the addresses of answers and of failures.

        Raises
        ------
        ExperimentError
            The process has ended, or answers nothing; its last output is in the text.
        """
        request = {"nodes": self.names, "settings": asdict(self._settings), "address": self._address, "source": source}
        self.addresses = json.loads(self._ask(json.dumps(request)))
        return self.addresses

    @property
    def cpu_s(self) -> float:
        """The CPU time that the process has taken, in seconds."""
        return float(self._ask("cpu"))

    def _ask(self, line: str) -> str:
        with contextlib.suppress(OSError):  # the process has ended: its line is empty
            print(line, file=self._stdin, flush=True)
        try:
            line = self._lines.get(timeout=_ANSWER_TIMEOUT_S)
        except queue.Empty:
            text = f"The process of {self.name} ({self.pid}) does not answer within {_ANSWER_TIMEOUT_S:g} s."
            raise ExperimentError(self.name, text, self._read_printed()) from None
        if not line:
            self._watcher.join()
            raise self._ended()
        return line

    def stop(self, timeout_s: float = _STOP_TIMEOUT_S) -> None:
        """Let the process end; it is killed if it takes longer than ``timeout_s``. May be called twice."""
        self._stopping = True
        with contextlib.suppress(OSError):
            self._stdin.close()
        self._watcher.join(timeout_s)
        if self._watcher.is_alive():
            self._process.kill()
            self._watcher.join()
        self._stdout.close()
        self._printed.close()

    def _watch(self) -> None:
        for line in self._stdout:
            self._lines.put(line)
        self._lines.put("")
        self._process.wait()
        if not self._stopping:
            self._on_end(self._ended())

    def _ended(self) -> ExperimentError:
        """Return the error for a process that has ended by itself."""
        status, printed = self._process.returncode, self._read_printed()
        how = f"ended with exit status {status}" if status >= 0 else f"was ended by {signal.Signals(-status).name}"
        last = printed.strip().rpartition("\n")[2]
        text = f"The process of {self.name} ({self.pid}) {how}{': ' + last if last else '.'}"
        return ExperimentError(self.name, text, printed)

    def _read_printed(self) -> str:
        return Path(self._printed.name).read_text(encoding="utf-8", errors="replace")[-_PRINTED_CHARACTERS:]

    def __repr__(self) -> str:
        return f"<ChildStation {self.name}: process {self.pid}>"


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

    @property
    def cpu_s(self) -> float:
        """The CPU time that all processes have taken, in seconds."""
        return time.process_time() + sum(station.cpu_s for station in self.stations)


@contextlib.contextmanager
def running(processes: Sequence[Sequence[str]], settings: Settings, transport: str = "zeromq") -> Iterator[System]:
    """Run the nodes of a layout, one of `LAYOUTS`, over one of `TRANSPORTS`, while the block runs.

    Raises
    ------
    ExperimentError
        A process or a node does not start.
    """
    requests = Mailbox("drop_oldest", _QUEUE_SIZE)
    inbox: Any = queue.SimpleQueue()
    address = TRANSPORTS[transport][not processes]
    stations: list[Station | ChildStation] = []
    with contextlib.ExitStack() as stack:
        source, failures = stack.enter_context(Publisher(_new_address(address), requests)).address, []
        for names in processes:
            stations.append(ChildStation(names, settings, address, inbox.put))
            stack.callback(stations[-1].stop)
        if not processes:
            stations.append(Station(tuple(COMPONENTS), settings, address))
            stack.callback(stations[-1].stop)
        for station in stations:
            addresses = station.start(source)
            source = addresses["answers"]
            failures.append(addresses["failures"])
        for address in (source, *failures):
            subscriber = stack.enter_context(Subscriber(address, inbox))
            if not subscriber.wait_joined(_START_TIMEOUT_S):
                raise ExperimentError("robot", f"Nothing is published at {address}.")
        yield System(requests, inbox, tuple(stations))


def _run_station() -> None:
    """Run the nodes that standard input names until it is closed."""
    # A line that a camera's library prints must not be taken for the answer.
    answer = os.dup(1)
    os.dup2(2, 1)
    # Without a buffer, whose lock the thread below would hold when the interpreter ends.
    parent = open(0, "rb", buffering=0, closefd=False)  # noqa: SIM115 - until the process ends
    line = parent.readline()
    if not line:
        return
    request: dict[str, Any] = json.loads(line)
    has_ended = threading.Event()

    def end_with_parent() -> None:
        while parent.readline():
            os.write(answer, f"{time.process_time()}\n".encode())
        has_ended.set()
        # A camera that does not open may hold the main thread for ever.
        time.sleep(_STOP_TIMEOUT_S)
        os._exit(1)

    threading.Thread(target=end_with_parent, name="epypes parent", daemon=True).start()
    station = Station(request["nodes"], Settings(**request["settings"]), request["address"])
    try:
        os.write(answer, f"{json.dumps(station.start(request['source']))}\n".encode())
        has_ended.wait()
    finally:
        station.stop()


if __name__ == "__main__":
    try:
        _run_station()
    except EpypesError as error:
        sys.exit(f"{type(error).__name__}: {error}")
