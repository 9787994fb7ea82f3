"""How is the same answered by services: `epypes serve`, some times on one queue?"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

import epypes as ep
from tests.benchmarks.brokers.parties import Meeting
from tests.brokers.fleet import fleet


@contextmanager
def services(meeting: Meeting, count: int) -> Iterator[None]:
    """Serve a bundle that answers an image with its half, as so many replicas."""
    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="epypes-bench-") as folder:
        # States and failures of these services stand apart from those of the user's.
        os.environ.update(XDG_RUNTIME_DIR=folder, XDG_STATE_HOME=folder)
        try:
            bundle = _promoted(Path(folder))
            told = ["--sub", meeting.events, "--pub", meeting.answers]
            command = ["-m", "epypes.cli", "serve", str(bundle), *told]
            with fleet([[*command, "--replica", str(number + 1)] for number in range(count)]):
                yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def _promoted(folder: Path) -> Path:
    runner = ep.CompGraphRunner(ep.CompGraph({"half": cv2.pyrDown}, {"half": ("image", "out")}))
    runner.run(image=np.zeros((8, 8), np.uint8))
    return ep.promote(runner, folder / "half").path
