"""Which bundle do the tests of the service serve?"""

from __future__ import annotations

import cv2
import httpx
import pytest

import epypes as ep
from epypes.service.http import HttpServer
from tests.service.served import acting_bundle


@pytest.fixture(autouse=True)
def own_runtime_folder(tmp_path_factory, monkeypatch):
    """State files and failures of these tests stand apart from those of the user's services."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))


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


@pytest.fixture(scope="module")
def service(tmp_path_factory, photograph):
    from tests.conftest import EDGE_FUNCTIONS, EDGE_HPARAMS, EDGE_IO
    from tests.service.stand_in import StandIn

    runner = ep.CompGraphRunner(ep.CompGraph(EDGE_FUNCTIONS, EDGE_IO), EDGE_HPARAMS)
    runner.run(image=photograph)
    return StandIn(runner, tmp_path_factory.mktemp("served"))


@pytest.fixture(scope="module")
def http(service, tmp_path_factory):
    """The control of a service, with its token as ``token``."""
    with HttpServer(service, "127.0.0.1:*", token_file=tmp_path_factory.mktemp("token") / "token") as server:
        server.token = server.token_file.read_text().strip()
        yield server


@pytest.fixture
def client(http):
    """Who may look."""
    with httpx.Client(base_url=http.url, trust_env=False, timeout=20) as client:
        yield client


@pytest.fixture
def changing(http):
    """Who may change."""
    headers = {"Authorization": f"Bearer {http.token}"}
    with httpx.Client(base_url=http.url, trust_env=False, timeout=60, headers=headers) as client:
        yield client


@pytest.fixture(scope="session")
def acting(tmp_path_factory):
    """A bundle whose function does what an event says, and returns a number times a hyperparameter."""
    return acting_bundle(tmp_path_factory.mktemp("bundles") / "acting")
