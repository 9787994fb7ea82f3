"""How is the process started, ended and killed that runs a bundle's code, and where is it when it does not answer?"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path
from time import monotonic, sleep
from typing import Final

from epypes.bundle.load import MODULE
from epypes.service.channel import channel_pair
from epypes.service.notify import VARIABLES
from epypes.service.words import STANDARD_ERROR

# What a worker said last, for the reason of its death.
_LINES_KEPT: Final = 20
_CHUNK: Final = 64 * 1024
# How long a process may take to write where its threads are, and how often it is looked meanwhile.
_TRACE_S: Final = 0.5
_LOOK_S: Final = 0.01
_MOST_TRACE: Final = 256 * 1024
# How long a process may take to end once its channel has.
_ENDING_S: Final = 1.0
_FRAME: Final = re.compile(r'^  File "(?P<file>.*)", line \d+ in (?P<name>\S+)$')


class WorkerProcess:
    """The process that runs a bundle's code.

    It ends with the thread that made this object, so that must live as long as the service.

    Parameters
    ----------
    bundle
        The bundle's folder.
    threads
        How many events it works on at once.
    """

    def __init__(self, bundle: Path, threads: int) -> None:
        self.module = bundle / MODULE
        self._last_traces = ""
        self._said: deque[str] = deque(maxlen=_LINES_KEPT)
        # The system may be short of descriptors, memory or threads at any of these.
        with contextlib.ExitStack() as given, contextlib.ExitStack() as kept:
            self.channel, theirs = channel_pair()
            kept.callback(self.channel.close)
            given.callback(theirs.close)
            self._traces = os.memfd_create("epypes-traces")
            kept.callback(os.close, self._traces)
            said, says = os.pipe()
            kept.callback(os.close, said)
            given.callback(os.close, says)
            inherited = [theirs.fileno(), self._traces]
            command = [sys.executable, "-I", "-m", "epypes.service.worker"]
            self.process = subprocess.Popen(  # noqa: S603 - this interpreter, our own module
                [*command, str(inherited[0]), str(bundle), "--threads", str(threads), "--faults", str(inherited[1])],
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                stdout=says,
                stderr=says,
                env={name: value for name, value in os.environ.items() if name not in VARIABLES},
            )
            self.pid = self.process.pid
            kept.callback(self.process.wait)
            kept.callback(self.kill)
            self._listener = threading.Thread(
                target=_pass_on, args=(said, self._said), name="epypes worker's words", daemon=True
            )
            self._listener.start()
            kept.pop_all()

    def kill(self) -> None:
        """Kill it, also if it is stopped or stuck."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Return whether it has ended within ``timeout_s`` seconds."""
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Close what belongs to it, when its channel has ended; kill it if it does not end with that."""
        if not self.wait(_ENDING_S):
            self.kill()
        self.process.wait()
        if self._traces == -1:
            return
        self._last_traces = self._traces_from(0)
        self.channel.close()
        # Its last words are on their way; a process that it has started may hold the pipe open for longer.
        self._listener.join(0.2)
        # Once: later the number may be that of another file.
        traces, self._traces = self._traces, -1
        os.close(traces)

    @property
    def ending(self) -> str:
        """How it ended, with what it said last; empty while it runs."""
        status = self.process.poll()
        if status is None:
            return ""
        how = f"was killed by {_signal_name(-status)}" if status < 0 else f"ended with status {status}"
        last = next((line for line in reversed(self._said) if line.strip()), "")
        return f"The worker {how}" + (f"; it said last: {last.strip()[:300]}" if last else "")

    def functions_by_trace(self) -> tuple[str, ...]:
        """Return the functions of the bundle's module that its threads are in, as the process itself writes them down.

        That needs none of its threads to get on. A process that is stopped can't.
        """
        try:
            begin = os.fstat(self._traces).st_size
            self.process.send_signal(signal.SIGUSR1)
            deadline = monotonic() + _TRACE_S
            size = begin
            while monotonic() < deadline:
                sleep(_LOOK_S)
                before, size = size, os.fstat(self._traces).st_size
                if size == before > begin:
                    break
            return functions_in_trace(self._traces_from(begin), str(self.module))
        except OSError:
            return ()

    @property
    def died_in(self) -> tuple[str, ...]:
        """The functions of the bundle's module that it was in when it crashed, as far as it could write that down."""
        return functions_in_trace(self._last_traces, str(self.module))

    def _traces_from(self, begin: int) -> str:
        size = min(os.fstat(self._traces).st_size - begin, _MOST_TRACE)
        return os.pread(self._traces, size, begin).decode(errors="replace")

    @property
    def is_stopped(self) -> bool:
        """Whether the process was stopped by SIGSTOP, or by a debugger."""
        try:
            status = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False
        return status.rpartition(")")[2].split()[:1] in (["T"], ["t"])


def functions_in_trace(text: str, module: str) -> tuple[str, ...]:
    """Return, for each thread of a trace of faulthandler, the outermost function of a module that it is in.

    Examples
    --------
    >>> trace = '''Thread 0x7f (most recent call first):
    ...   File "/b/pipeline.py", line 9 in helper
    ...   File "/b/pipeline.py", line 4 in match
    ...   File "/x/epypes/run/call.py", line 30 in call
    ... '''
    >>> functions_in_trace(trace, "/b/pipeline.py")
    ('match',)
    """
    found: list[str] = []
    for block in text.split("most recent call first):\n"):
        frames = [frame for line in block.splitlines() if (frame := _FRAME.match(line))]
        names = [frame["name"] for frame in frames if frame["file"] == module]
        found += names[-1:]
    return tuple(found)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _pass_on(said: int, lines: deque[str]) -> None:
    """Pass on what a process says to our own standard error, and keep the last lines."""
    rest = b""
    with contextlib.suppress(OSError):
        while data := os.read(said, _CHUNK):
            STANDARD_ERROR.write(data)
            *whole, rest = (rest + data).split(b"\n")
            lines.extend(line.decode(errors="replace") for line in whole[-_LINES_KEPT:])
            rest = rest[-_CHUNK:]
    if rest:
        lines.append(rest.decode(errors="replace"))
    os.close(said)
