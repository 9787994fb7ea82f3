"""Aravis' fake camera: a camera of GigE Vision in a process of its own, on loopback.

::

    with FakeCamera("EP01") as fake:
        camera = ep.camera("genicam:EP01")
        fake.kill()
        fake.start()
"""

from __future__ import annotations

import fcntl
import shutil
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Self

import pytest

from epypes.acquisition.genicam import Backend

_COMMAND = "arv-fake-gv-camera-0.8"
# It has the one port of the protocol, so tests that run side by side have it one after the other.
_LOCK = Path(tempfile.gettempdir()) / "epypes-fake-camera.lock"


class FakeCamera:
    """The process, by the serial number that it gives."""

    def __init__(self, serial: str) -> None:
        self.serial = serial
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        """Start it with options of its own, and return when it answers."""
        command = [_COMMAND, "-i", "127.0.0.1", "-s", self.serial, *options]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline_s, pause = time.monotonic() + 60, threading.Event()
        while self.serial not in [found.serial for found in Backend().find()]:
            assert time.monotonic() < deadline_s, "the fake camera does not answer"
            pause.wait(0.01)

    def kill(self) -> None:
        """End it at once, as if it were unplugged."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Self:
        if shutil.which(_COMMAND) is None:
            pytest.skip("aravis-tools is not installed on this machine: sh .ci/packages")
        self._locked = _LOCK.open("w")
        fcntl.flock(self._locked, fcntl.LOCK_EX)
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._locked.close()
