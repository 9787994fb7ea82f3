"""A watchdog over each process that runs tests: reports a test that hangs, with the native stack, and ends it.

pytest-timeout and faulthandler act inside the process, so a thread that never gives up the interpreter's lock (in a
garbage collection, in a call of a library) can hide from them. This pytest plugin starts a process beside each one that
runs tests and writes to its standard input when a test begins (its name) and ends (an empty line). The watchdog prints
the stacks of all threads by py-spy, native frames included, when a test has taken ``faulthandler_timeout``, and aborts
the process a tenth later than ``timeout``: the test counts as failed.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

_GRACE = 1.1
_PR_SET_PTRACER = 0x59616D61
_ANY_PROCESS = -1

_watchdog = pytest.StashKey[subprocess.Popen[bytes]]()


def pytest_configure(config: pytest.Config) -> None:
    is_controller = config.getoption("numprocesses", None) and not hasattr(config, "workerinput")
    if is_controller or sys.platform != "linux":
        return
    # A process may be looked at by its child only if it says so.
    ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(_ANY_PROCESS), 0, 0, 0)
    limits = (float(config.getini("faulthandler_timeout")), float(config.getini("timeout")) * _GRACE)
    config.stash[_watchdog] = subprocess.Popen(
        [sys.executable, "-I", __file__, str(os.getpid()), *map(str, limits)],
        stdin=subprocess.PIPE,
        start_new_session=True,
    )


def pytest_unconfigure(config: pytest.Config) -> None:
    watchdog = config.stash.get(_watchdog, None)
    if watchdog is not None:
        watchdog.stdin.close()
        watchdog.terminate()
        watchdog.wait()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    watchdog = item.config.stash.get(_watchdog, None)
    if watchdog is None:
        return (yield)
    os.write(watchdog.stdin.fileno(), item.nodeid.encode(errors="replace").replace(b"\n", b" ") + b"\n")
    try:
        return (yield)
    finally:
        os.write(watchdog.stdin.fileno(), b"\n")


def watch(pid: int, report_after_s: float, abort_after_s: float) -> None:
    """Follow the names of tests on standard input; report and abort the process that hangs."""
    test, limit_s = "", None
    while True:
        if not select.select([0], [], [], limit_s)[0]:
            if limit_s == report_after_s:
                _report(pid, test, limit_s)
                limit_s = abort_after_s - report_after_s
                continue
            sys.stderr.write(f"\nAborting process {pid}: {test} has not ended\n")
            os.kill(pid, signal.SIGABRT)
            return
        read = os.read(0, 1 << 16)
        if not read:
            return
        test = read.decode(errors="replace").removesuffix("\n").rpartition("\n")[2]
        limit_s = report_after_s if test else None


def _report(pid: int, test: str, after_s: float) -> None:
    sys.stderr.write(f"\n{test} has not ended after {after_s:g} s: the stacks of process {pid}\n")
    sys.stderr.flush()
    spy = [str(Path(sys.executable).with_name("py-spy")), "dump", "--pid", str(pid)]
    # Native frames can't be had of every build of Python.
    if subprocess.run([*spy, "--native"], stdout=sys.stderr, check=False).returncode:
        subprocess.run(spy, stdout=sys.stderr, check=False)


if __name__ == "__main__":
    watch(int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]))
