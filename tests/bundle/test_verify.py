"""Verification names what was broken: a constant, an expected output, a sample, a pin, another machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import recorded_environment, write_manifest
from epypes.bundle.proof.replay import replay
from epypes.errors import BundleError, ReplayDiffers
from epypes.wire import load_sample, save_sample
from tests.bundle.test_slicer import notebook

pytestmark = pytest.mark.slow  # each replays a bundle in a process of its own

SOURCE = """
import cv2
import numpy as np

OFFSET = 40

def smooth(image, side):
    return cv2.medianBlur(image, side)

def mark(smoothed):
    return np.where(smoothed > OFFSET, 255, 0).astype(np.uint8)

def find(marked):
    points = cv2.ORB_create(50).detect(marked, None)
    return points, {"largest", "smallest"}, len(points)
"""


@pytest.fixture(scope="module")
def promoted(tmp_path_factory):
    functions = notebook(SOURCE)
    io = {"smooth": (("image", "side"), "smoothed"), "mark": ("smoothed", "marked"),
          "find": ("marked", ("points", "words", "count"))}  # fmt: skip
    runner = ep.CompGraphRunner(ep.CompGraph({name: functions[name] for name in io}, io), {"side": 5})
    runner.run(image=np.random.default_rng(3).integers(0, 90, (120, 160), np.uint8))
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "marks", ["marked", "points", "words"])


@pytest.fixture
def folder(promoted, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(promoted.path, tmp_path / "marks")


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def without_comments(folder):
    """Make the manifest one that does not name what the samples were recorded with."""
    manifest = folder / "MANIFEST.sha256"
    manifest.write_text("".join(line for line in manifest.read_text().splitlines(True) if line[0] != "#"))


def refused(folder):
    with pytest.raises(BundleError) as caught:
        verify(folder, run_anyway=True)
    return str(caught.value)


@pytest.mark.usefixtures("fresh_interpreter")
def test_a_changed_constant_is_named_with_its_line_and_the_first_difference(folder):
    change(folder / "pipeline.py", "OFFSET = 40", "OFFSET = 41")
    line = (folder / "pipeline.py").read_text().splitlines().index("OFFSET = 41") + 1
    text = refused(folder)
    assert f"pipeline.py was changed at line {line}: OFFSET = 41" in text
    assert "sample 000, token 'marked': " in text
    assert "values differ, first at [" in text
    write_manifest(folder)
    with pytest.raises(ReplayDiffers) as caught:
        verify(folder)
    tokens = [difference.token for difference in caught.value.report.differences]
    assert tokens == ["marked", "points"], "and not the words, which do not depend on it"


def test_a_sample_that_cannot_be_read_any_more_is_named_with_why(folder):
    (folder / "samples" / "000.npz").write_bytes(b"broken")
    assert "samples/000.npz was changed" in refused(folder)
    assert "It can't be replayed" in refused(folder)


def test_a_changed_comment_is_found_and_changes_no_token(folder):
    change(folder / "pipeline.py", "OFFSET = 40", "OFFSET = 40  # brighter")
    assert "at line" in refused(folder)
    assert refused(folder).endswith("promote again. It still computes what was recorded.")


def test_a_line_that_was_added_or_removed_is_named(folder):
    module = folder / "pipeline.py"
    before = module.read_text()
    module.write_text("# mine\n" + before)
    assert "pipeline.py was changed at line 1: # mine" in refused(folder)
    module.write_text(before.replace("import numpy as np\n", ""))
    assert "is missing" in refused(folder)


def test_a_changed_setting_is_named_with_its_line(folder):
    change(folder / "pipeline.toml", "value = 5", "value = 3")
    assert "pipeline.toml was changed at line" in refused(folder)
    assert ": value = 3." in refused(folder)


def test_a_changed_expected_output_is_named_with_token_and_index(folder):
    path = folder / "samples" / "000.npz"
    inputs, outputs = load_sample(path)
    marked = outputs["marked"].copy()
    marked[7, 9] ^= 255
    save_sample(path, inputs, {**outputs, "marked": marked})
    assert "samples/000.npz was changed" in refused(folder)
    assert "token 'marked': 1 of 19200 values differ, first at [7, 9]" in refused(folder)


def test_a_changed_keypoint_is_named_by_its_field(folder):
    path = folder / "samples" / "000.npz"
    inputs, outputs = load_sample(path)
    outputs["points"][2].angle += 1
    save_sample(path, inputs, outputs)
    assert "token 'points': [2] .angle expected" in refused(folder)


def test_a_broken_sample_is_named(folder):
    path = folder / "samples" / "000.npz"
    path.write_bytes(path.read_bytes()[:400])
    assert "samples/000.npz was changed" in refused(folder)
    write_manifest(folder)
    assert "000.npz is no sample" in refused(folder)


def test_a_changed_pin_is_named(folder):
    version = np.__version__
    change(folder / "requirements.txt", f"numpy=={version}", "numpy==1.0.1")
    assert "requirements.txt was changed at line" in refused(folder)
    assert ": numpy==1.0.1" in refused(folder)
    write_manifest(folder)
    assert f"requirements.txt pins numpy 1.0.1, and {version} is imported here." in verify(folder).notes


def test_a_missing_pin_is_named(folder):
    lines = (folder / "requirements.txt").read_text().splitlines()
    (folder / "requirements.txt").write_text("\n".join(line for line in lines if "opencv" not in line) + "\n")
    write_manifest(folder)
    assert any("does not name what is imported: opencv-python-headless" in note for note in verify(folder).notes)


def test_what_the_samples_were_recorded_on_is_compared(folder):
    recorded = recorded_environment(folder)
    assert {"python", "platform", "processor", "opencv", "opencv threads"} <= set(recorded)
    write_manifest(folder, {**recorded, "opencv threads": "96", "opencv": "4.5.0 abc"})
    notes = "\n".join(verify(folder).notes)
    assert "another number of threads of OpenCV: 96, here it is" in notes
    assert "another build of OpenCV: 4.5.0 abc, here it is" in notes


def test_the_manifest_is_one_that_sha256sum_reads(folder):
    done = subprocess.run(
        ["sha256sum", "--check", "--strict", "--quiet", "MANIFEST.sha256"], cwd=folder, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_sealing_again_keeps_what_the_samples_were_recorded_on(folder):
    before = (folder / "MANIFEST.sha256").read_bytes()
    write_manifest(folder)
    assert (folder / "MANIFEST.sha256").read_bytes() == before


@pytest.mark.usefixtures("fresh_interpreter")
def test_values_that_differ_from_run_to_run_are_named_as_such(folder):
    change(folder / "pipeline.py", "smoothed > OFFSET", "smoothed > OFFSET + np.random.randint(0, 60, smoothed.shape)")
    write_manifest(folder)
    text = refused(folder)
    assert "'marked', 'points' differ from run to run in one process" in text


def test_without_a_known_cause_the_usual_ones_are_named(folder):
    change(folder / "pipeline.toml", "value = 5", "value = 3")
    write_manifest(folder)
    assert "Likely: Neither the bundle nor what it runs on has changed as far as is known" in refused(folder)


@pytest.mark.parametrize("number", range(3))
def test_it_is_the_same_from_another_folder_locale_and_seed_of_hashes(folder, tmp_path, number):
    code = (
        "import sys, locale, json; locale.setlocale(locale.LC_ALL, '')\n"
        "from epypes.bundle import verify\n"
        "print(json.dumps(verify(sys.argv[1]).to_dict()))"
    )
    variables = {
        **os.environ,
        "PYTHONHASHSEED": str(number),
        "LC_ALL": ["C", "C.UTF-8", "POSIX"][number],
        "TZ": ["UTC", "Asia/Tokyo", "America/Lima"][number],
    }
    where = [tmp_path, "/", folder][number]
    done = subprocess.run(
        [sys.executable, "-I", "-c", code, os.path.relpath(folder, where)],
        capture_output=True,
        text=True,
        check=True,
        cwd=where,
        env=variables,
    )
    report = json.loads(done.stdout)
    assert (report["identical"], report["notes"], report["tokens"]) == (True, [], 3)


def test_an_older_manifest_without_comments_is_a_bundle_still(folder):
    without_comments(folder)
    assert verify(folder).identical
    change(folder / "pipeline.toml", "value = 5", "value = 3")
    assert "pipeline.toml was changed. Restore it" in refused(folder)


@pytest.mark.usefixtures("fresh_interpreter")
def test_the_number_of_threads_of_opencv_is_reported(folder):
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        assert replay(read_bundle(folder)).environment["opencv threads"] == "1"
    finally:
        cv2.setNumThreads(before)
