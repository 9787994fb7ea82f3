"""A graph as a C++ project: its files, its build, its replay, and what is written by hand."""

import gzip
import json
import re
import shutil
import subprocess
import sys
import traceback

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import epypes as ep
from epypes.cli import app
from epypes.errors import BundleError, MissingPackage

LEVEL = 20


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def blurred(gray, blur_kernel=5):
    return cv2.GaussianBlur(gray, (blur_kernel, blur_kernel), 0)


def above(pixels, level):
    return pixels > level + LEVEL


def bright(blurred, level=100, white=255):
    mask = above(blurred, level)
    return np.uint8(mask) * white


@ep.outputs("area", "rows")
def measured(bright):
    return int((bright > 0).sum()), bright.sum(axis=1)


def steady(area, before, weight=0.25):
    if before is None:
        return np.array([[area, 0.0]])
    return before * (1 - weight) + weight * area


def middle(blurred):
    return float(np.median(blurred))


def photograph(radius):
    image = np.zeros((40, 50, 3), np.uint8)
    cv2.circle(image, (25, 20), radius, (250, 240, 230), -1)
    return image


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    cg = ep.CompGraph.from_functions(gray, blurred, bright, measured, steady, middle)
    runner = ep.CompGraphRunner(ep.delay(cg, "steady", "before", initial=None))
    runner.run(image=photograph(9))
    path = tmp_path_factory.mktemp("bundles") / "spots"
    outputs = ["bright", "area", "rows", "steady", "middle"]
    return ep.promote(runner, path, outputs, samples=[photograph(12), photograph(5)]).path


@pytest.fixture(scope="module")
def project(bundle, tmp_path_factory):
    folder = tmp_path_factory.mktemp("projects") / "spots_cpp"
    ep.export_cpp(bundle, folder)
    return folder


def built(folder, *options):
    # Without optimizing, which takes most of the time.
    configure = [
        "cmake",
        "-S",
        folder,
        "-B",
        folder / "build",
        "-DCMAKE_BUILD_TYPE=None",
        "-DCMAKE_CXX_FLAGS=-O0 -Werror",
    ]
    for command in (configure, ["cmake", "--build", folder / "build"]):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return subprocess.run([folder / "build" / "replay", *options], capture_output=True, text=True)


def test_the_table_says_what_is_translated_and_why_the_rest_is_not(bundle, tmp_path):
    done = ep.export_cpp(bundle, tmp_path / "cpp")
    assert [each.function for each in done.functions if each.is_by_hand] == ["middle"]
    reason = "np.median has no translation, in: return float(np.median(blurred))"
    assert str(done).splitlines()[-1].split(maxsplit=1) == ["middle", reason]


def test_the_command_prints_the_table_also_as_json(bundle, tmp_path):
    arguments = ["export", "cpp", str(bundle), "--to", str(tmp_path / "cpp")]
    printed = CliRunner().invoke(app.app, arguments).output
    assert "gray      yes" in printed
    assert "np.median has no translation" in printed
    functions = json.loads(CliRunner().invoke(app.app, [*arguments, "--json"]).output)["functions"]
    assert functions[0] == {"function": "gray", "translated": True, "reason": "", "line": ""}


def test_the_same_bundle_gives_the_same_bytes(bundle, project, tmp_path):
    ep.export_cpp(bundle, tmp_path / "cpp")
    files = [path.relative_to(tmp_path / "cpp") for path in (tmp_path / "cpp").rglob("*") if path.is_file()]
    assert len(files) > 8
    assert all((tmp_path / "cpp" / file).read_bytes() == (project / file).read_bytes() for file in files)


