"""Does the wheel work in an environment of its own, from an empty folder?"""

from __future__ import annotations

import zipfile
from pathlib import Path

import click
import pytest

pytestmark = pytest.mark.packaging

HERE = Path(__file__).parent
TUTORIAL = HERE.parents[1] / "notebooks" / "01_edge_detection.ipynb"

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

COLAB = [line for line in (HERE / "colab.txt").read_text().splitlines() if not line.startswith("#")]
# What the line upgrades; the kernel and all that computes stay as they are.
UPGRADED = {"click", "ipywidgets", "rich"}
EXECUTES = """
import sys, nbclient, nbformat
from importlib.metadata import version
notebook = nbformat.read(sys.argv[1], 4)
nbclient.NotebookClient(notebook, timeout=240, kernel_name="python3").execute()
outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
print(*sorted({kind for output in outputs for kind in output.get("data", ())}))
print(*(name for name, _, old in (line.partition("==") for line in sys.argv[2:]) if version(name) != old))
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
    assert {top for top in tops if not top.endswith((".dist-info", ".data"))} == {"epypes", "epypes_widgets"}


def test_the_wheel_does_the_main_job_in_a_clean_environment(environment):
    everything = environment("all")
    assert str(everything.bin.parent) in everything.python(MAIN_JOB)
    done = everything.epypes("verify", "bundle")
    assert done.returncode == 0, done.stderr
    code = "from jupyter_server.extension.serverextension import main; main(['list'])"
    listed = click.unstyle(everything.python(code))
    assert "epypes.jupyter_server_extension enabled" in listed


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


def test_the_first_tutorial_runs_with_what_colab_has_and_one_line(environment):
    # As %pip install './epypes-VERSION-py3-none-any.whl[widgets]' does.
    colab = environment("widgets", COLAB)
    kinds, changed = colab.python(EXECUTES, str(TUTORIAL), *COLAB).splitlines()
    assert {"image/svg+xml", "application/vnd.jupyter.widget-view+json"} <= set(kinds.split())
    assert set(changed.split()) == UPGRADED
