from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import os
import py_compile
import re
import shutil
import threading
import tomllib
import types
from pathlib import Path

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.adapters import payload_of
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.bundle.promote import promote_notebook
from epypes.bundle.proof.compare import first_difference
from epypes.errors import BundleError, PromotionRefused, ReplayDiffers, UnknownName
from epypes.graph import colour_order
from epypes.wire import Envelope
from tests.bundle.test_slicer import notebook
from tests.colours import red_image, red_runner

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

promote_module = importlib.import_module("epypes.bundle.promote")

# Functions of a test module are importable names of it, which a bundle can't have: OpenCV's own serve.
FUNCTIONS = {"split": cv2.split, "canny": cv2.Canny}


def edges_runner(photograph):
    cg = ep.CompGraph(
        {"smooth": cv2.medianBlur, "canny": cv2.Canny},
        {"smooth": (("image", "side"), "smoothed"), "canny": (("smoothed", "lo", "hi"), "edges")},
    )
    runner = ep.CompGraphRunner(cg, {"side": 5, "lo": 70, "hi": 200})
    runner.run(image=photograph)
    return runner


@pytest.fixture
def runner(photograph):
    return edges_runner(photograph)


@pytest.fixture(scope="module")
def promoted(photograph, tmp_path_factory):
    """The bundle of the runner below, promoted once."""
    return ep.promote(edges_runner(photograph), tmp_path_factory.mktemp("bundles") / "edges", outputs=["edges"])


@pytest.fixture
def bundle(promoted, tmp_path):
    """A copy of it that a test may spoil."""
    return read_bundle(shutil.copytree(promoted.path, tmp_path / "edges"))


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_bundle_is_a_folder_of_text_and_samples_without_pickle(bundle):
    files = contents(bundle.path)
    assert set(files) == {"pipeline.py", "pipeline.toml", "requirements.txt", "MANIFEST.sha256", "samples/000.npz"}
    for name in files.keys() - {"samples/000.npz"}:
        files[name].decode("ascii")
    with np.load(bundle.path / "samples" / "000.npz", allow_pickle=False) as sample:
        assert all(sample[name].dtype != object for name in sample.files)


def test_loading_gives_the_same_graph_and_hyperparameters(bundle, runner, photograph):
    again = ep.load(bundle.path)
    assert again.cg.func_io == runner.cg.func_io
    assert again.hyperparameters == runner.hyperparameters
    assert np.array_equal(again.run(image=photograph)["edges"], runner["edges"])


def test_the_same_runner_promotes_to_the_same_bytes(runner, tmp_path):
    ep.promote(runner, tmp_path / "one" / "edges")
    ep.promote(runner, tmp_path / "two" / "edges")
    assert contents(tmp_path / "one" / "edges") == contents(tmp_path / "two" / "edges")


def test_requirements_name_what_the_replay_imported_and_nothing_else(bundle):
    names = [line.partition("==")[0] for line in (bundle.path / "requirements.txt").read_text().splitlines()]
    assert {"numpy", "opencv-python-headless", "epypes"} <= set(names)
    assert not {"scikit-image", "ipywidgets", "pytest", "opencv-python"} & set(names)


def test_verify_replays_in_a_fresh_process(bundle):
    report = verify(bundle.path)
    assert report.identical
    assert (report.samples, report.tokens) == (1, 1)


@pytest.mark.parametrize("name", ["pipeline.py", "pipeline.toml", "requirements.txt", "samples/000.npz"])
def test_one_changed_byte_is_found_and_the_file_is_named(bundle, name):
    path = bundle.path / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    for use in (verify, ep.load, lambda path: ep.load_pipeline(path, None, None)):
        with pytest.raises(BundleError, match=f"{name} was changed.*Restore it, or promote again"):
            use(bundle.path)


def test_missing_and_added_files_are_named(bundle):
    (bundle.path / "requirements.txt").unlink()
    (bundle.path / "cv2.py").write_text("raise SystemExit('hijacked')")
    with pytest.raises(BundleError, match=r"requirements\.txt is missing; cv2\.py was added"):
        ep.load(bundle.path)


