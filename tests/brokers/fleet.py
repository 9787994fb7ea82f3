"""How do several processes run beside each other, of which some are killed?"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from tests.brokers.traffic import until
from tests.serving import with_parent

ROOT = Path(__file__).parents[2]


class Member:
    """A Python process with all that it starts, in a group of its own; what it says is kept by line."""

    def __init__(self, *command, before=()):
        self.process = subprocess.Popen(
            [*before, sys.executable, *command],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=with_parent(),
        )
        self.lines, self.errors = [], []
        # A full pipe would stop it.
        pairs = (self.process.stdout, self.lines), (self.process.stderr, self.errors)
        self._reading = [threading.Thread(target=_read, args=pair, daemon=True) for pair in pairs]
        for thread in self._reading:
            thread.start()

    def wait_ready(self):
        """Wait for its first line."""
        until(lambda: self.lines or not self.is_running, f"a first line of {self.process.args}")
        assert self.lines, "\n".join(self.errors)
        assert self.lines[0].startswith("READY"), self.lines

    @property
    def is_running(self):
        return self.process.poll() is None

    def kill(self):
        """Kill it at once, with all that it has started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def end(self, number=None, timeout_s=60.0):
        """Have it end in order, by a signal or because its input ends; return its last line."""
        if number is not None and self.is_running:
            self.process.send_signal(number)
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(timeout_s)
        finally:
            self.kill()
            self.process.wait(timeout_s)
            for thread in self._reading:
                thread.join()
        return self.lines[-1] if self.lines else ""


def _read(stream, lines):
    with stream:
        for line in stream:
            lines.append(line.rstrip("\n"))


@contextlib.contextmanager
def fleet(commands, before=()):
    """Start a process per command, and wait for all; who still runs at the end is killed."""
    members = []
    try:
        members.extend(Member(*command, before=before) for command in commands)
        for member in members:
            member.wait_ready()
        yield members
    finally:
        for member in members:
            member.kill()
        for member in members:
            member.end()
