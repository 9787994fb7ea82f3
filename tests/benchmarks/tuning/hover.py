"""From the pointer on a token to its full picture of 1 MP, painted."""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import median

from tests.benchmarks.row import OURS, Goal, Row
from tests.benchmarks.timing import Effort
from tests.browser.jupyter import JupyterLab, Notebook, chromium, open_lab, write_notebook

_TOKENS, _QUICK_TOKENS = 20, 3
_MOST_NS = 150e6
_CELL = """
import cv2, numpy as np, epypes as ep
from skimage import data
photograph = cv2.resize(cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR), (1224, 816))
io = {{f"f{{index}}": (f"t{{index}}", f"t{{index + 1}}") for index in range({count})}}
cg = ep.CompGraph(dict.fromkeys(io, lambda image: image + np.uint8(1)), io)
ep.show(ep.CompGraphRunner(cg).run(t0=photograph))
"""
# Resolves to the milliseconds from the event that the pointer causes to the frame that has the picture.
_HOVERED = """token => new Promise(resolve => {
    const vertex = document.querySelector(`#token-${token}`), start = performance.now();
    vertex.dispatchEvent(new PointerEvent('pointerover', { bubbles: true }));
    const image = document.querySelector('.epypes-card img');
    image.addEventListener('load', () => {
        if (image.naturalWidth > 1000) requestAnimationFrame(() => resolve(performance.now() - start));
    });
})"""


def row(effort: Effort) -> Row:
    """Return the row of all hovers; the first one, which opens the connection, is one of many."""
    count = _QUICK_TOKENS if effort.quick else _TOKENS
    with tempfile.TemporaryDirectory(prefix="epypes-hover-") as folder:
        notebooks = Path(folder) / "notebooks"
        notebooks.mkdir()
        write_notebook(notebooks / "hover.ipynb", _CELL.format(count=count))
        with JupyterLab(notebooks, Path(folder) / "lab") as lab, chromium() as browser:
            notebook = Notebook(open_lab(browser, lab), "hover.ipynb")
            notebook.run_all()
            echoes = notebook.echo_ms(count)
            hovers = [notebook.page.evaluate(_HOVERED, f"t{index}") for index in range(1, count)]
    amounts = {"echo": median(echoes) * 1e6, OURS: median(hovers) * 1e6}
    note = f"limit: an empty request to the kernel and back; the slowest hover took {max(hovers):.0f} ms"
    return Row(
        "JupyterLab: hover to full picture, 1 MP", amounts, goal=Goal("total", _MOST_NS), limit="echo", note=note
    )