def test_a_folder_that_is_no_bundle_is_named(tmp_path):
    with pytest.raises(BundleError, match="does not exist"):
        ep.load(tmp_path / "nothing")
    with pytest.raises(BundleError, match="is not a bundle"):
        ep.load(tmp_path)
    (tmp_path / "coins.png").touch()
    with pytest.raises(BundleError, match="is a file. Name the folder of a bundle"):
        ep.load(tmp_path / "coins.png")


def test_a_changed_constant_is_found_by_the_replay_with_its_first_difference(bundle):
    settings = bundle.path / "pipeline.toml"
    settings.write_text(settings.read_text().replace("value = 70", "value = 30"))
    write_manifest(bundle.path)
    with pytest.raises(ReplayDiffers, match=r"token 'edges': \d+ of 240000 values differ, first at \[\d+, \d+\]"):
        verify(bundle.path)


def test_a_replay_that_raises_names_the_line_in_the_bundle(bundle):
    module = bundle.path / "pipeline.py"
    module.write_text(module.read_text().replace("cv2.Canny", "(lambda *a: 1 / 0)"))
    write_manifest(bundle.path)
    with pytest.raises(BundleError, match=r"at pipeline\.py, line \d+: .*ZeroDivisionError.*In function 'canny'"):
        verify(bundle.path)


@pytest.mark.parametrize(
    "end", ["import os; os.kill(os.getpid(), 9)", "import sys; sys.exit(3)", "import os; os._exit(4)"]
)
@pytest.mark.usefixtures("fresh_interpreter")
def test_a_replay_that_dies_is_reported(bundle, end):
    module = bundle.path / "pipeline.py"
    module.write_text(f"{module.read_text()}\n{end}\n")
    write_manifest(bundle.path)
    with pytest.raises(
        BundleError, match="replay of .* (died .*: run the functions in a new process|failed.*SystemExit)"
    ):
        verify(bundle.path)


@pytest.mark.slow
def test_a_replay_that_takes_too_long_is_ended(bundle):
    module = bundle.path / "pipeline.py"
    module.write_text(f"{module.read_text()}\nimport threading\nthreading.Event().wait(120)\n")
    write_manifest(bundle.path)
    with pytest.raises(
        BundleError, match="did not end within 2 s. Each sample is run twice: give fewer or smaller samples"
    ):
        verify(bundle.path, timeout_s=2)


