"""How does a process of the experiment begin and end?

``python -m epypes.experiment.node`` is started by a ChildStation.

It reads one line of JSON from its standard input: which nodes it has, how they are made, where their events come from.
It writes one line of JSON to its standard output: the addresses of its answers and failures. It ends when its standard
input is closed, which happens however its parent ends.
"""

from __future__ import annotations

import json
import os
import sys

from epypes.errors import EpypesError


def main() -> None:
    """Run the nodes until standard input is closed."""
    # Whatever a camera's library prints must not be taken for the line.
    line_out = os.dup(1)
    os.dup2(2, 1)
    # Before anything is asked of it, so that processes that wait for each other have loaded theirs meanwhile.
    from epypes.experiment.components import Settings
    from epypes.experiment.station import Station

    asked = json.loads(sys.stdin.readline() or "null")
    if asked is None:
        return
    settings = Settings(**{**asked["settings"], "cameras": tuple(asked["settings"]["cameras"])})
    station = Station(asked["nodes"], settings, "tcp")
    try:
        told = {"addresses": station.start(asked["source"]), "nodes": station.described()}
        os.write(line_out, f"{json.dumps(told)}\n".encode())
        sys.stdin.read()
    finally:
        station.stop()


if __name__ == "__main__":
    try:
        main()
    except EpypesError as error:
        sys.exit(f"{type(error).__name__}: {error}")
