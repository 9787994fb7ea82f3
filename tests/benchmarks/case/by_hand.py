"""How does a robot ask a vision process that is not of this EPypes?"""

from __future__ import annotations

import json
import subprocess
import sys
from time import perf_counter, time
from types import TracebackType
from typing import Self

import zmq

from epypes.wire import Event, JustBytes

_TIMEOUT_MS = 10_000


class ByHand:
    """A vision process, hand-written or of the published package, and the robot's two sockets to it.

    Parameters
    ----------
    argument
        The number of threads; of the published package its folder.
    module
        Which process.
    """

    def __init__(self, argument: int | str, module: str = "hand_vision") -> None:
        command = [sys.executable, "-m", f"tests.benchmarks.case.{module}", str(argument)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._count = 0

    def __enter__(self) -> Self:
        assert self.process.stdout is not None
        addresses = json.loads(self.process.stdout.readline())
        self._context = zmq.Context()
        self._requests, self._responses = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._responses.subscribe(b"")
        self._requests.connect(addresses["requests"])
        self._responses.connect(addresses["responses"])
        while not self._responses.poll(100):  # until both have joined
            self._requests.send(self._event())
        while self._responses.poll(500):
            self._responses.recv()
        return self

    def ask(self) -> tuple[float, JustBytes]:
        """Return the seconds from a request to its answer, and the answer."""
        start = perf_counter()
        self._requests.send(self._event())
        if not self._responses.poll(_TIMEOUT_MS):
            raise TimeoutError("The hand-written vision process does not answer.")
        data = self._responses.recv()
        return perf_counter() - start, JustBytes.FromString(data)

    def _event(self) -> bytes:
        self._count += 1
        event = Event(type="vision request", id=str(self._count))
        event.attributes.entries.add(type=2, key="t_vreq", double_val=time())
        return event.SerializeToString()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.destroy(linger=0)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(10)
        self.process.stdout.close()
