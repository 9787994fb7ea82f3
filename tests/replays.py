"""Replays of bundles in processes that have NumPy and EPypes loaded already.

Promotion replays a bundle in an interpreter of its own (``python -s -P -m epypes.bundle.proof.replay_process``), half of whose time goes
into imports and the metadata of packages. Here a server has done that once, isolated likewise, and each replay is a
fork of it: a process of its own in which none of the bundle's imports has been done. Tests with the fixture
``fresh_interpreter`` start the real one.

As a program, this file is the server: ``python -I replays.py SOCKET``. It ends when its standard input does.
"""

from __future__ import annotations

import json
import os
import random
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

_REPLAY = [sys.executable, "-s", "-P", "-m", "epypes.bundle.proof.replay_process"]


class WarmProcesses:
    """Has the place of the module ``subprocess`` where replays are started."""

    def __init__(self) -> None:
        self.is_on = True
        self._lock = threading.Lock()
        self._server: subprocess.Popen[bytes] | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="epypes-replays-")
        self._address = str(Path(self._folder.name, "s"))

    def __getattr__(self, name: str) -> Any:
        return getattr(subprocess, name)

    def run(
        self, command: list[str], *, cwd: str, env: dict[str, str], timeout: float, **options: Any
    ) -> subprocess.CompletedProcess[bytes]:
        """Run an isolated interpreter's command, as ``subprocess.run`` with ``capture_output``."""
        if not self.is_on or command[:5] != _REPLAY:
            return subprocess.run(command, cwd=cwd, env=env, timeout=timeout, **options)
        self._start()
        with socket.socket(socket.AF_UNIX) as channel:
            channel.connect(self._address)
            request = {"module": command[4], "argv": command[5:], "cwd": str(cwd), "env": env}
            channel.sendall(json.dumps(request).encode() + b"\n")
            with channel.makefile("rb") as answers:
                (pid,) = struct.unpack("i", answers.read(4))
                channel.settimeout(timeout)
                try:
                    (code,) = struct.unpack("i", answers.read(4))
                except TimeoutError as error:
                    os.kill(pid, signal.SIGKILL)
                    raise subprocess.TimeoutExpired(command, timeout) from error
                return subprocess.CompletedProcess(command, code, b"", answers.read())

    def _start(self) -> None:
        with self._lock:
            if self._server is None:
                command = [sys.executable, "-I", __file__, self._address]
                self._server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
                assert self._server.stdout is not None
                assert self._server.stdout.read(1) == b"."

    def close(self) -> None:
        if self._server is not None:
            self._server.communicate(timeout=60)
        self._folder.cleanup()


def serve(address: str) -> None:
    """Fork for each request until standard input ends."""
    import epypes.bundle.proof.replay_process
    import epypes.pipeline
    import epypes.wire.samples  # noqa: F401 - all of that is loaded for the forks
    from epypes.bundle.requirements import bringing

    bringing("numpy")  # reads which distribution brings which module
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(address)
        listening.listen(64)
        os.write(1, b".")
        while True:
            readable, _, _ = select.select([listening, 0], [], [])
            if 0 in readable:
                _reap()
                return
            channel, _ = listening.accept()
            _reap()
            with channel:
                if os.fork() == 0:
                    listening.close()
                    _handle(channel)


def _reap() -> None:
    """Take the status of the forks that have ended, so that their time counts as the server's."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return


def _handle(channel: socket.socket) -> None:
    """Fork the process that is asked for; say its id, its status when it has ended, and what it wrote to stderr."""
    request = json.loads(channel.makefile("rb").readline())
    with tempfile.TemporaryFile() as stderr:
        pid = os.fork()
        if pid == 0:
            channel.close()
            _become(request, stderr.fileno())
        channel.sendall(struct.pack("i", pid))
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        stderr.seek(0)
        channel.sendall(struct.pack("i", code) + stderr.read())
    os._exit(0)


def _become(request: dict[str, Any], stderr: int) -> None:
    """Be the interpreter that runs a module as a program."""
    null = os.open(os.devnull, os.O_RDWR)
    for number, place in enumerate((null, null, stderr)):
        os.dup2(place, number)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    time.tzset()
    # The server's generators, which all forks have a copy of, may be at work in a bundle.
    random.seed()
    if "numpy.random" in sys.modules:
        sys.modules["numpy.random"].seed()
    sys.argv = [request["module"], *request["argv"]]
    code: Any = 1
    try:
        runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as stop:
        code = stop.code or 0
    except BaseException:  # as an interpreter does
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)


if __name__ == "__main__":
    serve(sys.argv[1])
