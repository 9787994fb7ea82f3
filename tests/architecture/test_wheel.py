"""Does the wheel work in an environment of its own, from an empty folder?"""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).parents[2]

MAIN_JOB = """
import cv2, numpy as np, epypes as ep
from epypes.bundle import verify
from epypes_widgets import tune
cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
runner.run(image=np.arange(64 * 64, dtype=np.uint8).reshape(64, 64))
assert "image/svg+xml" in runner._repr_mimebundle_()
panel = tune(runner)
panel["lo"] = 20
panel.wait(30)
assert runner["lo"] == 20
ep.promote(runner, "bundle")
assert verify("bundle").identical
print(ep.__file__)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "uv", "build", "--wheel", "--out-dir", str(out), str(ROOT)], check=True)
    (found,) = out.glob("*.whl")
    return found


def test_the_wheel_holds_both_packages_and_their_data(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for name in (
        "epypes/py.typed",
        "epypes/wire/schema.binpb",
        "epypes/display/paint/explore.js",
        "epypes/display/paint/explore.css",
        "epypes_widgets/picking.css",
        "epypes_widgets/picking.js",
        "epypes_widgets/view/main.js",
        "epypes_widgets/view/view.css",
    ):
        assert name in names
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"epypes", "epypes_widgets"}


def test_the_wheel_does_the_main_job_in_a_clean_environment(wheel, tmp_path):
    python = tmp_path / "venv" / "bin" / "python"
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "--python", sys.executable, str(tmp_path / "venv")], check=True)
    subprocess.run([*uv, "pip", "install", "--python", str(python), f"{wheel}[all]"], check=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    done = subprocess.run([str(python), "-c", MAIN_JOB], cwd=empty, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "venv") in done.stdout
    done = subprocess.run(
        [str(python.parent / "epypes"), "verify", "bundle"], cwd=empty, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_core_imports_without_any_extra(wheel, tmp_path):
    python = tmp_path / "venv" / "bin" / "python"
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "--python", sys.executable, str(tmp_path / "venv")], check=True)
    subprocess.run([*uv, "pip", "install", "--python", str(python), str(wheel)], check=True)
    code = (
        "import epypes as ep\n"
        "r = ep.CompGraphRunner(ep.CompGraph({'f': lambda x: x + 1}, {'f': ('x', 'y')}))\n"
        "assert r.run(x=1)['y'] == 2\n"
        "print(r._repr_mimebundle_()['text/plain'])"
    )
    done = subprocess.run([str(python), "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "f(x) -> y" in done.stdout
    assert "pip install 'epypes[notebook]'" in done.stdout
    done = subprocess.run([str(python.parent / "epypes"), "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    done = subprocess.run(
        [str(python.parent / "epypes"), "serve", "nowhere"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.strip().splitlines() == ["epypes: module 'zmq' is missing. Run: pip install 'epypes[all]'"]
