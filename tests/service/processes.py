"""A service in a process of its own."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

START_TIMEOUT_S = 120.0


@contextmanager
def running(bundle, *options, limits="true", stderr=subprocess.PIPE):
    """Run ``epypes serve`` until the block ends; yield the process, with its READY line as ``.ready``.

    ``limits`` is what a shell does before, as ``ulimit -n 256``.
    """
    process = subprocess.Popen(
        [
            "bash",
            "-c",
            f'{limits} && exec "$@"',
            "-",
            sys.executable,
            "-m",
            "epypes.cli",
            "serve",
            str(bundle),
            *options,
        ],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env=os.environ.copy(),
    )
    watchdog = threading.Timer(START_TIMEOUT_S, process.kill)
    watchdog.start()
    try:
        process.ready = process.stdout.readline().strip()
        watchdog.cancel()
        yield process
    finally:
        watchdog.cancel()
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)


@contextmanager
def lowered(kind, value, pid=0):
    """Lower a soft limit of a process within the block."""
    soft, hard = resource.prlimit(pid, kind)
    resource.prlimit(pid, kind, (value, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, kind, (soft, hard))


def run_cli(*arguments, timeout_s=240, **options):
    """Run a command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "epypes.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        **options,
    )