@pytest.mark.usefixtures("fresh_interpreter")
def test_the_replay_sees_neither_the_current_folder_nor_the_environment(bundle, tmp_path, monkeypatch):
    (tmp_path / "cv2.py").write_text("raise SystemExit('hijacked')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert verify(bundle.path).identical


def test_bytecode_beside_the_module_is_never_read(bundle):
    module = bundle.path / "pipeline.py"
    original = module.read_bytes()
    stamp = module.stat()
    module.write_text("func_dict = func_io = {}\n".ljust(len(original)))
    os.utime(module, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    py_compile.compile(str(module))
    module.write_bytes(original)
    os.utime(module, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    assert list(ep.load(bundle.path).cg.functions) == ["smooth", "canny"]


def test_a_runner_that_is_not_ready_is_refused_with_the_call_to_make(runner, tmp_path):
    fresh = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    with pytest.raises(PromotionRefused, match=r"Nothing has been run.*Call run\(image=\.\.\.\) first"):
        ep.promote(fresh, tmp_path / "b")
    runner["lo"] = 10
    with pytest.raises(PromotionRefused, match=r"stale: canny\. Call rerun\(\) first"):
        ep.promote(runner, tmp_path / "b")
    with pytest.raises(cv2.error):
        runner.rerun(side=4)
    with pytest.raises(PromotionRefused, match="The last run failed in smooth"):
        ep.promote(runner, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_output_is_named(runner, tmp_path):
    with pytest.raises(UnknownName, match="Did you mean 'edges'"):
        ep.promote(runner, tmp_path / "b", outputs=["edgse"])


def test_a_token_without_codec_refuses_promotion_by_name(tmp_path):
    cg = ep.CompGraph({"detect": cv2.ORB_create().detect}, {"detect": ("image", "keypoints")})
    runner = ep.CompGraphRunner(cg)
    runner.run(image=np.zeros((64, 64), np.uint8))
    with pytest.raises(PromotionRefused, match="Function 'detect'"):
        ep.promote(runner, tmp_path / "b")
    cg = ep.CompGraph({"zero": cv2.TickMeter}, {"zero": ((), "meter")})
    runner = ep.CompGraphRunner(cg)
    runner.run()
    with pytest.raises(PromotionRefused, match="meter is of type cv2.TickMeter, which has no codec"):
        ep.promote(runner, tmp_path / "b")


def test_a_hyperparameter_that_toml_cannot_hold_is_refused_by_name(tmp_path):
    cg = ep.CompGraph({"add": np.add}, {"add": (("x", "k"), "y")})
    runner = ep.CompGraphRunner(cg, {"k": [np.ones(999)]})
    runner.run(x=np.zeros(999))
    with pytest.raises(
        PromotionRefused, match=r"'k' is or holds an array of 999 numbers; 400 are the most that pipeline\.toml holds"
    ):
        ep.promote(runner, tmp_path / "b")


@pytest.mark.usefixtures("fresh_interpreter")
def test_hyperparameters_come_back_with_their_type(tmp_path):
    values = [3, 2.5, float("inf"), "text", True, None, (3, 5), [1, 2.0], -(2**63), 'a"b\n\\']
    hparams = {f"k{index}": value for index, value in enumerate(values)}
    functions = {f"keep_{name}": repr for name in hparams}
    cg = ep.CompGraph(functions, {f"keep_{name}": (name, f"{name}_kept") for name in hparams})
    runner = ep.CompGraphRunner(cg, hparams)
    runner.run()
    back = ep.promote(runner, tmp_path / "b").settings.hyperparameters
    assert repr(back) == repr(hparams), "of the same type, to the last digit"


def test_a_number_of_numpys_is_written_as_a_number(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"add": np.add}, {"add": (("x", "k"), "y")}), {"k": np.float64(1.5)})
    runner.run(x=np.zeros(3))
    assert ep.promote(runner, tmp_path / "b").settings.hyperparameters["k"] == 1.5


def test_ranges_stand_in_the_settings(runner, tmp_path):
    bundle = ep.promote(runner, tmp_path / "b")
    document = tomllib.loads((bundle.path / "pipeline.toml").read_text())
    assert document["ports"] == {"inputs": ["image"], "outputs": ["edges"]}
    gradient = {"low": 0, "soft": [0, 500], "about": "Gradient from which an edge is followed."}
    assert document["hyperparameters"]["lo"] == {"value": 70, **gradient}


def test_a_function_that_depends_on_hidden_state_is_refused(tmp_path):
    cg = ep.CompGraph({"draw": np.random.random_sample}, {"draw": ("n", "y")})
    runner = ep.CompGraphRunner(cg, {"n": 3})
    runner.run()
    with pytest.raises(PromotionRefused):
        ep.promote(runner, tmp_path / "b")
    cg = ep.CompGraph({"pid": os.getpid}, {"pid": ((), "y")})
    runner = ep.CompGraphRunner(cg)
    runner.run()
    with pytest.raises(PromotionRefused, match=r"(?s)token 'y': expected .*something that is not a token"):
        ep.promote(runner, tmp_path / "b")


def test_a_new_bundle_replaces_the_old_and_a_refused_one_leaves_it(runner, tmp_path):
    target = tmp_path / "edges"
    ep.promote(runner, target)
    runner.rerun(lo=10)
    bundle = ep.promote(runner, target)
    assert bundle.settings.hyperparameters["lo"] == 10
    before = contents(target)
    runner["lo"] = 20
    with pytest.raises(PromotionRefused):
        ep.promote(runner, target)
    assert contents(target) == before
    assert [path.name for path in tmp_path.iterdir()] == ["edges"]


def test_a_folder_that_holds_something_else_is_not_touched(runner, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(PromotionRefused, match="exists and is not a bundle"):
        ep.promote(runner, tmp_path)
    with pytest.raises(PromotionRefused, match="exists and is not a bundle"):
        ep.promote(runner, tmp_path / "thesis.tex")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("manifest", "words"),
    [
        ("x", "is not a bundle"),
        ("x  thesis.tex\n", "is not a bundle"),
        ("", "is not a bundle"),
        ("x  ../a\n", "is not a"),
    ],
)
def test_a_folder_with_a_manifest_that_is_no_bundles_is_not_touched(manifest, words, runner, tmp_path):
    (tmp_path / "MANIFEST.sha256").write_text(manifest)
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(PromotionRefused, match=words):
        ep.promote(runner, tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


@pytest.mark.parametrize("name", ["notes.txt", "samples/mine.npz", "__pycache__/results.csv"])
def test_a_bundle_with_a_file_that_is_not_its_own_is_not_replaced(name, bundle, runner):
    (bundle.path / name).parent.mkdir(exist_ok=True)
    (bundle.path / name).write_text("measured by hand")
    with pytest.raises(PromotionRefused, match=f"not the bundle's: {name}.*name another folder, or move that away"):
        ep.promote(runner, bundle.path)
    assert (bundle.path / name).read_text() == "measured by hand"


def test_a_bundle_with_changed_and_missing_files_and_bytecode_is_replaced(bundle, runner):
    (bundle.path / "requirements.txt").unlink()
    module = bundle.path / "pipeline.py"
    module.write_text(module.read_text() + "# by hand\n")
    py_compile.compile(str(module))
    assert ep.promote(runner, bundle.path, outputs=["edges"]).digest


@pytest.mark.parametrize("was_there", [True, False])
def test_what_is_put_there_while_the_promotion_runs_is_kept(was_there, bundle, runner):
    mine = bundle.path / "mine.csv"
    if not was_there:
        shutil.rmtree(bundle.path)

    def put(text):
        if "replaying" in text:
            bundle.path.mkdir(exist_ok=True)
            mine.write_text("important")

    with pytest.raises(PromotionRefused, match=re.escape(str(bundle.path))):
        ep.promote(runner, bundle.path, on_progress=put)
    assert mine.read_text() == "important"
    assert [path.name for path in bundle.path.parent.iterdir()] == [bundle.path.name]


def test_a_pipeline_is_promoted_too_and_other_things_are_refused_by_name(runner, photograph, tmp_path):
    pipe = ep.Pipeline("edges", runner.cg, runner.hyperparameters)
    pipe.run(image=photograph)
    assert ep.promote(pipe, tmp_path / "b").settings.inputs == ("image",)
    with pytest.raises(PromotionRefused, match="class CompGraph can't be promoted. Make a runner and run it"):
        ep.promote(runner.cg, tmp_path / "c")
    with pytest.raises(PromotionRefused, match="f_in must be a function, not 'str'"):
        ep.promote(runner, tmp_path / "c", f_in="dict")


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (1, 1.0, "expected type int, got float"),
        (np.zeros(3), np.zeros(4), "expected float64"),
        (np.zeros(3), np.zeros(3, np.float32), "got float32"),
        (np.array([1.0, 2.0]), np.array([1.0, 3.0]), r"1 of 2 values differ, first at \[1\]: expected 2.0, got 3.0"),
        (np.array([0.0]), np.array([-0.0]), "1 of 1 values differ"),
        ([1, (2, 3)], [1, (2, 4)], r"\[1\] \[1\] expected 3, got 4"),
        ({"a": 1}, {"b": 1}, "expected the keys"),
        ([1], [1, 2], "expected 1 items, got 2"),
        (0.0, -0.0, "expected 0.0, got -0.0"),
        ("0x12", "0x13", "expected '0x12', got '0x13'"),
        ("<f at 0x12>", "<f at 0x13>", "expected '<f at 0x12>'"),
        (b"0x12", b"0x13", "expected b'0x12'"),
        ({"id": "0x1"}, {"id": "0x2"}, "'0x2'"),
        (types.SimpleNamespace(id="0x1"), types.SimpleNamespace(id="0x2"), "0x2"),
        ({1: "x"}, {True: "x"}, r"expected the keys \[1\], got \[True\]"),
        ({"0x1": 1}, {"0x2": 1}, "expected the keys"),
    ],
)
def test_a_difference_is_described_by_its_first_place(left, right, words):
    assert re.search(words, first_difference(left, right))


@pytest.mark.parametrize(
    "value", [np.nan, {np.nan: 1}, np.array([np.nan, 1]), None, "a", (1, [2.0]), {"k": np.eye(2)}, np.zeros((0, 3))]
)
def test_a_value_agrees_with_itself(value):
    assert first_difference(value, value) is None


@pytest.mark.parametrize(
    "make", [object, cv2.ORB_create, lambda: {"a": object()}, lambda: lambda: 1, lambda: [].append]
)
def test_where_an_object_is_in_memory_is_no_difference(make):
    assert first_difference(make(), make()) is None


def cells(path, *sources):
    import nbformat  # takes seconds

    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources]), path)
    return path


