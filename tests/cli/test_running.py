"""A running service is inspected, set, exchanged and stopped from a terminal."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import epypes as ep
from tests.service.processes import running
from tests.service.served import until
from tests.service.states import read_state

pytestmark = pytest.mark.slow


def promoted(folder):
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
    runner.run(image=np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8))
    return str(ep.promote(runner, folder).path)


def test_a_service_is_looked_at_set_exchanged_and_stopped_by_its_bundle(epypes, tmp_path):
    bundle, other = (promoted(tmp_path / name) for name in ("edges", "other"))
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


def test_serve_prints_a_link_that_carries_the_access_key_unless_it_writes_to_a_log(tmp_path):
    bundle = promoted(tmp_path / "edges")
    with running(bundle, "--http", "127.0.0.1:0") as process:
        key = Path(read_state(bundle).access_key_file).read_text().strip()
        link = process.stdout.readline().strip()
        assert link.startswith("Live page: http://127.0.0.1:")
        assert link.endswith(f"/?access_key={key}")
        with ep.connect(link.removeprefix("Live page: ")) as service:
            assert service.set(lo=64).revision == 1
    log = tmp_path / "log"
    with log.open("w") as file:
        serving = subprocess.Popen(
            [sys.executable, "-m", "epypes.cli", "serve", bundle, "--http", "127.0.0.1:0"],
            stdout=file, stderr=file,
        )  # fmt: skip
    try:
        until(lambda: "Its access key" in log.read_text() or serving.poll() is not None)
    finally:
        serving.terminate()
        serving.wait(60)
    text = log.read_text()
    assert "Live page: http://127.0.0.1:" in text
    assert key not in text
