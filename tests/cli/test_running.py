"""A running service is inspected, set, exchanged and stopped from a terminal."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

import epypes as ep
from tests.service.processes import running
from tests.service.states import read_state

pytestmark = pytest.mark.slow


def test_a_service_is_looked_at_set_exchanged_and_stopped_by_its_bundle(epypes, tmp_path):
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
    runner.run(image=np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8))
    bundle, other = (str(ep.promote(runner, tmp_path / name).path) for name in ("edges", "other"))
    with running(bundle, "--http", "127.0.0.1:0") as process:
        state = read_state(bundle)
        assert epypes("set", bundle, "lo=60", "hi=180").stdout == "SET lo 70 -> 60, hi 200 -> 180: revision 1.\n"
        told = epypes("status", bundle).stdout
        assert told.startswith(f"READY {bundle} (")
        assert "revision 1: lo=60, hi=180" in told
        assert state.failures in told
        assert json.loads(epypes("status", state.http, "--json").stdout)["parameters"] == {"lo": 60, "hi": 180}
        assert epypes("deploy", other, "--service", bundle).stdout.startswith(f"DEPLOYED {other}")
        assert epypes("stop", bundle).stdout == f"STOPPED {bundle}, process {state.pid}.\n"
        assert process.wait(60) == 0
