"""Does every hyperparameter get the control that its hint, its annotation or its value asks for?"""

from __future__ import annotations

import enum
from typing import Annotated, Any, Literal

import annotated_types
import ipywidgets
import numpy as np
import pytest

import epypes as ep
from epypes.errors import UnknownName
from epypes.hints import Roi, as_param
from epypes_widgets.controls.control import Control, controls
from epypes_widgets.controls.ranges import ranges
from tests.widgets.making import at


class Mode(enum.Enum):
    FAST = 1
    EXACT = 2


def made(value: Any, hint: Any = None, function: Any = None) -> Control:
    """Return the control of a hyperparameter x with this value."""
    cg = ep.CompGraph({"f": function or (lambda x: x)}, {"f": ("x", "y")})
    runner = ep.CompGraphRunner(cg, {"x": value})
    (entry,) = controls(runner, {} if hint is None else {"x": hint})
    return entry


@pytest.mark.parametrize(
    ("value", "hint", "kind"),
    [
        (70, (0, 255), ipywidgets.IntSlider),
        (70, None, ipywidgets.IntSlider),
        (np.int64(70), None, ipywidgets.IntSlider),
        (11, ep.Param(1, 31, odd=True), ipywidgets.IntSlider),
        (1.5, None, ipywidgets.FloatSlider),
        (1, (0.0, 2.0), ipywidgets.FloatSlider),
        (1.5, (1, 3), ipywidgets.FloatSlider),
        (0.1, ep.Param(0.001, 10, log=True), ipywidgets.FloatLogSlider),
        ("canny", ["canny", "sobel"], ipywidgets.Dropdown),
        (None, [1, None], ipywidgets.Dropdown),
        (Mode.FAST, None, ipywidgets.Dropdown),
        (True, None, ipywidgets.Checkbox),
        (None, None, ipywidgets.HTML),
        ("text", None, ipywidgets.Text),
        (float("inf"), None, ipywidgets.HTML),
        (float("nan"), None, ipywidgets.HTML),
        ((1, 2), None, ipywidgets.HTML),
        ((1, 2, 3, 4), Roi(), ipywidgets.HTML),
    ],
)
def test_the_hint_or_the_value_says_which_control(value: Any, hint: Any, kind: type) -> None:
    entry = made(value, hint)
    assert isinstance(entry.widget, kind)
    assert at(entry) is value or at(entry) == value


@pytest.mark.parametrize(
    ("annotation", "kind"),
    [
        (Annotated[int, ep.Param(0, 9)], ipywidgets.IntSlider),
        (Annotated[int, annotated_types.Ge(1)], ipywidgets.IntSlider),
        (Annotated[int, annotated_types.Le(100)], ipywidgets.IntSlider),
        (Literal[3, 5], ipywidgets.Dropdown),
    ],
)
def test_the_annotation_says_it_where_there_is_no_hint(annotation: Any, kind: type) -> None:
    def function(x: Any) -> Any:
        return x

    function.__annotations__["x"] = annotation
    entry = made(3, function=function)
    assert isinstance(entry.widget, kind)
    assert at(entry) == 3


def test_an_annotation_that_does_not_fit_the_value_gives_way_to_it() -> None:
    def function(x: Annotated[int, ep.Param(5, 9)]) -> int:
        return x

    function.__annotations__["x"] = Annotated[int, ep.Param(5, 9)]
    assert made(3, function=function).widget.min == 0


def test_a_slider_of_odd_integers_has_odd_ends_and_takes_no_even_one() -> None:
    entry = made(11, ep.Param(0, 30, odd=True))
    slider = entry.widget
    assert (slider.min, slider.max, slider.step, slider.continuous_update) == (1, 29, 2, False)
    entry.widget.value = 14
    assert at(entry) == 15
    entry.widget.value = 99
    assert at(entry) == 29


def test_a_value_that_is_not_negative_never_gets_a_negative_range() -> None:
    assert made(0).widget.min == 0
    assert made(2.5).widget.min == 0.0


@pytest.mark.parametrize(("value", "new"), [(None, 1), ("a", "b"), (Mode.FAST, Mode.EXACT), (True, False)])
def test_choices_can_be_moved_from_code(value: Any, new: Any) -> None:
    entry = made(value, None if isinstance(value, bool | enum.Enum) else [value, new])
    entry.write({"x": new})
    assert at(entry) is new