NOTEBOOK = (
    "import cv2\nimport numpy as np\nimport epypes as ep",
    "GAIN = 2\n\n# Brightens.\ndef brighten(im):\n    return im * np.uint8(GAIN)",
    "cg = ep.CompGraph({'brighten': brighten, 'canny': cv2.Canny},"
    " {'brighten': ('image', 'bright'), 'canny': (('bright', 'lo', 'hi'), 'edges')})",
    "runner = ep.CompGraphRunner(cg, {'lo': 10, 'hi': 20})\n"
    "_ = runner.run(image=np.arange(64 * 64, dtype=np.uint8).reshape(64, 64))",
)


@pytest.mark.notebook
def test_a_notebook_is_executed_fresh_and_promoted_to_the_same_bytes_each_time(tmp_path):
    path, done = cells(tmp_path / "n.ipynb", *NOTEBOOK), []
    before = path.read_bytes()
    promote_notebook(path, "runner", tmp_path / "one" / "b", ["edges"], lambda *counts: done.append(counts))
    promote_notebook(path, "runner", tmp_path / "two" / "b", ["edges"])
    assert done[:4] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert path.read_bytes() == before
    assert contents(tmp_path / "one" / "b") == contents(tmp_path / "two" / "b")
    assert "# Brightens.\ndef brighten(im):" in (tmp_path / "one" / "b" / "pipeline.py").read_text()
    assert verify(tmp_path / "one" / "b").identical


