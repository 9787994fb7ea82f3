"""What does the notebook hold in which the contenders stand?"""

from __future__ import annotations

from pathlib import Path

# The echo: an integer goes to the kernel in one trait and comes back in another.
_ECHO = """
import anywidget, traitlets

class Echo(anywidget.AnyWidget):
    _esm = '''
    export default { render({ model }) {
        window.benchEcho = (value) => new Promise((resolve) => {
            const start = performance.now();
            const answered = () => {
                model.off("change:answer", answered);
                resolve(performance.now() - start);
            };
            model.on("change:answer", answered);
            model.set("ask", value);
            model.save_changes();
        });
    } };
    '''
    ask = traitlets.Int().tag(sync=True)
    answer = traitlets.Int().tag(sync=True)

    @traitlets.observe("ask")
    def _answer(self, change):
        self.answer = change["new"]

Echo()
"""
_GRAPH = """
import cv2, threading, ipywidgets, matplotlib.pyplot as plt, numpy as np, epypes as ep
from epypes.display.previews.encoding import encode_image
from epypes_widgets import tune
from skimage import data
from tests.benchmarks.work import edge_graph

photograph = np.ascontiguousarray(cv2.resize(cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR), (1224, 816)))
work = edge_graph(photograph)
runner = ep.CompGraphRunner(ep.CompGraph(work.functions, work.io), work.hparams)
_ = runner.run(**work.payload)
blurred = np.array(runner["image_blurred"])
"""
_OURS = """
panel = tune(runner, canny_lo=(0, 255), canny_hi=(0, 255))
panel
"""
# As much is computed as the panel computes: what the slider changes. Three digits behind the picture's end tell its value.
_IMAGE = """
def encoded(canny_lo):
    return bytes(encode_image(cv2.Canny(blurred, canny_lo, 200), 1400).data) + b"%03d" % canny_lo

def shown(change):
    image.value = encoded(change["new"])

image = ipywidgets.Image(value=encoded(70), format="png", layout={"width": "600px"})
slider = ipywidgets.IntSlider(70, 0, 255, description="canny_lo", layout={"width": "400px"})
slider.observe(shown, "value")
ipywidgets.VBox([slider, image])
"""
_MATPLOTLIB = """
%matplotlib inline
from matplotlib_inline.config import InlineBackend

def drawn(canny_lo):
    InlineBackend.instance().print_figure_kwargs = {"bbox_inches": "tight", "metadata": {"Title": f"{canny_lo:03}"}}
    plt.imshow(cv2.Canny(blurred, canny_lo, 200), cmap="gray")
    plt.show()

_ = ipywidgets.interact(drawn, canny_lo=ipywidgets.IntSlider(70, 0, 255, layout={"width": "400px"}))
"""
_SLOW = """
calls = []

def slow(image, level):
    calls.append(level)
    threading.Event().wait({run_s})
    return cv2.threshold(image, level, 255, cv2.THRESH_BINARY)[1]

slow_runner = ep.CompGraphRunner(ep.CompGraph({{"slow": slow}}, {{"slow": (("image", "level"), "mask")}}), {{"level": 20}})
_ = slow_runner.run(image=photograph[::4, ::4, 0].copy())
slow_panel = tune(slow_runner, level=(0, 255))
slow_panel
"""
RUN_S = 0.5
# In this order; a contender is found by the number of its cell.
CELLS = (_GRAPH, _ECHO, _OURS, _IMAGE, _SLOW.format(run_s=RUN_S), _MATPLOTLIB)
OURS, IMAGE, SLOW, MATPLOTLIB = range(2, 6)


def write_notebook(file: Path) -> None:
    """Write the notebook with all contenders."""
    import nbformat  # takes seconds

    document = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(cell.strip()) for cell in CELLS],
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}},
    )
    nbformat.write(document, file)
