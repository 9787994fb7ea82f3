"""A calibrated map as a hyperparameter: a file of the bundle from the notebook to the panel of a running service."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify, write_back
from epypes.errors import BundleChanged, EpypesError, HyperparameterError
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.wire import Envelope
from epypes_widgets import tune
from tests.bundle.cells import cell
from tests.service.served import peer_of

pytestmark = pytest.mark.slow

SOURCE = """
import cv2

def rectify(image, map_x, map_y):
    return cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)

def scale(rectified, gain):
    return cv2.convertScaleAbs(rectified, alpha=gain)
"""
IO = {"rectify": (("image", "map_x", "map_y"), "rectified"), "scale": (("rectified", "gain"), "scaled")}
IMAGE = np.random.default_rng(3).integers(0, 90, (120, 160), np.uint8)
MAPS = cv2.initUndistortRectifyMap(
    np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, 0]), None,
    np.array([[140.0, 0, 80], [0, 140, 60], [0, 0, 1]]), (160, 120), cv2.CV_32FC1,
)  # fmt: skip


@pytest.fixture
def bundle(tmp_path):
    names = cell(SOURCE)
    cg = ep.CompGraph({name: names[name] for name in IO}, IO)
    runner = ep.CompGraphRunner(cg, {"map_x": MAPS[0], "map_y": np.asfortranarray(MAPS[1]), "gain": 2.0})
    runner.run(image=IMAGE)
    return ep.promote(runner, tmp_path / "rectify")


def test_it_is_a_file_under_the_manifest_and_read_only(bundle):
    stored = bundle.path / "hyperparameters" / "map_x.npy"
    assert np.array_equal(np.load(stored), MAPS[0])
    assert verify(bundle.path).identical
    runner = ep.load(bundle.path)
    run = runner.run(image=IMAGE)
    assert np.array_equal(run["rectified"], cv2.remap(IMAGE, *MAPS, cv2.INTER_LINEAR))
    with pytest.raises(ValueError, match="read-only"):
        runner.hyperparameters["map_x"][0, 0] = 1
    assert ep.promote(runner, bundle.path.with_name("again")).settings.hyperparameters["gain"] == 2.0
    array = np.load(stored)
    array[5, 5] += 1
    np.save(stored, array)
    with pytest.raises(BundleChanged, match=r"hyperparameters/map_x\.npy was changed"):
        ep.load(bundle.path)


def test_other_values_are_written_back_beside_it(bundle):
    assert "+value = 3.0" in write_back(bundle.path, {"gain": 3.0}).diff
    assert ep.load(bundle.path).hyperparameters["gain"] == 3.0
    with pytest.raises(HyperparameterError, match="'map_x' can't be an array of 19200 numbers: .* promote again"):
        write_back(bundle.path, {"map_x": MAPS[1]})
    settings = bundle.path / "pipeline.toml"
    assert 'value = "hyperparameters/map_x.npy"\nkind = "file"' in settings.read_text()


def test_a_running_service_uses_it_and_shows_it_read_only(bundle, tmp_path):
    with (
        Service(bundle.path) as service,
        peer_of(service) as peer,
        HttpServer(service, "127.0.0.1:*", access_key_file=tmp_path / "token") as server,
        ep.connect(server.url, token=server.access_key_file.read_text().strip()) as connection,
    ):
        peer.requests.put(Envelope(type="x", parts={"image": IMAGE}))
        assert np.array_equal(peer.take()[0].parts["scaled"], cv2.remap(IMAGE, *MAPS, cv2.INTER_LINEAR) * 2)
        assert connection.set(gain=1.0).entries["gain"]["value"] == 1.0
        with pytest.raises(EpypesError, match="'map_x' is of kind 'file', which can't be changed while it is served"):
            connection.set(map_x=3)
        assert "+value = 1.0" in connection.write_back().diff
        panel = tune(connection)
        panel.wait(60)
        panel["gain"] = 2.0
        panel.wait(60)
        assert (panel.error, panel.values["gain"]) == ("", 2.0)
        panel.close(60)
    assert ep.load(bundle.path).hyperparameters["gain"] == 1.0
    assert verify(bundle.path).identical