def test_code_may_leave_the_soft_range_but_not_the_hard_one() -> None:
    entry = made(5, ep.Param(0, 100, soft=(0, 10)))
    assert entry.widget.max == 10
    entry.write({"x": 60})
    assert (at(entry), entry.widget.max) == (60, 60)
    with pytest.raises(ValueError, match=r"can't be 101.*0 to 100"):
        entry.write({"x": 101})
    assert at(entry) == 60


def test_a_whole_number_stays_one_on_a_logarithmic_slider() -> None:
    entry = made(10, ep.Param(1, 1000, log=True))
    entry.write({"x": 100})
    assert at(entry) == 100
    assert isinstance(at(entry), int)


def test_a_hint_for_no_hyperparameter_names_the_nearest(runner: ep.CompGraphRunner) -> None:
    with pytest.raises(UnknownName, match="Did you mean 'threshold'") as caught:
        ranges(runner, {"treshold": (0, 255)})
    assert (caught.value.kind, caught.value.name) == ("hyperparameter", "treshold")


def test_a_hint_that_is_none_is_refused_by_name(runner: ep.CompGraphRunner) -> None:
    with pytest.raises(TypeError, match="Hint of 'threshold' is 5"):
        ranges(runner, {"threshold": 5})
    with pytest.raises(ValueError, match=r"Hint of 'threshold': low \(9\) is above high"):
        ranges(runner, {"threshold": (9, 1)})


@pytest.mark.parametrize("hint", [(0, 50), ["a", "b"], ep.Param(1, 101, odd=True)])
def test_a_value_outside_of_its_hint_is_refused_with_the_way_out(runner: ep.CompGraphRunner, hint: Any) -> None:
    with pytest.raises(ValueError, match=r"'threshold' is 100, outside.*Set runner\['threshold'\]"):
        ranges(runner, {"threshold": hint})


def test_hints_are_read_as_everywhere() -> None:
    assert as_param((0, 255)) == ep.Param(0, 255)


@pytest.mark.parametrize(
    ("value", "hint", "snapped", "moved"),
    [
        (1.5, None, 1.4999999999999998, 1.6),
        (0.123456, (0.0, 1.0), 0.12, 0.13),
        (0.001, (0.0, 1.0), 0.0, 0.01),
        (0.5, ep.Param(0.01, 1, log=True), 0.5011872336272722, 0.6),
        (72, (0, 255, 5), 70, 75),
    ],
)
def test_a_slider_that_snaps_to_its_steps_when_it_is_shown_was_not_moved(
    value: Any, hint: Any, snapped: Any, moved: Any
) -> None:
    entry, told = made(value, hint), []
    entry.on_change(lambda values: told.append(values["x"]))
    entry.widget.value = snapped
    assert at(entry) == value
    assert told == []
    entry.widget.value = moved
    assert told == [moved]


def test_a_hand_on_a_float_slider_means_round_numbers() -> None:
    entry = made(0.5, (0.0, 1.0))
    entry.widget.value = 0.1 + 0.2
    assert at(entry) == 0.3


def test_a_whole_number_is_not_cut_from_another() -> None:
    entry = made(3, (0, 10))
    with pytest.raises(ValueError, match=r"whole numbers, not 2\.5"):
        entry.write({"x": 2.5})
    assert at(entry) == 3


@pytest.mark.parametrize(
    ("value", "hint", "snapped", "moved"),
    [(5, (0, 10, 2), 6, 4), (0.25, (0.0, 1.0, 0.5), 0.5, 0.0), (5, (0, 10, 2), 4, 6)],
)
def test_a_value_half_way_between_two_steps_is_kept_too_and_the_hand_still_moves_it(
    value: Any, hint: Any, snapped: Any, moved: Any
) -> None:
    entry, told = made(value, hint), []
    entry.on_change(lambda values: told.append(values["x"]))
    entry.widget.value = snapped
    assert at(entry) == value
    entry.widget.value = moved
    assert told == [moved]
    entry.widget.value = snapped
    assert told == [moved, value]