@pytest.mark.notebook
def test_a_notebook_says_by_variables_which_further_samples_are_recorded(tmp_path):
    more = "import numpy as np\nlarger = np.ones((4, 4, 3), np.uint8)\nothers = [{'image': larger * 2}, larger * 3]"
    path = cells(tmp_path / "n.ipynb", *NOTEBOOK, more)
    promote_notebook(path, "runner", tmp_path / "b", ["edges"], samples=["larger", "others"])
    assert [sample.stem for sample in read_bundle(tmp_path / "b").samples] == ["000", "001", "002", "003"]
    with pytest.raises(PromotionRefused, match=r"No variable 'larg' .*mean 'larger'"):
        promote_notebook(path, "runner", tmp_path / "c", ["edges"], samples=["larg"])


def test_the_signature_of_promote_names_what_it_tells_nobody():
    assert "lambda" not in repr(inspect.signature(ep.promote))


@pytest.mark.notebook
@pytest.mark.parametrize(
    ("last", "error", "words"),
    [
        ("raise ValueError('wrong')", BundleError, "code cell 5 of 5 raised ValueError: wrong"),
        ("import os; os.kill(os.getpid(), 9)", BundleError, "the kernel died in code cell 5 of 5"),
        ("del runner; runer = 3", PromotionRefused, "No variable 'runner'"),
        ("seen = []\ndef b(im):\n    seen.append(im)\n    return im\ncg = ep.CompGraph({'b': b}, {'b': ('image', 'edges')})\n"
         "runner = ep.CompGraphRunner(cg)\n_ = runner.run(image=1)", PromotionRefused, r"writes into 'seen'.*\(cell \[5\], line 3\)"),
    ],
    ids=["raises", "dies", "no runner", "state"],
)  # fmt: skip
def test_a_notebook_that_cannot_be_promoted_names_the_cell(tmp_path, last, error, words):
    path = cells(tmp_path / "n.ipynb", *NOTEBOOK, last)
    with pytest.raises(error, match=words):
        promote_notebook(path, "runner", tmp_path / "b", ["edges"])
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("content", [None, "no json", "{}", "[]"])
def test_a_file_that_is_no_notebook_is_named(tmp_path, content):
    path = tmp_path / "n.ipynb"
    if content is not None:
        path.write_text(content)
    with pytest.raises(BundleError, match=r"n\.ipynb"):
        promote_notebook(path, "runner", tmp_path / "b")


