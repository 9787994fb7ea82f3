"""A bundle is alone: what its functions reach for outside of it is found out and refused."""

from __future__ import annotations

import re
import shutil

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.errors import PromotionRefused
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow  # each proves a bundle in a process of its own

IMAGE = np.arange(3600, dtype=np.uint8).reshape(60, 60)


def promoted(source, to, hparams=None, tokens=("image",), **more):
    """Run a cell that defines ``use``, and promote the graph of it."""
    cg = ep.CompGraph({"use": cell(source)["use"]}, {"use": (tokens, "out")})
    runner = ep.CompGraphRunner(cg, hparams or {})
    runner.run(image=IMAGE)
    return ep.promote(runner, to, **more)


def reasons_against(source, to, **others):
    with pytest.raises(PromotionRefused) as caught:
        promoted(source, to, **others)
    assert not to.exists()
    return "\n".join(caught.value.reasons)


@pytest.fixture
def template(tmp_path):
    path = tmp_path / "shop floor" / "template.png"
    path.parent.mkdir()
    cv2.imwrite(str(path), IMAGE[:9, :9])
    return path


READERS = {
    "a C library": "import cv2\ndef use(image):\n    return image + cv2.imread({path!r}, 0).max()\n",
    "Python": "def use(image):\n    with open({path!r}, 'rb') as file:\n        return image + len(file.read())\n",
    "a name put together": "import os, numpy as np\nF = {folder!r}\ndef use(image):\n"
    "    return image + len(np.fromfile(os.path.join(F, 'template' + '.png'), np.uint8))\n",
    "a folder's names": "import os\ndef use(image):\n    return image + len(os.listdir({folder!r}))\n",
}


@pytest.mark.parametrize("reader", READERS)
def test_a_function_that_reads_a_file_outside_of_the_bundle_is_refused_by_name_line_and_file(
    reader, template, tmp_path
):
    source = READERS[reader].format(path=str(template), folder=str(template.parent))
    reasons = reasons_against(source, tmp_path / "bundle")
    assert str(template.parent) in reasons
    assert re.search(r"(use\(\)|The module) \(pipeline\.py, line \d+\) (names|opens) /", reasons)
    assert "importlib.resources" in reasons


def test_a_hyperparameter_that_names_a_file_is_refused(template, tmp_path):
    source = "import cv2\ndef use(image, path):\n    return image + cv2.imread(path, 0).max()\n"
    reasons = reasons_against(source, tmp_path / "bundle", hparams={"path": str(template)}, tokens=("image", "path"))
    assert f"Hyperparameter 'path' (pipeline.toml) names {template}" in reasons


@pytest.mark.parametrize("call", ["cv2.imread('template.png', 0).max()", "len(Path('template.png').read_bytes())"])
@pytest.mark.usefixtures("fresh_interpreter")
def test_a_relative_path_is_refused_since_the_current_folder_is_another_one_there(
    call, template, tmp_path, monkeypatch
):
    monkeypatch.chdir(template.parent)
    reasons = reasons_against(
        f"import cv2\nfrom pathlib import Path\ndef use(image):\n    return image + {call}\n", tmp_path / "bundle"
    )
    found = r"use\(\) \(pipeline.py, line \d+\) names 'template.png', a file in the current folder here"
    assert re.search(rf"{found}\. The current folder is another one there", reasons)


def test_a_relative_path_that_no_sample_opens_is_noted(template, tmp_path, monkeypatch):
    monkeypatch.chdir(template.parent)
    notes = []
    source = "def use(image):\n    return len(open('template.png').read()) if image.size > 9000 else image.size\n"
    promoted(source, tmp_path / "bundle", on_progress=notes.append)
    assert re.search(r"use\(\) \(pipeline.py, line \d+\) names 'template.png', a file in the current folder", notes[-1])


KEEPERS = {
    "in the folder of temporary files": "Path(tempfile.gettempdir()) / f'seen-{os.getpid()}.mbox'",
    "in the current folder": "Path('seen.mbox')",
}


@pytest.mark.parametrize("where", KEEPERS)
def test_a_file_by_which_code_of_a_library_keeps_something_from_call_to_call_is_refused(where, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = (
        "import mailbox, os, tempfile\nfrom pathlib import Path\ndef use(image):\n"
        f"    box = mailbox.mbox({KEEPERS[where]})\n    box.add('seen')\n    box.close()\n    return image + 1\n"
    )
    reasons = reasons_against(source, tmp_path / "to" / "bundle")
    assert re.search(r"use\(\) \(pipeline\.py, line \d+\) reads /\S+, which an earlier call has written", reasons)


FINE = {
    "its own temporary file": "import tempfile, numpy as np\ndef use(image):\n    with tempfile.TemporaryFile() as file:"
    "\n        np.save(file, image)\n        file.seek(0)\n        return np.load(file)\n",
    "a folder that it makes": "import os, tempfile\ndef use(image):\n    with tempfile.TemporaryDirectory() as folder:"
    "\n        return image + len(os.listdir(folder))\n",
    "a file that it makes": "import cv2\ndef use(image):\n    cv2.imwrite({new!r}, image)\n    return image + 1\n",
    "data of a package": "from skimage import data\ndef use(image):\n    return image + data.coins()[0, 0]\n",
    "a slash": "def use(image):\n    return image + len('a/b'.split('/')) + len('/tmp')\n",
    "a docstring": 'def use(image):\n    """{path}"""\n    return image + 1\n',
}


@pytest.mark.parametrize("what", FINE)
def test_what_is_there_wherever_the_bundle_is_or_only_written_is_fine(what, template, tmp_path):
    source = FINE[what].format(path=str(template), new=str(tmp_path / "seen.png"))
    bundle = promoted(source, tmp_path / "bundle")
    shutil.rmtree(template.parent)
    assert verify(bundle.path).identical
