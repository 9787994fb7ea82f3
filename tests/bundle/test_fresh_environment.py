"""A bundle computes the same where nothing is installed but what its requirements.txt names."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.manifest import write_manifest
from epypes.errors import BundleError
from tests.bundle.test_slicer import notebook

pytestmark = pytest.mark.packaging

SOURCE = """
import cv2

def find(image):
    return cv2.ORB_create(50).detect(image, None)
"""


@pytest.fixture
def folder(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"find": notebook(SOURCE)["find"]}, {"find": ("image", "points")}))
    runner.run(image=np.random.default_rng(3).integers(0, 255, (120, 160), np.uint8))
    assert isinstance(runner["points"][0], cv2.KeyPoint)
    return ep.promote(runner, tmp_path / "orb").path


def test_a_bundle_replays_in_a_new_environment(folder):
    report = verify(folder, fresh_env=True)
    assert report.identical
    assert report.notes == ()


def test_a_requirement_that_is_missing_or_does_not_exist_is_named(folder):
    pinned = folder / "requirements.txt"
    lines = pinned.read_text()
    pinned.write_text("\n".join(line for line in lines.splitlines() if "opencv" not in line) + "\n")
    write_manifest(folder)
    with pytest.raises(BundleError, match="No module named 'cv2'"):
        verify(folder, fresh_env=True)
    pinned.write_text(lines.replace(f"numpy=={np.__version__}", "numpy==0.0.1"))
    write_manifest(folder)
    with pytest.raises(BundleError, match="What requirements.txt names can't be installed: .*numpy==0.0.1"):
        verify(folder, fresh_env=True)