ROOMS = [Path(ep.__file__).parent / room for room in ("wire", "bundle", "service", "transport")]
PICKLERS = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}


@pytest.mark.parametrize("path", [path for room in ROOMS for path in room.glob("*.py")], ids=lambda path: path.name)
def test_no_pickle_is_imported_on_the_way_of_a_value(path):
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module or "")
    assert not {name.partition(".")[0] for name in imported} & PICKLERS


def test_names_are_data_even_in_the_docstring(tmp_path):
    evil = f'x"""; open({str(tmp_path / "pwned")!r}, "w"); """\\'
    runner = ep.CompGraphRunner(ep.CompGraph({"keep": repr}, {"keep": (evil, "y\n\ud800")}))
    runner.run(**{evil: 1})
    with contextlib.suppress(PromotionRefused):
        ep.promote(runner, tmp_path / 'b"""')
    assert not (tmp_path / "pwned").exists()


def test_a_link_to_the_current_version_goes_on_naming_it(runner, tmp_path):
    ep.promote(runner, tmp_path / "v1")
    (tmp_path / "current").symlink_to(tmp_path / "v1")
    runner.rerun(lo=10)
    ep.promote(runner, tmp_path / "current")
    assert (tmp_path / "current").is_symlink()
    assert ep.load(tmp_path / "v1").hyperparameters["lo"] == 10


def test_a_place_inside_a_bundle_or_under_a_file_is_refused(bundle, runner, tmp_path):
    with pytest.raises(PromotionRefused, match="is inside the bundle"):
        ep.promote(runner, bundle.path / "inner")
    assert verify(bundle.path).identical
    (tmp_path / "file").touch()
    with pytest.raises(PromotionRefused, match="can't be written"):
        ep.promote(runner, tmp_path / "file" / "b")


def test_links_in_a_bundle_are_refused(bundle, tmp_path):
    (bundle.path / "etc").symlink_to("/etc")
    with pytest.raises(BundleError, match="holds etc, which is not a plain file"):
        ep.load(bundle.path)


def test_the_seal_covers_a_manifest_within(bundle):
    (bundle.path / "samples" / "MANIFEST.sha256").touch()
    with pytest.raises(BundleError, match="was added"):
        ep.load(bundle.path)


@pytest.mark.parametrize(("port", "value"), [("outputs", '["smoothed"]'), ("inputs", '["image", "lo"]')])
def test_ports_that_are_not_those_of_the_sample_are_found(bundle, port, value):
    settings = bundle.path / "pipeline.toml"
    settings.write_text(re.sub(rf"{port} = .*", f"{port} = {value}", settings.read_text()))
    write_manifest(bundle.path)
    with pytest.raises(BundleError, match="has the tokens image -> edges, which are not those of pipeline.toml"):
        verify(bundle.path)


def test_the_old_bundle_is_there_until_the_new_one_is(runner, tmp_path, monkeypatch):
    target = tmp_path / "edges"
    ep.promote(runner, target)
    seen = []
    exchange = promote_module.swap_folders

    def looking(left, right):
        seen.append((left / "MANIFEST.sha256").is_file() and (right / "MANIFEST.sha256").is_file())
        exchange(left, right)
        seen.append((left / "MANIFEST.sha256").is_file() and (right / "MANIFEST.sha256").is_file())

    monkeypatch.setattr(promote_module, "swap_folders", looking)
    runner.rerun(lo=10)
    ep.promote(runner, target)
    assert seen == [True, True]
    assert ep.load(target).hyperparameters["lo"] == 10


