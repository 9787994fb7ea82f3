"""How does a process of the experiment begin and end?

``python -m epypes.experiment.node`` is started by a ChildStation.

It reads one line of JSON from its standard input: which nodes it has, how they are made, where their events come from.
It writes one line of JSON to its standard output: the addresses of its answers and failures. It ends when its standard
input is closed, which happens however its parent ends, and whatever it is at itself.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
from typing import Final

from epypes.errors import EpypesError

# How long the nodes may take to stop when the parent has gone.
_STOP_TIMEOUT_S: Final = 5.0


class Parent:
    """What the parent says on standard input, heard by a thread of its own; when it has gone, the process ends.

    Attributes
    ----------
    is_waited_for
        Whether somebody waits for `gone`, and then ends in order. Before that there is nothing to end in order, and a
        camera that does not open may hold the main thread for ever.
    """

    def __init__(self) -> None:
        self.is_waited_for = False
        self._said: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=self._listen, name="epypes parent", daemon=True).start()

    def line(self) -> bytes:
        """Return the one line that it says; empty if it has gone."""
        return self._said.get()

    def gone(self) -> None:
        """Return when it has gone."""
        self.is_waited_for = True
        self._said.get()

    def _listen(self) -> None:
        # Without a buffer, whose lock this thread would hold when the interpreter ends.
        with open(0, "rb", buffering=0, closefd=False) as pipe:
            self._said.put(pipe.readline())
            pipe.read()
        self._said.put(b"")
        if self.is_waited_for:
            time.sleep(_STOP_TIMEOUT_S)
        os._exit(1)


def main() -> None:
    """Run the nodes until standard input is closed."""
    parent = Parent()
    # Whatever a camera's library prints must not be taken for the line.
    line_out = os.dup(1)
    os.dup2(2, 1)
    # Before anything is asked of it, so that processes that wait for each other have loaded theirs meanwhile.
    from epypes.experiment.components import Settings
    from epypes.experiment.station import Station

    asked = json.loads(parent.line() or "null")
    if asked is None:
        return
    told = asked["settings"]
    settings = Settings(**{**told, "cameras": tuple(told["cameras"]), "allow": tuple(told["allow"])})
    station = Station(asked["nodes"], settings, "tcp")
    try:
        told = {"addresses": station.start(asked["source"]), "nodes": station.described()}
        os.write(line_out, f"{json.dumps(told)}\n".encode())
        parent.gone()
    finally:
        station.stop()


if __name__ == "__main__":
    try:
        main()
    except EpypesError as error:
        sys.exit(f"{type(error).__name__}: {error}")
