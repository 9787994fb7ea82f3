"""The example programs run as they are, and print what their texts announce."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import skimage

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# What the last lines of each program look like.
PRINTED = {
    "call_a_service": r"READY\nlow = 70: (\d+) .*\nlow = 20: (?!\1)\d+ .*\nlow = 150: (?!\1)\d+ .*\nSTOPPED received 3, answered 3, ",
    "camera_over_zeromq": r"frame 0: \d+ edge pixels of 160000\n(frame \d+: .*\n){18}frame 19: \d+ edge pixels of 160000$",
    "custom_node": r"astronaut: \(\d+, \d+, 3\)\ncoffee: no face\nthe detector ran 2 times",
    "folder_of_images": r"low = 20\n.*\n *broken.png +NaN ImageFileError.*\n(.*\n)+low = 70\n(.*\n)+ *coins.png +0\.\d+ ",
    "state_between_frames": r"frame 0: the first one\n(frame \d: \[12.0, 5.0\]\n){4}again: \[12.0, 5.0\]\nafter a reset: Nothing$",
}


@pytest.fixture
def folder(tmp_path):
    """A folder of photographs, one of them damaged."""
    for name in ("camera", "coins"):
        shutil.copy(Path(skimage.data_dir) / f"{name}.png", tmp_path)
    (tmp_path / "broken.png").write_bytes(b"no image")
    return tmp_path


def test_every_example_is_run_and_short():
    lengths = {path.stem: len(path.read_text().splitlines()) for path in EXAMPLES.glob("*.py")}
    assert lengths.keys() == PRINTED.keys()
    assert {name: length for name, length in lengths.items() if not 30 <= length <= 60} == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PRINTED))
def test_an_example_does_what_it_announces(name, folder):
    arguments = [str(folder)] if name == "folder_of_images" else []
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments],
        cwd=folder, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.match(PRINTED[name], done.stdout.rstrip()), done.stdout
