"""``epypes demo`` does the main job, and fails if a step fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import epypes.acquisition as epypes_acquisition
from epypes.acquisition import read_image
from epypes.bundle import verify
from tests.service.processes import run_cli

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "notebooks" / "01_edge_detection.ipynb"

pytestmark = pytest.mark.notebook


@pytest.fixture
def tutorial(tmp_path):
    """A copy, since the notebook writes beside itself."""
    copy = tmp_path / TUTORIAL.name
    copy.write_bytes(TUTORIAL.read_bytes())
    return copy


def test_the_demo_does_the_main_job_and_says_so(tutorial, tmp_path, straight_edges):
    out = tmp_path / "out"
    done = run_cli("demo", tutorial, "--to", out)
    assert done.returncode == 0, done.stderr
    for words in ("1/5", "5/5", "identical: 240000 values", "function edges", "graph overhead", "round trip"):
        assert words in done.stdout
    assert "promoted" in done.stderr, "a progress display"
    assert np.array_equal(read_image(out / "edges.png"), straight_edges)
    assert "<image" in (out / "graph.svg").read_text()
    assert verify(out / "bundle").identical


def test_an_answer_that_differs_ends_the_demo_with_an_error(tutorial, tmp_path, monkeypatch, epypes):
    def spoiled(file, *rest):
        edges = read_image(file, *rest).copy()
        edges[7, 9] ^= 255
        return edges

    monkeypatch.setattr(epypes_acquisition, "read_image", spoiled)
    done = epypes("demo", tutorial, "--to", tmp_path / "out")
    assert done.returncode == 1
    assert "differs from the notebook's: 1 of 240000 values differ, first at [7, 9]" in done.stderr


def test_a_notebook_that_cannot_be_promoted_ends_the_demo_with_exit_status_1(tmp_path):
    import nbformat  # takes seconds

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("runner = 3")])
    nbformat.write(notebook, tmp_path / "n.ipynb")
    done = run_cli("demo", tmp_path / "n.ipynb", "--to", tmp_path / "out")
    assert done.returncode == 1
    assert "An object of class int can't be promoted" in done.stderr
    # What comes before may be the notebook's kernel, which sometimes ends with one of its own.
    assert "Traceback" not in done.stderr.partition("epypes: ")[2]