def test_a_folder_that_is_no_export_is_not_touched(bundle, tmp_path):
    (tmp_path / "main.cpp").write_text("int main() {}")
    with pytest.raises(BundleError, match="Name another folder"):
        ep.export_cpp(bundle, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["main.cpp"]


def test_a_token_without_a_type_in_c_plus_plus_is_named(tmp_path):
    def sizes(image):
        return {"height": image.shape[0]}

    def half(found):
        return found["height"] // 2

    runner = ep.CompGraphRunner(ep.CompGraph({"sizes": sizes}, {"sizes": ("image", "found")}))
    runner.run(image=photograph(3))
    with pytest.raises(BundleError, match="token 'found' are a dict") as refused:
        ep.export_cpp(runner, tmp_path / "cpp")
    way_out = "Let 'sizes' return a tuple of arrays, numbers or lists, {}make the graph without it."
    assert way_out.format("") in str(refused.value)
    runner = ep.CompGraphRunner(
        ep.CompGraph({"sizes": sizes, "half": half}, {"sizes": ("image", "found"), "half": ("found", "middle")})
    )
    runner.run(image=photograph(3))
    with pytest.raises(BundleError) as refused:
        ep.export_cpp(runner, tmp_path / "cpp", outputs=["middle"])
    assert way_out.format("merge it with 'half', or ") in str(refused.value)
    # The frames are those of the caller and of the exporting module, none below.
    assert len({frame.filename for frame in traceback.extract_tb(refused.value.__traceback__)}) == 2


def test_a_closure_by_hand_has_its_source_and_what_it_has_captured(tmp_path):
    def above_level(level, table):
        def chosen(image):
            return image[image > level], table[:1]

        return chosen

    chosen = above_level(7, np.zeros(200))
    runner = ep.CompGraphRunner(ep.CompGraph({"chosen": chosen}, {"chosen": ("image", ("pixels", "first"))}))
    runner.run(image=photograph(3))
    text = (ep.export_cpp(runner, tmp_path / "cpp").path / "by_hand.cpp").read_text()
    source = "# level = 7\ndef chosen(image):\n    return image[image > level], table[:1]\n"
    assert "".join(f"//     {line}\n" for line in source.splitlines()) in text


def test_a_state_that_begins_with_an_array_brings_the_header_of_arrays(tmp_path):
    def mixed(image, before):
        return cv2.addWeighted(image, 0.5, before, 0.5, 0)

    cg = ep.delay(ep.CompGraph.from_functions(mixed), "mixed", "before", initial=np.zeros((2, 3), np.uint8))
    runner = ep.CompGraphRunner(cg)
    runner.run(image=np.full((2, 3), 8, np.uint8))
    project = ep.export_cpp(runner, tmp_path / "cpp").path
    text = (project / "graph.hpp").read_text()
    assert "cv::Mat before = numpy::mat(numpy::array<std::uint8_t, 2>({2, 3}, {0, 0, 0, 0, 0, 0}));" in text
    assert '#include "array.hpp"' in text
    assert (project / "array.hpp").is_file()


def test_a_token_that_messages_have_no_form_for_has_no_service(tmp_path):
    def corner(image):
        return cv2.KeyPoint(float(image[0, 0]), 2.0, 3.0)

    runner = ep.CompGraphRunner(ep.CompGraph({"corner": corner}, {"corner": ("image", "point")}))
    runner.run(image=photograph(3)[:, :, 0])
    with pytest.raises(
        BundleError, match="can't bring 'point' to a service in C.., nor an answer carry it: cv::KeyPoint"
    ):
        ep.export_cpp(runner, tmp_path / "cpp", service=True)


def test_without_jinja_the_extra_that_brings_it_is_named(bundle, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingPackage, match=r"Package 'jinja2' is missing. Run: pip install '.*\[cpp\]'"):
        ep.export_cpp(bundle, tmp_path / "cpp")
    assert not (tmp_path / "cpp").exists()


def test_numpy_1_is_refused(bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(np, "__version__", "1.26.4")
    with pytest.raises(BundleError, match=r"needs NumPy 2, .* NumPy 1\.26\.4 is installed"):
        ep.export_cpp(bundle, tmp_path / "cpp")


def test_a_function_by_hand_whose_signature_or_namespace_has_changed_is_named(bundle, tmp_path):
    by_hand = ep.export_cpp(bundle, tmp_path / "cpp").path / "by_hand.cpp"
    start = '#include "graph.hpp"\nnamespace helpers { const char* brace = "{"; }\n'
    head = f"{start}namespace spots {{\n"
    own = "double middle(const cv::Mat &image) { return image.rows; }\n"
    for text in (f"{head}{own}}}\n", f"{start}{own.replace('middle', 'spots::middle')}"):
        by_hand.write_text(text)
        printed = str(ep.export_cpp(bundle, tmp_path / "cpp"))
        assert "middle                written in by_hand.cpp: np.median has no translation, in: return" in printed
    # As after the bundle was renamed.
    for text, was in ((f"{start}namespace dots {{\n{own}}}\n", "dots"), (f"{start}{own}", "none")):
        by_hand.write_text(text)
        assert f"namespace of middle has changed: was {was}, is spots" in str(ep.export_cpp(bundle, tmp_path / "cpp"))
        assert by_hand.read_text() == text
    by_hand.write_text(f"{head}double middle(const cv::Mat &image, int size) {{ return image.rows; }}\n}}\n")
    was, now = "double middle(const cv::Mat &image, int size)", "double middle(const cv::Mat& blurred)"
    printed = str(ep.export_cpp(bundle, tmp_path / "cpp"))
    assert f"signature of middle has changed: was {was}, is {now}" in printed
    by_hand.write_text(f"{head}cv::Mat gray(const cv::Mat& image) {{ return image; }}\n}}\n")
    printed = str(ep.export_cpp(bundle, tmp_path / "cpp"))
    assert "it stands in by_hand.cpp: delete it there to have it translated" in printed


@pytest.mark.slow
def test_the_project_computes_the_samples_and_keeps_what_is_written_by_hand(bundle, project, tmp_path):
    folder = tmp_path / "spots_cpp"
    shutil.copytree(project, folder)
    done = built(folder)
    assert done.returncode == 1
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), photograph(12))
    refused = run(folder, "spots", photo)
    text = "middle: middle is still to be written by hand: see by_hand.cpp\n"
    assert (refused.returncode, refused.stderr) == (1, text)
    lines = done.stdout.splitlines()
    assert "sample 002, steady, steady: bit-identical" in lines
    assert "sample 000, middle, middle is still to be written by hand: see by_hand.cpp" in lines
    others = [line for line in lines if " middle, " not in line and "whole_graph" not in line]
    assert len(others) == 3 * 6
    assert all(line.endswith("bit-identical") for line in others)

    # One that is wrong is seen, also by a tolerance that is too small; it stays at the next export, as it is.
    by_hand = folder / "by_hand.cpp"
    stub = by_hand.read_text()
    assert "//         return float(np.median(blurred))" in stub
    wrong = stub.replace(
        'throw std::logic_error("middle is still to be written by hand: see by_hand.cpp");', "return 1.5;"
    )
    by_hand.write_text(wrong)
    ep.export_cpp(bundle, folder)
    assert by_hand.read_text() == wrong
    done = built(folder)
    assert "sample 000, middle, middle: expected 0, got 1.5; 1 differ, by at most 1.5" in done.stdout
    recorded = f"recorded with OpenCV {cv2.__version__}, this is OpenCV "
    assert done.stdout.splitlines()[-1].startswith(recorded)
    assert "recorded with" not in "".join(lines)
    assert done.returncode == 1
    assert run(folder, "replay", "--tolerance", "middle=1").returncode == 1
    done = run(folder, "replay", "--tolerance", "middle=2")
    assert (done.returncode, done.stdout.count("within the tolerance")) == (0, 6)
    assert "sample 002, whole_graph, steady: bit-identical" in done.stdout
    tested = subprocess.run(["ctest", "--test-dir", folder / "build"], capture_output=True, text=True)
    assert "71% tests passed, 2 tests failed out of 7" in tested.stdout

    # No tolerance allows another shape.
    sample = folder / "samples" / "000.yml.gz"
    text = gzip.decompress(sample.read_bytes()).decode()
    turned = re.sub(r"(\nbright:.*?rows: )40(.*?cols: )50", r"\g<1>50\g<2>40", text, flags=re.DOTALL)
    sample.write_bytes(gzip.compress(turned.encode()))
    shapes = "expected 50 x 40 of type CV_8UC1, got 40 x 50 of type CV_8UC1"
    done = run(folder, "replay", "--only", "bright", "--tolerance", "bright=255")
    assert done.stdout.splitlines()[0] == f"sample 000, bright, bright: the shape or the type differs: {shapes}"

    # Command lines are refused with what there is.
    refused = run(folder, "replay", "--tolerance", "brigth=1")
    assert (refused.returncode, "there are gray, blurred, bright, area, rows" in refused.stderr) == (2, True)
    for text, program, *options in (
        ("there is no option --quick", "replay", "--quick", "1"),
        ("there is no option --levle", "spots", photo, "--levle"),
        ("the option --level needs a value", "spots", photo, "--level"),
        ("there is a second input", "spots", photo, photo),
    ):
        refused = run(folder, program, *options)
        assert (refused.returncode, f"Usage: {program}" in refused.stderr) == (2, True), refused.stderr
        assert text in refused.stderr
    for program in ("replay", "spots"):
        assert run(folder, program, "--help").stdout.startswith(f"Usage: {program}")

    # The program runs the graph, and refuses a value that is out of its range.
    (tmp_path / "steady.png").touch()  # of an earlier run, in which it was an image
    cv2.imwrite(str(tmp_path / "16 bits.png"), photograph(12).astype(np.uint16) * 256)
    cv2.imwrite(str(tmp_path / "gray.png"), gray(photograph(12)))
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned
    Image.fromarray(photograph(12)).save(tmp_path / "turned.png", exif=exif)
    assert cv2.imread(str(tmp_path / "turned.png")).shape == (50, 40, 3)
    for name in ("photo", "16 bits", "gray", "turned"):
        image = tmp_path / f"{name}.png"
        shown = run(folder, "spots", image, "--out", tmp_path, "--level", "120", "--blur_kernel", "3")
        assert shown.returncode == 0, shown.stderr
        expected = bright(blurred(gray(cv2.imread(str(image))), 3), 120)
        assert np.array_equal(cv2.imread(str(tmp_path / "bright.png"), cv2.IMREAD_UNCHANGED), expected), name
    assert not (tmp_path / "steady.png").exists()
    refused = run(folder, "spots", photo, "--blur_kernel", "4")
    assert (refused.returncode, refused.stderr) == (1, "blur_kernel has to be at least 1 and odd\n")
    refused = run(folder, "spots", photo, "--white", "256")
    assert (refused.returncode, refused.stderr) == (1, "bright: integer 256 is out of bounds for uint8\n")
    refused = run(folder, "spots", photo, "--level", "abc")
    assert (refused.returncode, refused.stderr) == (1, "--level: 'abc' is no number of this type\n")


def run(folder, program, *arguments):
    return subprocess.run([folder / "build" / program, *arguments], capture_output=True, text=True)
