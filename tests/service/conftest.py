"""Which bundle do the tests of the service serve?"""

from __future__ import annotations

import cv2
import pytest

import epypes as ep
from tests.service.served import acting_bundle


@pytest.fixture(autouse=True)
def apart(own_folders):
    """Every service of these tests has folders of its own."""


@pytest.fixture(scope="session")
def edge_bundle(tmp_path_factory, photograph):
    """A bundle of OpenCV's own functions, promoted once."""
    cg = ep.CompGraph(
        {"smooth": cv2.medianBlur, "canny": cv2.Canny},
        {"smooth": (("image", "side"), "smoothed"), "canny": (("smoothed", "lo", "hi"), "edges")},
    )
    runner = ep.CompGraphRunner(cg, {"side": 5, "lo": 70, "hi": 200})
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges")


@pytest.fixture(scope="session")
def acting(tmp_path_factory):
    """A bundle whose function does what an event says, and returns a number times a hyperparameter."""
    return acting_bundle(tmp_path_factory.mktemp("bundles") / "acting")


@pytest.fixture
def quick(monkeypatch):
    """Services of this process pause only shortly before they start a worker again; each death is an early one."""
    monkeypatch.setattr("epypes.service.supervision.worker_health.RESTART_PAUSE_S", 0.01)
    monkeypatch.setattr("epypes.service.supervision.worker_health._FAULT_PAUSE_S", 0.5)
    monkeypatch.setattr("epypes.service.supervision.worker_health._SOON_S", 60.0)
