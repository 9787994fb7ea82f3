"""Arrays that are too large for text are files of the bundle."""

from __future__ import annotations

import difflib
import io
import pickle
import shutil
import sys

import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify, write_back
from epypes.bundle.manifest import write_manifest
from epypes.errors import BundleError, PromotionRefused
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

IMAGE = np.random.default_rng(7).integers(0, 255, (60, 70), dtype=np.uint8)
MATCH = """
import cv2
import numpy as np

TEMPLATE = IMAGE[10:50, 20:60].copy()  # a golden sample


def match(image):
    return cv2.matchTemplate(image, TEMPLATE, cv2.TM_CCOEFF_NORMED)
"""


def runner_of(source, name="match", image=IMAGE):
    names = cell(source, {"__name__": "__main__", "IMAGE": image})
    runner = ep.CompGraphRunner(ep.CompGraph({name: names[name]}, {name: ("image", "out")}))
    runner.run(image=image)
    return runner, names


def test_a_template_is_a_file_of_the_bundle_that_reads_as_the_notebook_wrote_it(tmp_path):
    runner, names = runner_of(MATCH)
    bundle = ep.promote(runner, tmp_path / "bundle")
    text = (bundle.path / "pipeline.py").read_text()
    assert 'TEMPLATE = stored_array("TEMPLATE")  # a golden sample\n' in text
    assert text.count("def stored_array(name):") == 1
    kept = np.load(bundle.path / "arrays" / "TEMPLATE.npy", allow_pickle=False)
    assert (kept.dtype, kept.tobytes()) == (names["TEMPLATE"].dtype, names["TEMPLATE"].tobytes())
    # It reads its own folder, wherever that is.
    moved = shutil.move(bundle.path, tmp_path / "elsewhere")
    assert verify(moved).identical
    template = ep.load(moved).cg.functions["match"].__globals__["TEMPLATE"]
    with pytest.raises(ValueError, match="read-only"):
        template[0, 0] = 1


def test_an_array_that_was_changed_is_named(tmp_path):
    bundle = ep.promote(runner_of(MATCH)[0], tmp_path / "bundle")
    np.save(bundle.path / "arrays" / "TEMPLATE.npy", IMAGE)
    with pytest.raises(BundleError, match=r"arrays/TEMPLATE\.npy was changed"):
        ep.load(bundle.path)


BROKEN = {
    "cut off": lambda content: content[:400],
    "empty": lambda content: b"",
    "no array": lambda content: b"broken" * 100,
    "a header that is no header": lambda content: content[:20] + b"(((" + content[23:],
    "a pickle": lambda content: pickle.dumps([1, 2]),
    "an archive": lambda content: archive(),
}


def archive():
    content = io.BytesIO()
    np.savez(content, a=IMAGE)
    return content.getvalue()


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A bundle with an array of its module, and one that is a hyperparameter."""
    source = MATCH.replace("def match(image):", "def match(image, weights):").replace(
        "_NORMED)", "_NORMED) + weights[0, 0]"
    )
    use = cell(source, {"__name__": "__main__", "IMAGE": IMAGE})["match"]
    runner = ep.CompGraphRunner(
        ep.CompGraph({"match": use}, {"match": (("image", "weights"), "out")}), {"weights": np.eye(30)}
    )
    runner.run(image=IMAGE)
    return ep.promote(runner, tmp_path_factory.mktemp("stored") / "bundle").path


@pytest.mark.parametrize("file", ["arrays/TEMPLATE.npy", "hyperparameters/weights.npy"])
@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_array_is_named_when_the_manifest_covers_it_as_it_is(file, how, stored, tmp_path):
    folder = shutil.copytree(stored, tmp_path / "bundle")
    path = folder / file
    path.write_bytes(BROKEN[how](path.read_bytes()))
    write_manifest(folder)
    for use in (ep.load, verify, lambda folder: write_back(folder, {"weights": np.eye(3)})):
        with pytest.raises(BundleError, match=f"{file} is no array that NumPy can read: .*Promote the graph again"):
            use(folder)


def test_another_template_changes_no_line_of_the_text(tmp_path):
    first = ep.promote(runner_of(MATCH)[0], tmp_path / "one" / "bundle").path
    other = ep.promote(runner_of(MATCH.replace("10:50", "11:51"))[0], tmp_path / "two" / "bundle").path
    for name in ("pipeline.py", "pipeline.toml"):
        texts = [(folder / name).read_text().splitlines() for folder in (first, other)]
        assert [*difflib.unified_diff(*texts)] == []
    assert (first / "arrays" / "TEMPLATE.npy").read_bytes() != (other / "arrays" / "TEMPLATE.npy").read_bytes()


def test_a_dict_of_templates_is_one_file_for_each(tmp_path):
    source = """
import numpy as np

TEMPLATES = {"coin": IMAGE[:40, :40], "large ring": [IMAGE[5:45, 3:43].T, np.array([1.5, 2.5])]}


def match(image):
    ring, factor = TEMPLATES["large ring"]
    return image[:40, :40] * factor[1] + ring - TEMPLATES["coin"]