@pytest.mark.slow
def test_a_bundle_that_is_replaced_while_it_is_read_is_never_mixed_with_the_next(tmp_path):
    digests = {}
    for function, k in ((np.add, 1), (np.multiply, 2)):
        runner = ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": (("x", "k"), "y")}), {"k": k})
        runner.run(x=np.ones(2))
        digests[ep.promote(runner, tmp_path / str(k) / "b").digest] = (function, k)
    done, here, there = threading.Event(), tmp_path / "1" / "b", tmp_path / "2" / "b"

    def exchanging():
        while not done.is_set():
            promote_module.swap_folders(here, there)
            done.wait(0.001)

    thread = threading.Thread(target=exchanging)
    thread.start()
    try:
        for _ in range(500):
            bundle = read_bundle(here)
            assert (bundle.cg.functions["f"], bundle.settings.hyperparameters["k"]) == digests[bundle.digest]
    finally:
        done.set()
        thread.join()


@pytest.mark.usefixtures("fresh_interpreter")
def test_marks_are_promoted_and_the_bundle_says_which_ports_are_rgb(tmp_path):
    runner = red_runner()
    runner.run(image=red_image())
    bundle = ep.promote(runner, tmp_path / "red", outputs=["red", "unsaid"])
    assert verify(bundle.path).identical
    source, settings = bundle.path / "pipeline.py", tomllib.loads((bundle.path / "pipeline.toml").read_text())
    assert 'RGB = ep.Image(dtype=("uint8",), shape=(None, None, 3), order="rgb")' in source.read_text()
    assert settings["ports"] == {"inputs": ["image"], "outputs": ["red", "unsaid"]}
    assert settings["colours"] == {
        "image": {"order": "rgb", "function": "red_part"},
        "red": {"order": "rgb", "function": "red_part"},
        "unsaid": {"order": "bgr"},
    }
    assert bundle.settings.rgb == ("image", "red")
    assert [colour_order(ep.load(bundle.path).cg, token) for token in ("image", "red", "unsaid")] == [
        "rgb",
        "rgb",
        "bgr",
    ]


def test_an_order_that_no_function_says_is_assumed_in_one_line_and_written_so(runner, bundle, tmp_path, caplog):
    text = (bundle.path / "pipeline.toml").read_text()
    assert "[colours.image]" in text
    assert '\norder = "bgr"  # assumed\n' in text
    assert "[colours.edges]" not in text, "it has one channel"
    assert bundle.settings.rgb == ()
    line = (
        "No function says the order of the colours of 'image': bgr is assumed. If it is rgb, annotate a parameter: "
        'Annotated[np.ndarray, ep.Image(order="rgb")].'
    )
    caplog.clear()
    ep.promote(runner, tmp_path / "logged", outputs=["edges"])
    assert caplog.messages == [line]
    caplog.clear()
    steps = []
    ep.promote(runner, tmp_path / "shown", outputs=["edges"], on_progress=steps.append)
    assert line in steps
    assert caplog.messages == []


@pytest.mark.parametrize("marked", [True, False])
@pytest.mark.parametrize("wanted", [True, False])
def test_an_event_in_another_order_than_the_tokens_is_converted_once(marked, wanted):
    image, plane, points = red_image(), np.zeros((9, 9), np.uint8), np.zeros((4, 5, 3))
    event = Envelope("", {"image": image, "more": [image, plane, {"points": points}]}, rgb=["image", "more"] * marked)
    given = payload_of(("image", "more"), ["image", "more"] * wanted)(event)
    expected = image if marked == wanted else image[..., ::-1]
    assert np.array_equal(given["image"], expected)
    assert np.array_equal(given["more"][0], expected)
    assert given["more"][1] is plane
    assert given["more"][2]["points"] is points, "only what travels as an image has an order"
    assert (given["image"] is image) == (marked == wanted), "nothing is copied that need not be"


INNER = ep.Pipeline("inner", ep.CompGraph({"smooth": cv2.medianBlur}, {"smooth": (("im", "side"), "out")}), {"side": 3})


