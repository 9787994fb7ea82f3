"""What is measured while JupyterLab shows all contenders in one notebook?"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.row import OURS
from tests.benchmarks.timing import Effort
from tests.benchmarks.tuning import cells
from tests.benchmarks.tuning.hand import Slider, begin, echoes_ms
from tests.benchmarks.tuning.latency import Seen
from tests.browser.jupyter import JupyterLab, Notebook, chromium, open_lab

IMAGE = "ipywidgets.Image"
MATPLOTLIB = "interact + matplotlib"
MOVES = 60
SLOW_MOVES = 120
# Each pixel is another value on a slider of 0 to 255.
_STEP_PX = 1
_ROUNDS, _QUICK_ROUNDS = 6, 1
_ECHOES, _PRESSES = 20, 10


@dataclass(frozen=True)
class Measured:
    """What the page saw, round after round.

    Attributes
    ----------
    echoes_ms
        Of an integer through the kernel and back.
    presses, drags
        By contender, one for each round.
    slow, slow_runs
        The drag over a function of half a second, and how often that function was run.
    """

    echoes_ms: Sequence[float]
    presses: Mapping[str, Sequence[Seen]]
    drags: Mapping[str, Sequence[Seen]]
    slow: Seen
    slow_runs: int


def measured(effort: Effort) -> Measured:
    """Start JupyterLab, open the notebook and move its sliders."""
    with tempfile.TemporaryDirectory(prefix="epypes-tuning-") as folder:
        notebooks = Path(folder) / "notebooks"
        notebooks.mkdir()
        cells.write_notebook(notebooks / "tuning.ipynb")
        with JupyterLab(notebooks, Path(folder) / "lab") as lab, chromium() as browser:
            notebook = Notebook(open_lab(browser, lab), "tuning.ipynb")
            notebook.run_all()
            found = _moved(notebook, _QUICK_ROUNDS if effort.quick else _ROUNDS)
            assert not notebook.page_errors, notebook.page_errors
            return found


def _moved(notebook: Notebook, rounds: int) -> Measured:
    begin(notebook)
    sliders = {
        OURS: Slider(notebook, cells.OURS, "canny_lo", "panel"),
        IMAGE: Slider(notebook, cells.IMAGE, "canny_lo", "blob"),
        MATPLOTLIB: Slider(notebook, cells.MATPLOTLIB, "canny_lo", "png"),
    }
    echoes: list[float] = []
    presses, drags = defaultdict(list), defaultdict(list)
    for turn in range(rounds):
        key, step_px = ("ArrowLeft", -_STEP_PX) if turn % 2 else ("ArrowRight", _STEP_PX)
        for name, slider in sliders.items():
            echoes += echoes_ms(notebook, _ECHOES)
            presses[name].append(slider.press(key, _PRESSES))
            drags[name].append(slider.drag(MOVES, step_px))
    slow, runs = _slow(notebook)
    return Measured(echoes, presses, drags, slow, runs)


def _slow(notebook: Notebook) -> tuple[Seen, int]:
    """Move a slider over a function of half a second; return what was seen, and how often that function was run."""
    slider = Slider(notebook, cells.SLOW, "level", "panel")
    before = _calls(notebook)
    seen = slider.drag(SLOW_MOVES, _STEP_PX)
    return seen, _calls(notebook) - before


def _calls(notebook: Notebook) -> int:
    return int(notebook.execute("slow_panel.wait(10); print(len(calls))"))
