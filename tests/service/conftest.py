"""Which bundle do the tests of the service serve?"""

from __future__ import annotations

import cv2
import pytest

import epypes as ep


@pytest.fixture(autouse=True)
def own_runtime_folder(tmp_path_factory, monkeypatch):
    """State files of these tests stand apart from those of the user's services."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))


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
def http(tmp_path_factory, photograph):
    from epypes.service.http import HttpServer
    from tests.conftest import EDGE_FUNCTIONS, EDGE_HPARAMS, EDGE_IO
    from tests.service.stand_in import StandIn

    runner = ep.CompGraphRunner(ep.CompGraph(EDGE_FUNCTIONS, EDGE_IO), EDGE_HPARAMS)
    runner.run(image=photograph)
    service = StandIn(runner, tmp_path_factory.mktemp("served"))
    with HttpServer(service, "127.0.0.1:*") as server:
        server.token = server.token_file.read_text().strip()
        server.service = service
        yield server