def test_switches_and_pipelines_come_back_as_they_were(photograph, tmp_path):
    smooth = ep.CompGraph(
        {"inner": INNER, "node": ep.Node("node", INNER)}, {"inner": ("image", "a"), "node": ("a", "b")}
    )
    cg = smooth | ep.switch("choose", {"once": "a", "twice": "b"}, by="method", output="smoothed")
    runner = ep.CompGraphRunner(cg, {"method": "twice"})
    runner.run(image=photograph)
    loaded = ep.load(ep.promote(runner, tmp_path / "b").path)
    assert (loaded.cg.func_io, loaded.cg.switches) == (cg.func_io, ("choose",))
    assert list(loaded.cg.functions) == list(cg.functions)
    assert loaded.cg.functions["inner"] is loaded.cg.functions["node"], "one pipeline, one object"
    assert np.array_equal(loaded.run(image=photograph)["smoothed"], runner["smoothed"])
    assert np.array_equal(loaded.rerun(method="once")["smoothed"], INNER(photograph))


def test_a_placeholder_is_refused_with_the_call_that_fills_it(tmp_path):
    cg = ep.CompGraph({"f": abs, "g": ep.Placeholder()}, {"f": ("x", "y"), "g": ("y", "z")})
    with pytest.raises(PromotionRefused) as error:
        ep.promote(ep.CompGraphRunner(cg), tmp_path / "b")
    assert error.value.reasons[1:] == (
        "Function 'g' is a placeholder. Give it: ep.extend(cg, {'g': ...}), and run that graph.",
    )


def test_string_literals_of_indented_functions_are_promoted_as_they_are(tmp_path):
    source = 'if True:\n    def f(x):\n        s = """\n        a"""\n        return x + len(s)\n'
    runner = ep.CompGraphRunner(ep.CompGraph({"f": notebook(source)["f"]}, {"f": ("x", "y")}))
    assert runner.run(x=1)["y"] == 11
    assert ep.load(ep.promote(runner, tmp_path / "b").path).run(x=1)["y"] == 11


SEARCH = """
import epypes as ep
from epypes import Nothing

def find(image, least):
    if image.max() < least:
        return {nothing}
    return int(image.argmax())

def mark(image, place):
    marked = image.copy()
    marked.flat[place] = 255
    return marked
"""


@pytest.mark.parametrize("nothing", ["ep.Nothing", "Nothing"])
def test_a_function_that_finds_nothing_is_promoted_with_samples_of_both(tmp_path, nothing):
    names = notebook(SEARCH.format(nothing=nothing))
    cg = ep.CompGraph(
        {"find": names["find"], "mark": names["mark"]},
        {"find": (("image", "least"), "place"), "mark": (("image", "place"), "marked")},
    )
    images = [np.full((4, 6), level, np.uint8) for level in (10, 200)]
    runner = ep.CompGraphRunner(cg, {"least": 100})
    for image in images:
        runner.run(image=image)
    found = ep.promote(
        runner, tmp_path / "b", outputs=["place", "marked"], samples=[{"image": image} for image in images]
    )
    assert f"return {nothing}" in (found.path / "pipeline.py").read_text()
    verify(found.path)
    loaded = ep.load(found.path)
    assert [loaded.run(image=image)["place"] for image in images] == [ep.Nothing, 0]
    assert loaded.run(image=images[0])["marked"] is ep.Nothing
    assert first_difference(ep.Nothing, None) == "expected type NothingType, got NoneType"
    assert first_difference(ep.Nothing, ep.Nothing) is None


def test_a_replay_that_finds_something_where_nothing_was_recorded_differs(tmp_path):
    names = notebook(SEARCH.format(nothing="Nothing"))
    runner = ep.CompGraphRunner(
        ep.CompGraph({"find": names["find"]}, {"find": (("image", "least"), "place")}), {"least": 100}
    )
    runner.run(image=np.full((4, 6), 10, np.uint8))
    found = ep.promote(runner, tmp_path / "b", outputs=["place"])
    settings = found.path / "pipeline.toml"
    settings.write_text(settings.read_text().replace("value = 100", "value = 5"))
    write_manifest(found.path)
    with pytest.raises(ReplayDiffers, match="expected type NothingType, got int"):
        verify(found.path)
