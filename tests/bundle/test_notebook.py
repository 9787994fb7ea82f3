"""A notebook is promoted in a kernel of its own; the caller gets its progress, whatever its cells print or display."""

from __future__ import annotations

import nbformat
import pytest

from epypes.bundle import verify
from epypes.bundle.promote import promote_notebook
from epypes.errors import PromotionRefused

CELLS = (
    "import epypes as ep\nfrom IPython.display import display\nprint('progress')\ndisplay({'text/plain': 'x'}, raw=True)",
    "def double(x):\n    return x * 2 if x < 9 else 0\nrunner = ep.CompGraphRunner(ep.CompGraph.from_functions(double))",
    "run = runner.run(x=1)",
)


def written(path, *cells):
    nbformat.write(nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, cells))), path)
    return path


@pytest.mark.notebook
def test_the_caller_gets_the_progress_of_cells_and_of_the_promotion(tmp_path):
    cells, steps = [], []
    promote_notebook(
        written(tmp_path / "n.ipynb", *CELLS),
        "runner",
        tmp_path / "b",
        on_cell=lambda *counts: cells.append(counts),
        on_progress=steps.append,
    )
    assert verify(tmp_path / "b").identical
    assert cells[:3] == [(1, 3), (2, 3), (3, 3)]
    assert "replaying in fresh processes" in steps


@pytest.mark.notebook
def test_the_reasons_against_a_promotion_come_back_one_by_one(tmp_path):
    more = "seen = []\ndef note(double):\n    seen.append(double)\n    return double"
    graph = "runner = ep.CompGraphRunner(ep.extend(runner.cg, {'note': note}, {'note': ('double', 'noted')}))"
    with pytest.raises(PromotionRefused) as caught:
        promote_notebook(written(tmp_path / "n.ipynb", *CELLS, more, graph), "runner", tmp_path / "b")
    assert len(caught.value.reasons) == 2
    assert any("'seen'" in reason for reason in caught.value.reasons)
    assert not (tmp_path / "b").exists()
