"""The usual mistakes of the first hour: each error says what is wrong and the way out, at the user's own line."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import pytest

from epypes.errors import MissingPackage
from tests.ipython_cells import run_cells

ROOT = Path(__file__).parents[2]
SETUP = """
import cv2
import numpy as np
import epypes as ep
from epypes_widgets import interact, tune

def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

def blurred(gray, blur_kernel=11):
    return cv2.GaussianBlur(gray, (blur_kernel, blur_kernel), 0)

def edges(blurred, canny_lo=70, canny_hi=200):
    return cv2.Canny(blurred, canny_lo, canny_hi)

image = np.zeros((40, 50, 3), np.uint8)
cg = ep.CompGraph.from_functions(gray, blurred, edges)
runner = ep.CompGraphRunner(cg)

def run_once(*functions):
    return ep.CompGraphRunner(ep.CompGraph.from_functions(*functions)).run(image=image)
"""
# By the cells, run one after the other, a part of what each says.
MISTAKES = {
    "runner['edges']": "Token 'edges' has not been computed: nothing has been run. Call run(image=...).",
    "tune(runner)": "Nothing has been run yet, so there is nothing to tune on. Call run(image=...) first.",
    "runner.run()": "Missing payload: 'image'. Call run(image=...).",
    "runner.run(image)": "Payload goes by name: run(image=...).",
    "runner.run(imgae=image)": "No token 'imgae' in this graph. Did you mean 'image'?",
    "runner.run(image=cv2.imread('absent.png'))": "image is None. Was the file found?",
    "runner.run(image='photo.png')": ("image is a text, not an image. Read the file first: cv2.imread('photo.png')."),
    "runner.run(image=image[..., 0])": "image has 1 channel, which this conversion of colours does not take. It is grey",
    "run = runner.run(image=image); run['edgs']": "No token 'edgs' in this graph. Did you mean 'edges'?",
    "runner.rerun(cany_lo=3)": "No token 'cany_lo' in this graph. Did you mean 'canny_lo'?",
    "runner.rerun(blur_kernel=4)": "blur_kernel=4: cv2.GaussianBlur takes an odd number, 1 or more.",
    "ep.group(cg, 'preparation', ['gry'])": "No function 'gry' in this graph. Did you mean 'gray'?",
    "run_once(lambda image: image)": "A lambda has no name that could be its token's. Write it as a function (def)",
    "def flat(image):\n    cv2.blur(image, (3, 3))\ndef sharp(flat):\n    return cv2.medianBlur(flat, 3)\nrun_once(flat, sharp)": (
        "flat is None, made by function 'flat'. Does it return a value?"
    ),
    "ep.CompGraph.from_functions([gray, edges])": (
        "Give functions one by one, not as a list: CompGraph.from_functions(*functions)."
    ),
    "ep.CompGraph.from_functions(gray(image))": "Give the function itself: edges, not edges(image).",
    "ep.CompGraph.from_functions(gray, edges, gray)": "Two functions are called 'gray'. Rename one of them",
    "ep.CompGraph(gray, edges)": "Of functions alone: CompGraph.from_functions(function, ...).",
    "ep.CompGraph({'gray': gray}, {'gray': (('image', 'k'), 'g')})": (
        "Function 'gray' takes 1 input (image), but its io names 2: (image, k)."
    ),
    "ep.CompGraphRunner(ep.CompGraph({'f': lambda x: (x, x, x)}, {'f': ('x', ('a', 'b'))})).run(x=1)": (
        "Function 'f' must return a tuple or list of 2 values (a, b), but it returned tuple of 3."
    ),
    "def cut(gray, level):\n    return gray > level\nrun_once(gray, cut)": (
        "Missing payload: 'level'. Call run(image=..., level=...), or make what is constant a hyperparameter"
    ),
    "def soft(blured):\n    return blured\nrun_once(gray, blurred, soft)": (
        "No function makes 'blured'; 'blurred' makes 'blurred': is that what was meant?"
    ),
    "def drawn(image):\n    cv2.rectangle(image, (0, 0), (9, 9), 255)\n    return image\nrun_once(drawn)": (
        "Work on a copy, made with .copy(), or mark the function with @ep.unguarded if it only reads."
    ),
    "tune(run)": "Give the runner that made the run: tune(runner).",
    "tune(cg)": "No value is given for 'image' of 'gray', 'blurred' and 'edges'. Call tune([gray, blurred, edges], image=image).",
    "tune(runner, blur_kernal=(1, 31))": "No hyperparameter 'blur_kernal' of this runner. Did you mean 'blur_kernel'?",
    "runner.rerun(blur_kernel=11); panel = tune(runner); panel['blur_kernel'] = 4": (
        "'blur_kernel' can't be 4: its range is odd from 1. Set 3 or 5."
    ),
    "panel['canny_lo'] = 'low'": "'canny_lo' can't be 'low': it takes numbers",
    "interact(edges, image[..., 0], canny_lo=range(0))": "There are no choices. Give at least one value.",
    "def plotted(image, k=3):\n    cv2.blur(image, (k, k))\ninteract(plotted, image)": (
        "There is nothing to show: 'plotted' returned None. A panel shows what functions return."
    ),
    "ep.show(image)": (
        "ep.show() draws a CompGraph, a CompGraphRunner, a Run, a Plan or a Pipeline, not 'ndarray'. "
        "An image is in the picture of its run: ep.show(runner.run(...))."
    ),
    "ep.tune": "Module 'epypes' has no attribute 'tune'. Write: from epypes_widgets import tune",
    "ep.CompGrap": "Did you mean 'CompGraph'?",
    "ep.map(cg, [image])": "Make one of the graph: ep.CompGraphRunner(cg, hparams).",
    "ep.map(runner, 'absent')": "There is no folder or file 'absent'. Check the path.",
    "import os; os.mkdir('empty'); ep.map(runner, 'empty')": "There are no images in folder 'empty': no file ends in",
    "frames = (each for each in [image]); ep.map(runner, frames); ep.map(runner, frames)": (
        "A generator can be read only once: make a list of it."
    ),
    "ep.sweep(runner, {'canny_lo': []})": "canny_lo=[] has no values. Give at least one, as canny_lo=[...].",
    "ep.CompGraphRunner(cg, canny_lo=3)": "unexpected keyword argument 'canny_lo'",
    "def hue(image):\n    return cv2.cvtColor(image, cv2.COLOR_RGB2HSV)\nrun_once(gray, hue)": (
        "annotate what the function takes: Annotated[np.ndarray, ep.Image(order='bgr')]."
    ),
    "import sys; sys.modules['optuna'] = None; ep.optimize(runner, 'edges', [image])": (
        "Package 'optuna' is missing. Run: pip install 'epypes[scale]'"
    ),
    "ep.connect('http://127.0.0.1:9')": "No service answers at http://127.0.0.1:9. Start one: epypes serve",
}


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    setup, *each = run_cells(SETUP, *MISTAKES, folder=tmp_path_factory.mktemp("first_hour"))
    assert setup.succeeded, setup.text
    return dict(zip(MISTAKES, each, strict=True))


@pytest.mark.notebook
@pytest.mark.parametrize("cell", MISTAKES)
def test_the_error_names_the_way_out_below_the_users_own_line(shown, cell):
    assert not shown[cell].succeeded
    assert MISTAKES[cell] in " ".join(shown[cell].text.split()), shown[cell].text
    assert not re.search(r"File \S*epypes", shown[cell].text)


def test_where_epypes_runs_from_a_folder_the_command_for_a_missing_package_names_that(monkeypatch):
    def none(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", none)
    assert str(MissingPackage("optuna", "scale")) == f"Package 'optuna' is missing. Run: pip install '{ROOT}[scale]'"
