"""The graphs of the paper and of the tutorials in C++: what is translated, compiled, and replayed by ctest."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

import epypes as ep
from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
from tests.bundle.cells import cell
from tests.cpp import vision
from tests.cpp.building import build, bundle_of, replay
from tests.cpp.random_functions import call

pytestmark = pytest.mark.slow  # they compile

ROOT = Path(__file__).parents[2]
# What scikit-image and SciPy compute; the first of them is short enough to be written here.
CLEAN = """
#include <opencv2/imgproc.hpp>

namespace coins {

numpy::Array<bool, 2> clean(const numpy::Array<bool, 2>& mask, int closing_px, int smallest_px) {
    cv::Mat coins = numpy::mat(numpy::astype<std::uint8_t>(mask));
    if (closing_px > 0) {
        cv::Mat disk(2 * closing_px + 1, 2 * closing_px + 1, CV_8U);
        for (int y = -closing_px; y <= closing_px; ++y) {
            for (int x = -closing_px; x <= closing_px; ++x) {
                disk.at<uchar>(y + closing_px, x + closing_px) = x * x + y * y <= closing_px * closing_px;
            }
        }
        cv::morphologyEx(coins, coins, cv::MORPH_CLOSE, disk);
    }
    cv::Mat outside, labels, stats, centroids;
    cv::copyMakeBorder(coins, outside, 1, 1, 1, 1, cv::BORDER_CONSTANT, 0);
    cv::floodFill(outside, cv::Point(0, 0), 2, nullptr, cv::Scalar(), cv::Scalar(), 4);
    coins = outside(cv::Rect(1, 1, coins.cols, coins.rows)) != 2;
    const int count = cv::connectedComponentsWithStats(coins, labels, stats, centroids, 4);
    for (int label = 1; label < count; ++label) {
        if (stats.at<int>(label, cv::CC_STAT_AREA) <= smallest_px) {
            coins.setTo(0, labels == label);
        }
    }
    return numpy::astype<bool>(numpy::array<std::uint8_t, 2>(coins));
}

}  // namespace coins
"""

# In an environment with another OpenCV: which values of a bundle's samples it computes otherwise.
DIFFERING = """
import pathlib, sys
import epypes as ep
from epypes.bundle.proof.compare import differences
from epypes.wire import load_sample
runner = ep.load(sys.argv[1])
for file in pathlib.Path(sys.argv[1], "samples").iterdir():
    inputs, outputs = load_sample(file)
    run = runner.run(**inputs)
    for token, expected in outputs.items():
        for found in differences(expected, run[token]):
            print(file.stem, token, found.text)
"""
IN_PYTHON = re.compile(r"(\d+) (\w+) (\d+) of \d+ values differ, first at (\[.*?\]): expected (.*?), got (.*?)(?:;|\n)")
IN_CPP = re.compile(r"sample (\d+), (\w+)(\[.*?\]): expected (.*?), got (.*?); (\d+) differ")


def cells(name):
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", nbformat.NO_CONVERT)
    return [each.source for each in notebook.cells if each.cell_type == "code"]


def coins():
    """Return the runner of tutorial 3, which has run on its photograph."""
    return cell(cells("03_tuning")[0])["runner"]


def lanes():
    """Return the runner of tutorial 10, which has run on three frames of its clip."""
    first, *others = cells("10_lane_detection")
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(ROOT / "notebooks")
        names = cell("import lanes\n", cell(first))
        runner = cell(next(text for text in others if "ep.delay(" in text), names)["runner"]
        runner.reset()
        for image in names["clip"][:3]:
            runner.run(image=image)
        return runner


def orb():
    """Return the runner of the paper's experiment, which has run on a stereo pair."""
    runner = ep.CompGraphRunner(orb_graph(), orb_hyperparameters())
    left, right = stereo_pair()
    runner.run(image_1=left, image_2=right)
    return runner


def exported(runner, folder, *outputs):
    """Return the export of a runner, and which functions are by hand."""
    done = ep.export_cpp(runner, folder, outputs=outputs or None)
    return done, [each.function for each in done.functions if each.is_by_hand]


