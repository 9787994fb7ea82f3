"""The README's commands and code do what it says."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from epypes.acquisition import read_image, write_image
from tests.ipython_cells import run_cells
from tests.service.processes import run_cli, running

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[str]:
    return [line for block in blocks("sh") for line in block.splitlines() if line.startswith("epypes ")]


# What a caption names, by the word that it begins with there.
KINDS = {"graph": "graph", "sliders": "panel", "contact sheet": "contact sheet"}


def named_in(caption: str) -> list[str]:
    """Return the kinds of output that a picture's caption names, in order."""
    found = {caption.find(word): kind for word, kind in KINDS.items() if word in caption}
    return [found[place] for place in sorted(found)]


def kind_of(output: dict[str, object]) -> str:
    html = str(output.get("text/html", ""))
    if "application/vnd.jupyter.widget-view+json" in output:
        return "panel"
    if "epypes-kept" in html:
        return "the panel's last picture, for a saved notebook"
    return "graph" if "image/svg+xml" in output else "contact sheet" if "epypes-contact" in html else "other"


def captions() -> dict[str, str]:
    """Return the caption of each block's picture, which stands below the block, that of the first one above it."""
    under = dict(re.findall(r"```python\n([^`]*)```\n+<img src=[^>]*alt=\"([^\"]*)\"", README))
    first = re.search(r"alt=\"([^\"]*)\"", README)
    return {blocks("python")[0]: first[1]} | under


@pytest.mark.notebook
def test_each_block_runs_as_a_cell_and_shows_what_the_caption_of_its_picture_names(tmp_path, photograph):
    write_image(tmp_path / "photo.jpg", photograph)
    cells = blocks("python")
    pictured = captions()
    assert len(pictured) == 3
    shown = run_cells(*cells, folder=tmp_path)
    for cell, each in zip(cells, shown, strict=True):
        assert each.succeeded, each.text
        kinds = [kind_of(output) for output in each.outputs]
        assert "other" not in kinds
        if cell in pictured:
            assert [kind for kind in kinds if kind in KINDS.values()] == named_in(pictured[cell])
    see, tune = (
        next(each for cell, each in zip(cells, shown, strict=True) if name in cell) for name in ("show(", "panel")
    )
    assert [kind_of(output) for output in see.outputs] == ["graph"]
    assert kind_of(tune.outputs[0]) == "panel"


def test_it_fits_150_lines_and_defines_its_words_where_they_first_occur():
    assert len(README.splitlines()) <= 150
    for word in ("token", "hyperparameter"):
        first = re.search(rf"\b{word}", README)
        assert README[first.start() - 1] == "*", f"{word} is defined at its first occurrence"


@pytest.mark.notebook
def test_the_epypes_commands_run_in_order(tmp_path, monkeypatch, photograph, straight_edges):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks", ignore=shutil.ignore_patterns("edge_service"))
    Path("demo-output").mkdir()
    write_image("demo-output/image.png", photograph)
    promote, verify, serve, call = (shlex.split(line, comments=True)[1:] for line in commands())
    for command in (promote, verify):
        done = run_cli(*command)
        assert done.returncode == 0, done.stderr
    with running(serve[1], *serve[2:]) as process:
        assert process.ready.startswith("READY"), process.stderr.read()
        done = run_cli(*call)
        assert done.returncode == 0, done.stderr
    assert np.array_equal(read_image("edges.png"), straight_edges)


@pytest.mark.parametrize("target", ["demo", "test", "lab", "bench", "fix"])
def test_the_make_targets_exist(target):
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"make {target}" in README + (ROOT / "CONTRIBUTING.md").read_text()


def test_the_files_it_points_to_exist():
    for link in re.findall(r"\]\(([^)]+)\)|src=\"([^\"]+)\"", README):
        assert (ROOT / (link[0] or link[1])).exists()


def test_the_command_is_installed():
    assert (Path(sys.executable).parent / "epypes").exists()
