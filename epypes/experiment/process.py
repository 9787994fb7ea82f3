"""How are nodes run in a process of their own, and how does it end?

The process is told by a line of JSON what to do, tells by another where it can be reached, and ends when the pipe to
its standard input is closed: so it never outlives this process, even if this one is killed while it starts.
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from epypes.errors import ExperimentError
from epypes.experiment.components import Settings
from epypes.experiment.station import START_TIMEOUT_S

# Longer than what a station waits for inside, which can say better what was missing.
_TOLD_TIMEOUT_S: Final = 3 * START_TIMEOUT_S
_STOP_TIMEOUT_S: Final = 5.0
_PRINTED_BYTES: Final = 100_000


class ChildStation:
    """The nodes of one process, in a process of their own; started and stopped like a Station.

    It is spawned at once, so that several load their libraries side by side.

    Parameters
    ----------
    names
        The nodes in the order in which an event passes them.
    settings
        What they are made with.
    on_end
        Called with an ExperimentError on a thread of its own, when the process ends and was not asked to.
    """

    def __init__(self, names: Sequence[str], settings: Settings, on_end: Callable[[ExperimentError], None]) -> None:
        self.names, self.name = tuple(names), " and ".join(names)
        self._settings, self._on_end = settings, on_end
        self._stopping = False
        self._told: Mapping[str, Any] = {}
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        # A file takes any amount without anybody reading, as a pipe does not.
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115 - closed by stop()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "epypes.experiment.node"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            text=True,
            # Ctrl+C is for this process, which then ends the others in order.
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._watcher = threading.Thread(target=self._watch, name=f"epypes {self.name}", daemon=True)
        self._watcher.start()

    def start(self, source: str) -> dict[str, str]:
        """Have everything started; return the addresses of answers and of failures.

        Raises
        ------
        ExperimentError
            The process has ended, or says nothing; what it printed last is in the text.
        """
        asked = {"nodes": self.names, "settings": asdict(self._settings), "source": source}
        with contextlib.suppress(OSError):  # it has ended; the line that does not come tells
            self._stdin.write(f"{json.dumps(asked)}\n")
            self._stdin.flush()
        try:
            line = self._lines.get(timeout=_TOLD_TIMEOUT_S)
        except queue.Empty:
            text = f"The process of {self.name} ({self.pid}) does not start: it has said nothing for "
            raise ExperimentError(self.name, f"{text}{_TOLD_TIMEOUT_S:g} s.", self._read_printed()) from None
        if not line:
            self._watcher.join()
            raise self._ended()
        self._told = json.loads(line)
        return self.addresses

    @property
    def addresses(self) -> dict[str, str]:
        """The addresses of answers and of failures, once it is started."""
        return dict(self._told["addresses"])

    def described(self) -> dict[str, Mapping[str, Any]]:
        """Return what the nodes compute, by name, as the process itself says."""
        return dict(self._told["nodes"])

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

    @property
    def _stdin(self) -> Any:
        return self._process.stdin

    @property
    def _stdout(self) -> Any:
        return self._process.stdout

    def _watch(self) -> None:
        self._lines.put(self._stdout.readline())
        self._stdout.read()
        self._process.wait()
        if not self._stopping:
            self._on_end(self._ended())

    def _ended(self) -> ExperimentError:
        """Return the error for a process that has ended by itself."""
        printed = self._read_printed()
        last = printed.strip().rpartition("\n")[2]
        how = _how_it_ended(self._process.returncode)
        text = f"The process of {self.name} ({self.pid}) {how}{': ' + last if last else '.'}"
        return ExperimentError(self.name, text, printed)

    def _read_printed(self) -> str:
        # By position, since the process writes at the place of the same open file.
        size = os.fstat(self._printed.fileno()).st_size
        start = max(0, size - _PRINTED_BYTES)
        return os.pread(self._printed.fileno(), _PRINTED_BYTES, start).decode("utf-8", "replace")

    def __repr__(self) -> str:
        return f"<ChildStation {self.name}: process {self.pid}>"


def _how_it_ended(status: int) -> str:
    if status >= 0:
        return f"ended with exit status {status}"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:  # real-time signals have no name
        return f"was ended by signal {-status}"
