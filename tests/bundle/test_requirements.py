"""The requirements are what the functions import, no more and no less; of twins the loaded one is named."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
import sys
from importlib import metadata

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.requirements import fresh_environment, pins, requirement_lines
from epypes.errors import BundleError
from tests.bundle.test_slicer import notebook

SOURCE = """
import pandas  # the notebook's own, which no function needs
import matplotlib.figure
import numpy as np

def read(x):
    import networkx  # lazily, and EPypes knows it too
    if x < 0:  # which the sample is not
        from skimage import color
        import nowhere
        return color.rgb2gray(nowhere.read())
    return np.asarray(networkx.path_graph(3).degree(1) + x)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_lazy_imports_are_captured_and_imports_of_the_notebook_or_of_epypes_are_not(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"read": notebook(SOURCE)["read"]}, {"read": ("x", "y")}))
    runner.run(x=1)
    ep.promote(runner, tmp_path / "b")
    lines = (tmp_path / "b" / "requirements.txt").read_text().splitlines()
    found = pins(lines)
    assert {"networkx", "numpy", "epypes", "scikit-image"} <= set(found)
    assert not {"pandas", "matplotlib", "protobuf", "typer", "rich", "opencv-python-headless"} & set(found)
    assert found["numpy"] == np.__version__
    assert list(found) == sorted(found)


def test_tables_need_pyarrow():
    assert {"pandas", "pyarrow"} <= set(pins(requirement_lines({"pandas"})))
    assert "pyarrow" not in pins(requirement_lines({"numpy"}))


def distribution(folder, name, version, files=(), source=None):
    """Write what an installer writes of a distribution: its metadata and the hashes of the files that it brought."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = []
    for path, content in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(content)
        made = base64.urlsafe_b64encode(hashlib.sha256(content.encode()).digest()).decode().rstrip("=")
        lines.append(f"{path},sha256={made},{len(content)}")
    (info / "RECORD").write_text("\n".join([*lines, f"{info.name}/RECORD,,"]) + "\n")
    if source:
        (info / "direct_url.json").write_text(json.dumps(source))


def requirements(folder, *modules):
    """Return the requirements of modules that a new interpreter imports from a folder."""
    code = (
        f"import sys, importlib; sys.path.insert(0, {str(folder)!r})\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "from epypes.bundle.requirements import requirement_lines\n"
        f"print('\\n'.join(requirement_lines({modules!r})))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [line for line in done.stdout.splitlines() if not line.startswith(("epypes=", "# epypes "))]


@pytest.mark.slow
@pytest.mark.parametrize("last", ["opencv-python", "opencv-python-headless", "opencv-contrib-python"])
def test_of_two_builds_of_opencv_the_one_that_was_loaded_is_named_with_a_warning(tmp_path, last):
    names = ["opencv-python", "opencv-python-headless", "opencv-contrib-python"]
    for name in [*(name for name in names if name != last), last]:
        # Each overwrites what the one before has brought.
        distribution(
            tmp_path, name, "4.9.0.80", [("cv2/__init__.py", "x = 1\n"), ("cv2/version.py", f"b = '{name}'\n")]
        )
    warning, pin = requirements(tmp_path, "cv2")
    assert pin == f"{last}==4.9.0.80"
    assert all(name in warning for name in names)
    assert warning.startswith("# ")
    assert "uninstall all but one" in warning


@pytest.mark.slow
def test_the_headless_build_that_is_installed_here_is_named_alone():
    (line,) = (line for line in requirements("/nowhere", "cv2", "cv2.data") if "opencv" in line)
    assert line == f"opencv-python-headless=={metadata.version('opencv-python-headless')}"
    assert cv2.__version__ in line


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_parts_of_a_namespace_are_told_apart(tmp_path):
    distribution(tmp_path, "lab-left", "1", [("lab/left/__init__.py", "")])
    distribution(tmp_path, "Lab_Right", "2.0+cpu", [("lab/right/__init__.py", "")])
    assert requirements(tmp_path, "lab.left") == ["lab-left==1"]
    assert requirements(tmp_path, "lab.right", "lab") == [
        "# 2.0+cpu is a local version: an index of its own has it.",
        "Lab_Right==2.0+cpu",
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_an_editable_install_is_named_with_a_comment(tmp_path):
    checkout, site = tmp_path / "checkout", tmp_path / "site"
    checkout.mkdir(), site.mkdir()
    (checkout / "mine.py").write_text("")
    source = {"url": checkout.as_uri(), "dir_info": {"editable": True}}
    distribution(site, "mine", "0.3", source=source)
    (site / "path.py").write_text(f"import sys; sys.path.append({str(checkout)!r})")
    comment, pin = requirements(site, "path", "mine")
    assert pin == "mine==0.3"
    assert comment == "# mine was installed as editable, from a folder, not from an index: install it from there first."


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_python_itself_and_modules_without_a_distribution_are_no_requirements(tmp_path):
    (tmp_path / "loose.py").write_text("")
    assert requirements(tmp_path, "json", "email.message", "loose") == []


def test_pins_are_read_with_comments_and_markers_passed_over():
    lines = ["# numpy==1", "NumPy==2.0 ; python_version > '3'", "a_b.c==1+cpu", "x>=3", ""]
    assert pins(lines) == {"numpy": "2.0", "a-b-c": "1+cpu"}


@pytest.fixture
def bundle(tmp_path):
    """A folder of which only the requirements are read."""
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "requirements.txt").write_text("# a comment\nnumpy==1.2.3\nepypes==0.0.1\n")
    return tmp_path / "b"


def why_no_environment(bundle):
    with pytest.raises(BundleError) as caught, fresh_environment(bundle):
        pass
    return str(caught.value)


def test_requirements_that_can_not_be_read_are_refused(bundle):
    (bundle / "requirements.txt").unlink()
    assert "requirements.txt can't be read" in why_no_environment(bundle)


@pytest.mark.slow
def test_what_can_not_be_installed_is_named(bundle, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    why = why_no_environment(bundle)
    assert why.startswith(f"{bundle}: What requirements.txt names can't be installed: ")
    assert "No matching distribution found for " in why
    assert why.endswith(". Mend requirements.txt in a new promotion, or verify without --fresh-env.")


@pytest.mark.slow
def test_without_a_network_the_reason_is_one_sentence_without_addresses(bundle, monkeypatch):
    for name, value in {"CONFIG_FILE": os.devnull, "INDEX_URL": "http://127.0.0.1:1/simple", "RETRIES": "1"}.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    for name in ("PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    assert why_no_environment(bundle) == (
        f"{bundle}: What requirements.txt names can't be installed: no package index answers. Connect to the network, "
        "or verify without --fresh-env."
    )
