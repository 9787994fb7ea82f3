"""Is a running service looked at, set and stopped from a terminal?"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.cli import main
from epypes.service.state import read_state
from tests.service.processes import running

pytestmark = pytest.mark.slow


def said(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([*arguments])
    told = capsys.readouterr()
    assert not stop.value.code, (stop.value.code, told.err)
    return told.out


def test_a_service_is_looked_at_set_exchanged_and_stopped_by_its_bundle(tmp_path, capsys, monkeypatch):
    for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
    runner.run(image=np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8))
    bundle, other = (str(ep.promote(runner, tmp_path / name).path) for name in ("edges", "other"))
    with running(bundle, "--http", "127.0.0.1:0") as process:
        state = read_state(bundle)
        assert said(capsys, "set", bundle, "lo=60", "hi=180") == "SET lo 70 -> 60, hi 200 -> 180: revision 1.\n"
        told = said(capsys, "status", bundle)
        assert told.startswith(f"READY {bundle} (")
        assert "revision 1: lo=60, hi=180" in told
        assert state.failures in told
        assert json.loads(said(capsys, "status", state.http, "--json"))["parameters"] == {"lo": 60, "hi": 180}
        assert said(capsys, "deploy", other, "--service", bundle).startswith(f"DEPLOYED {other}")
        assert said(capsys, "stop", bundle) == f"STOPPED {bundle}, process {state.pid}.\n"
        assert process.wait(10) == 0