"""
    bundle = ep.promote(runner_of(source)[0], tmp_path / "bundle")
    assert sorted(path.stem for path in (bundle.path / "arrays").iterdir()) == [
        "TEMPLATES",
        "TEMPLATES_",
    ]
    assert 'TEMPLATES = {\n    "coin": stored_array("TEMPLATES"),' in (bundle.path / "pipeline.py").read_text()


@pytest.mark.parametrize("dtype", ["bool", ">i2", "float32", "float64", "complex64"])
def test_every_kind_of_number_comes_back_to_the_last_bit(dtype, tmp_path):
    values = np.random.default_rng(1).normal(size=(30, 20)).astype(dtype)
    if values.dtype.kind == "f":
        values[:2, 0] = -0.0, np.nan
    names = cell("def use(image):\n    return VALUES.ravel()\n", {"__name__": "__main__", "VALUES": values})
    runner = ep.CompGraphRunner(ep.CompGraph({"use": names["use"]}, {"use": ("image", "out")}))
    runner.run(image=IMAGE)
    bundle = ep.promote(runner, tmp_path / "bundle")
    kept = ep.load(bundle.path).cg.functions["use"].__globals__["VALUES"]
    assert (kept.dtype, kept.shape, kept.tobytes()) == (values.dtype, values.shape, values.tobytes())


def test_two_functions_with_one_array_share_its_file(tmp_path):
    source = "T = IMAGE[:40, :40]\nS = T\ndef match(image):\n    return image[:40, :40] - T + S\n"
    bundle = ep.promote(runner_of(source)[0], tmp_path / "bundle")
    assert [path.name for path in (bundle.path / "arrays").iterdir()] == ["T.npy"]


def test_an_array_may_be_of_any_size(tmp_path):
    source = "import numpy as np\nBIG = np.ones((2100, 1000))\ndef match(image):\n    return image + BIG[0, 0]\n"
    bundle = ep.promote(runner_of(source)[0], tmp_path / "bundle")
    assert (bundle.path / "arrays" / "BIG.npy").stat().st_size > 16_000_000


def test_a_calibration_is_a_hyperparameter_in_a_file_of_the_bundle(tmp_path):
    maps = np.random.default_rng(3).normal(size=(60, 70)).astype(np.float32)
    use = cell("def match(image, maps):\n    return image * maps\n")["match"]
    runner = ep.CompGraphRunner(ep.CompGraph({"match": use}, {"match": (("image", "maps"), "out")}), {"maps": maps})
    runner.run(image=IMAGE)
    bundle = ep.promote(runner, tmp_path / "bundle")
    kept = ep.load(bundle.path).hyperparameters["maps"]
    assert (kept.dtype, kept.shape, kept.tobytes()) == (maps.dtype, maps.shape, maps.tobytes())
    assert [path.name for path in (bundle.path / "hyperparameters").iterdir()] == ["maps.npy"]


def test_a_large_array_in_a_hyperparameter_is_refused_and_its_way_out_works(tmp_path):
    value = {"coin": IMAGE[:40, :40]}
    use = cell("def use(image, template, method):\n    return image + template['coin'].max()\n")["use"]
    cg = ep.CompGraph({"match": use}, {"match": (("image", "template", "method"), "out")})
    runner = ep.CompGraphRunner(cg, {"template": value, "method": 5})
    runner.run(image=IMAGE)
    with pytest.raises(PromotionRefused) as caught:
        ep.promote(runner, tmp_path / "bundle")
    (reason,) = caught.value.reasons
    assert "an array of 1600 numbers; 400 are the most that pipeline.toml holds" in reason
    assert "a variable of the notebook" in reason
    names = {"__name__": "__main__", "TEMPLATE": value, "inner": cg.functions["match"]}
    wrapped = cell("def match(image, method):\n    return inner(image, TEMPLATE, method)\n", names)["match"]
    runner = ep.CompGraphRunner(
        ep.CompGraph({"match": wrapped}, {"match": (("image", "method"), "out")}), {"method": 5}
    )
    runner.run(image=IMAGE)
    assert (ep.promote(runner, tmp_path / "bundle").path / "arrays").is_dir()


def test_a_bundle_that_is_replaced_while_it_is_loaded_is_loaded_whole(tmp_path, monkeypatch):
    source = "import colorsys\nimport numpy as np\ndef use(x):\n    return K * 1000 + int(T[0, 0]) + 0 * int(colorsys.rgb_to_yiq(1, 1, 1)[0])"
    for number in (1, 2):
        names = cell(source, {"__name__": "__main__", "K": number, "T": np.full((60, 70), number)})
        runner = ep.CompGraphRunner(ep.CompGraph({"use": names["use"]}, {"use": ("x", "out")}))
        runner.run(x=0)
        ep.promote(runner, tmp_path / str(number))

    class Replacing:
        """Replaces the bundle when its module imports, once."""

        def find_spec(self, name, path=None, target=None):
            if name == "colorsys" and (tmp_path / "2").exists():
                (tmp_path / "1").rename(tmp_path / "0")
                (tmp_path / "2").rename(tmp_path / "1")

    monkeypatch.delitem(sys.modules, "colorsys")
    monkeypatch.setattr(sys, "meta_path", [Replacing(), *sys.meta_path])
    assert ep.load(tmp_path / "1").run(x=0)["out"] == 2002
