"""Does the code line make the values again, and is it one that a person would write?"""

from __future__ import annotations

import enum
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from epypes_widgets.code import line, name_of, source


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


class Flags(enum.IntFlag):
    A = 1
    B = 2


class Hint:
    """What a Param with named choices looks like from here."""

    def __init__(self, *labels: str, choices: tuple[Any, ...] | None = None) -> None:
        self.labels = labels
        self.choices = tuple(getattr(cv2, label) for label in labels) if choices is None else choices


def evaluated(text: str) -> Any:
    return eval(text, {"np": np, "cv2": cv2, "Method": Method, "Flags": Flags})


@pytest.mark.parametrize(
    "value",
    [3, -2.5, 0.1 + 0.2, -0.0, float("inf"), -math.inf, float("nan"), True, None, 'it\'s "x"\n', b"\x00", 1j, (), (3,), (3, 5), [1, [2]],
     {"a": (1, 2)}, {1, 2}, Method.SOBEL, Flags.A | Flags.B, (Method.CANNY, np.uint8(3)), [float("nan")], np.uint8(7), np.int64(-3),
     np.float32(0.1), np.float64(1 / 3), np.bool_(True), np.float32("nan"), np.float64("-inf"), np.float16(0.1), np.complex64(1 + 2j), np.longdouble("0.1")],
    ids=repr,
)  # fmt: skip
def test_what_is_written_makes_the_value_again(value: Any) -> None:
    text = source(value)
    again = evaluated(text)
    assert "\n" not in text
    assert type(again) is type(value)
    assert repr(again) == repr(value)


@pytest.mark.parametrize(
    "value",
    [np.ones(3), object(), len, [np.ones(3)], {"a": np.ones(3)}, "x" * 1_000, list(range(500)), Flags(0)],
    ids=type,
)
def test_what_has_no_short_text_has_none(value: Any) -> None:
    assert source(value) == ""


def test_only_what_has_changed_stands_in_the_line() -> None:
    assert line("runner", {"lo": 70, "hi": 200}, {"lo": 90, "hi": 200}) == "runner.rerun(lo=90)"
    assert line("edges", {"lo": 70}, {"lo": 70}) == "edges.rerun()"
    assert line("runner", {"nan": float("nan")}, {"nan": float("nan")}) == "runner.rerun()"
    assert line("runner", {"k": 1}, {"k": 1.0}) == "runner.rerun(k=1.0)"


def test_names_that_python_does_not_take_go_through_a_dictionary() -> None:
    before = {"lambda": 1, "with blank": 1, "größe": 1, "self": 1}
    text = line("runner", before, dict.fromkeys(before, 2))
    assert text == "runner.rerun(größe=2, self=2, **{'lambda': 2, 'with blank': 2})"


def test_what_can_not_be_written_is_left_out_and_named() -> None:
    before: dict[str, Any] = {"kernel": np.ones(3), "a": len, "line\nbreak": len, "k": 1}
    after: dict[str, Any] = {"kernel": np.zeros(3), "a": min, "line\nbreak": min, "k": 2}
    text = line("runner", before, after)
    assert text == "runner.rerun(k=2)  # without kernel, a and 'line\\nbreak': no short text makes that value"


def test_constants_of_opencv_are_called_by_their_names() -> None:
    params = {"flags": Hint("INTER_NEAREST", "INTER_LINEAR")}
    assert line("runner", {"flags": 0}, {"flags": 1}, params) == "runner.rerun(flags=cv2.INTER_LINEAR)"
    both = cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU
    for label in ("THRESH_BINARY_INV | THRESH_OTSU", "cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU"):
        text = source(both, Hint(label, choices=(both,)))
        assert text == "cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU"
        assert evaluated(text) == both


def test_a_label_that_is_no_constant_of_this_value_is_not_taken_for_one() -> None:
    assert source(1, Hint("INTER_NEAREST", choices=(1,))) == "1"
    assert source(1, Hint("fast", choices=(1,))) == "1"
    assert source(1, Hint("imread", choices=(1,))) == "1"
    assert source(1, Hint(choices=(0, 1))) == "1"
    assert source("x", Hint("INTER_LINEAR", choices=("x",))) == '"x"'


def test_a_runner_is_called_what_it_was_called_first() -> None:
    runner, other = [1], [1]
    namespace = {
        "_": runner,
        "_3": runner,
        "other": other,
        "not a name": runner,
        "class": runner,
        "edges": runner,
        "again": runner,
    }
    assert name_of(runner, namespace) == "edges"
    assert name_of(runner, {"other": other, "_": runner}) == "runner"
    assert name_of(runner, {}) == "runner"


def test_outside_of_a_notebook_a_runner_is_called_runner() -> None:
    assert name_of(object()) == "runner"


@pytest.mark.slow
def test_in_a_notebook_a_runner_is_found_among_what_its_cells_defined(tmp_path: Path) -> None:
    code = "from epypes_widgets.code import name_of; _hidden = edges = object(); assert name_of(edges) == 'edges'"
    command = [sys.executable, "-m", "IPython", "--no-banner", "-c", code]
    done = subprocess.run(command, env={**os.environ, "IPYTHONDIR": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
