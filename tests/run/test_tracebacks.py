"""In a notebook a traceback has the user's frames alone, and ends with the user's own line."""

from __future__ import annotations

import re
import sys
import traceback

import pytest

import epypes as ep
from tests.ipython_cells import run_cells

SETUP = """
import cv2
import numpy as np
import epypes as ep

image = np.zeros((40, 50, 3), np.uint8)

def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

def blur(gray, k):
    if k == 13:
        raise ValueError("thirteen")  # THE LINE
    return cv2.GaussianBlur(gray, (k, k), 0)

cg = ep.CompGraph(
    {"gray": gray, "blur": blur, "canny": cv2.Canny},
    {"gray": ("image", "grey"), "blur": (("grey", "k"), "blurred"), "canny": (("blurred", "low", "high"), "edges")},
)
hparams = {"k": 5, "low": 70, "high": 200}
runner = ep.CompGraphRunner(cg, hparams)
pipe = ep.Pipeline("edges", cg, hparams)
around = ep.CompGraphRunner(ep.CompGraph({"edges": pipe}, {"edges": ("image", "edges")}))
wide = ep.union(cg, ep.suffix(cg, "_2", keep=("image",)))
threads = ep.CompGraphRunner(wide, {**hparams, "k_2": 5, "low_2": 70, "high_2": 200}, workers=2)
checked = ep.CompGraphRunner(cg, hparams, check_mutation=True)

def often(runner):
    for k in range(3, 9, 2):
        for _ in range(5):
            runner.rerun(k=k)
"""
OWN = 'raise ValueError("thirteen")  # THE LINE'
# By cell, a part of its last line that is shown, and of what is shown after it.
CELLS = {
    "runner.run(image=image); runner.rerun(k=13)": (OWN, "In function 'blur'"),
    "often(runner); runner.rerun(k=13)": (OWN, "In function 'blur'"),
    "pipe['k'] = 13; pipe(image)": (OWN, "In function 'blur'"),
    "around.run(image=image)": (OWN, "In function 'edges'"),
    "threads['k'] = 13; threads.run(image=image)": (OWN, "In function 'blur'"),
    "checked['k'] = 13; checked.run(image=image)": (OWN, "In function 'blur'"),
    "often(runner); runner.rerun(k=5, low='low')": ("runner.rerun(k=5, low='low')", "In function 'canny'"),
    "runner.run(image=image, low=30)": ("runner.run(image=image, low=30)", "which run() does not take"),
    "runner['edgez']": ("runner['edgez']", "Did you mean 'edges'"),
    "ep.CompGraph({'gray': gray}, {})": ("ep.CompGraph({'gray': gray}, {})", "has no io"),
    "pipe.set(kk=1)": ("pipe.set(kk=1)", "No token 'kk'"),
}


def shown_in(mode):
    setup, *shown = run_cells(SETUP, *CELLS, mode=mode)
    assert setup.succeeded, setup.text
    assert not any(each.succeeded for each in shown)
    return {cell: each.text for cell, each in zip(CELLS, shown, strict=True)}


def lines_of_frames(text):
    """Return the line that each frame points at."""
    return [line.partition(" ")[2].strip() for line in re.findall(r"^-+> (\d+ .*)$", text, re.MULTILINE)]


@pytest.fixture(scope="module")
def in_context():
    return shown_in("Context")


@pytest.mark.slow
@pytest.mark.parametrize("cell", CELLS)
def test_ipython_shows_no_frame_of_epypes_and_the_users_line_last_with_the_note_below(in_context, cell):
    text = in_context[cell]
    last, below = CELLS[cell]
    assert last in lines_of_frames(text)[-1]
    assert below in text.rpartition(last)[2]
    assert "epypes" not in "".join(lines_of_frames(text))
    assert not re.search(r"File .*epypes", text)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["Plain", "Verbose", "Minimal"])
def test_every_mode_of_ipython_names_the_function_and_the_error(mode):
    for cell, text in shown_in(mode).items():
        last, below = CELLS[cell]
        assert below in text
        assert mode == "Minimal" or last in text


def test_python_itself_shows_every_frame_and_pytest_hides_those_of_epypes():
    def work(x):
        raise ValueError("no")

    runner = ep.CompGraphRunner(ep.CompGraph({"work": work}, {"work": ("x", "y")}))
    with pytest.raises(ValueError, match="no") as raised:
        runner.run(x=1)
    assert "run/call.py" in "".join(traceback.format_exception(raised.value))
    assert [entry.name for entry in raised.traceback.filter(raised)] == [
        "test_python_itself_shows_every_frame_and_pytest_hides_those_of_epypes", "work",
    ]  # fmt: skip


def test_an_exception_of_c_code_is_marked_for_ipython_alone_and_keeps_no_reference_to_itself(monkeypatch):
    runner = ep.CompGraphRunner(ep.CompGraph({"work": ord}, {"work": ("x", "y")}))
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    with pytest.raises(TypeError) as raised:
        runner.run(x=1)
    assert vars(raised.value).keys() == {"__notes__"}
    monkeypatch.setitem(sys.modules, "IPython", None)
    with pytest.raises(TypeError) as raised:
        runner.run(x=1)
    assert raised.value._render_traceback_.__closure__ is None
    assert not hasattr(raised.value._render_traceback_, "__self__")