def ctest(project):
    """Compile a project and run its tests; return which passed and which did not."""
    done = subprocess.run(["ctest", "--test-dir", build(project)], capture_output=True, text=True)
    found = re.findall(r"Test +#\d+: (\w+) \.+ *(Passed|\*\*\*Failed)", done.stdout)
    assert found, done.stdout + done.stderr
    return [name for name, end in found if end == "Passed"], [name for name, end in found if end != "Passed"]


def test_the_edge_graph(edge_runner, photograph, tmp_path):
    edge_runner.run(image=photograph)
    done, by_hand = exported(edge_runner, tmp_path / "edges")
    assert by_hand == []
    assert ctest(done.path) == (["grayscale", "blur", "canny", "whole_graph"], [])


def test_the_orb_graph_with_the_same_descriptors(tmp_path):
    outputs = "keypoints_1", "descriptors_1", "keypoints_2", "descriptors_2", "matches", "keypoints_paired"
    done, by_hand = exported(orb(), tmp_path / "orb", *outputs)
    assert by_hand == []
    passed, failed = ctest(done.path)
    assert failed == []
    assert "whole_graph" in passed


def test_the_lanes_of_tutorial_10_with_state_between_frames(tmp_path):
    done, by_hand = exported(lanes(), tmp_path / "lanes", "steady", "car_offset", "shown")
    assert by_hand == []
    passed, failed = ctest(done.path)
    assert failed == []
    assert {"smooth", "lane", "whole_graph"} <= {*passed}


def test_the_coins_of_tutorial_3_of_which_scikit_image_is_by_hand(tmp_path):
    done, by_hand = exported(coins(), tmp_path / "coins")
    assert by_hand == ["clean", "separate"]
    file = done.path / "by_hand.cpp"
    text = file.read_text()
    start = text.index("numpy::Array<bool, 2> clean(")
    file.write_text(text[:start] + text[text.index("}\n", start) + 2 :] + CLEAN)
    passed, failed = ctest(done.path)
    # The graph as a whole needs `separate`, SciPy's distance transform and scikit-image's watershed.
    assert failed == ["separate", "whole_graph"]
    assert passed == ["cut_out", "denoise", "flatten", "above", "clean", "measure"]


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_differs_is_what_pythons_opencv_of_the_same_version_computes_otherwise(tmp_path):
    """Of the functions of `vision`, recorded by the newest OpenCV of Python; the one of C++ is Debian's, 4.6."""
    inputs = {name: values for name, values in vision.INPUTS.items() if name != "peaks"}
    bundle = bundle_of(tmp_path / "vision", vision.SOURCE, inputs, call)
    export = ep.export_cpp(bundle, tmp_path / "cpp")
    lines = replay(export, build(export.path, target="replay") / "replay")
    translated = [each.function for each in export.functions if not each.is_by_hand]
    in_cpp = {IN_CPP.search(line).groups() for name in translated for line in lines[name]}
    command = [opencv_4_6() / "bin" / "python", "-W", "ignore", "-c", DIFFERING, bundle]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env={"PYTHONPATH": str(ROOT)})
    # Sample, token, the first place that differs, what was recorded, what was computed, and how many differ.
    in_python = {found.group(1, 2, 4, 5, 6, 3) for found in IN_PYTHON.finditer(done.stdout)}
    assert {token for _, token, *_ in in_cpp} == {"drawn_boxes_out", "rotated_out"}
    assert in_cpp <= in_python


def opencv_4_6():
    """Return an environment with OpenCV 4.6 and what loading a bundle needs; it is made once."""
    folder = ROOT / ".venv" / "opencv-4.6"
    if not (folder / "made").exists():
        uv = [sys.executable, "-m", "uv"]
        packages = [
            "opencv-python-headless==4.6.0.66",
            "numpy<2",
            "click",
            "networkx",
            "packaging",
            "protobuf",
            "rich",
            "tomlkit",
        ]
        subprocess.run([*uv, "venv", "--quiet", "--clear", "--python", sys.executable, folder], check=True)
        subprocess.run([*uv, "pip", "install", "--quiet", "--python", folder / "bin" / "python", *packages], check=True)
        (folder / "made").touch()
    return folder
