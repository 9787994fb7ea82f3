"""Counts the Python calls of a process by file, on every thread that starts after `start`.

``python call_counter.py front BUNDLE`` serves a bundle and answers each line on its standard input with the counts so
far, as JSON. ``python call_counter.py worker ...`` is the worker process of that service: it writes its counts into
the file that CALL_COUNTS names whenever the bundle calls `dump`.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

_calls: Counter[str] = Counter()
_VARIABLE = "CALL_COUNTS"


def _count(frame: FrameType, event: str, argument: Any) -> None:
    if event == "call":
        _calls[frame.f_code.co_filename] += 1


def start() -> None:
    """Count from now on, on this thread and on those that start later."""
    threading.setprofile(_count)
    sys.setprofile(_count)


def counts() -> dict[str, int]:
    """Return the number of calls by file, without this one and the bundle's own module."""
    return {file: count for file, count in _calls.copy().items() if file not in (__file__, "pipeline.py")}


def dump() -> None:
    """Write the counts where the process that measures reads them; the file appears whole."""
    target = Path(os.environ[_VARIABLE])
    part = target.with_suffix(".part")
    part.write_text(json.dumps(counts()))
    part.replace(target)


def _front(bundle: str) -> None:
    start()
    from epypes.service import Service

    with tempfile.TemporaryDirectory() as folder:
        # The supervisor starts workers by this name.
        python = Path(folder) / "python"
        python.write_text(f'#!/bin/sh\nshift 3\nexec "{sys.executable}" -I "{__file__}" worker "$@"\n')
        python.chmod(0o755)
        sys.executable = str(python)
        with Service(bundle) as service:
            state = service.service_state
            print(json.dumps([state.sub, state.pub]), flush=True)
            for _ in sys.stdin:
                print(json.dumps(counts()), flush=True)


def _worker() -> None:
    # The bundle finds this module under its name.
    sys.modules["call_counter"] = sys.modules["__main__"]
    start()
    sys.argv = ["epypes.service.worker", *sys.argv[2:]]
    runpy.run_module("epypes.service.worker", run_name="__main__", alter_sys=False)


if __name__ == "__main__":
    if sys.argv[1] == "front":
        _front(sys.argv[2])
    else:
        _worker()
