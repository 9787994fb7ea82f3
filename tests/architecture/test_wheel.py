"""Does the wheel work in an environment of its own, from an empty folder?"""

from __future__ import annotations

import zipfile

import pytest

pytestmark = pytest.mark.packaging

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
panel.wait(60)
assert runner["lo"] == 20
ep.promote(runner, "bundle")
assert verify("bundle").identical
print(ep.__file__)
"""


def test_the_wheel_holds_both_packages_and_their_data(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for name in (
        "epypes/py.typed",
        "epypes/wire/schema.binpb",
        "epypes/catalog/names.toml",
        "epypes/catalog/opencv.toml",
        "epypes/catalog/skimage.toml",
        "epypes/display/paint/explore.js",
        "epypes/display/paint/explore.css",
        "epypes_widgets/view/picker.js",
        "epypes_widgets/view/main.js",
        "epypes_widgets/view/view.css",
    ):
        assert name in names
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"epypes", "epypes_widgets"}


def test_the_wheel_does_the_main_job_in_a_clean_environment(environment):
    everything = environment("all")
    assert str(everything.bin.parent) in everything.python(MAIN_JOB)
    done = everything.epypes("verify", "bundle")
    assert done.returncode == 0, done.stderr


def test_the_core_imports_without_any_extra(environment):
    alone = environment("")
    code = (
        "import epypes as ep\n"
        "r = ep.CompGraphRunner(ep.CompGraph({'f': lambda x: x + 1}, {'f': ('x', 'y')}))\n"
        "assert r.run(x=1)['y'] == 2\n"
        "print(r._repr_mimebundle_()['text/plain'])"
    )
    told = alone.python(code)
    assert "f(x) -> y" in told
    assert "pip install 'epypes[graphviz]'" in told
    done = alone.epypes("--help")
    assert done.returncode == 0, done.stderr
    # The command that it names adds the packages, and leaves the EPypes that is installed.
    added = alone.would_install("epypes[graphviz]")
    assert {"graphviz", "pygraphviz"} <= added
    assert "epypes" not in added
