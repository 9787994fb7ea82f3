"""Does a control take every value, keep it to the last bit and in its type, and refuse what can't be?"""

from __future__ import annotations

import json
import math
import threading
from fractions import Fraction
from typing import Any

import ipywidgets
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.errors import UnknownName
from epypes.hints import Roi
from epypes_widgets.controls.column import column
from epypes_widgets.controls.control import controls
from tests.widgets.making import at, made, moves, runner_of


class Raises:
    def __repr__(self) -> str:
        raise RuntimeError("no repr")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no comparison")

    __hash__ = None  # type: ignore[assignment]


class dict_of_nothing(dict[str, int]):
    def items(self) -> Any:
        raise RuntimeError("no items")


HOSTILE = [
    None, math.nan, math.inf, -math.inf, 10**400, -(10**400), 10**5000, 2**53 + 1, 10**18, 1e300, -1e300, 1.7e308, -1.7e308,
    5e-324, -5e-324, 0.0, -0.0, 1e16, 123456789.123456789, 1j, Fraction(1, 3), b"bytes", bytearray(3), "", "\ud800",
    "two\nlines", "x" * 100_000, "<script>", np.float16(1.5), np.float32(0.1), np.float64(0.1), np.longdouble(0.1), np.uint8(7),
    np.int64(-(2**63)), np.uint64(2**64 - 1), np.bool_(True), np.str_("text"), np.datetime64("2020-01-01"),
    np.timedelta64(5, "s"), np.float32("nan"), np.array(5), np.array([1, 2]), np.array([object()]), np.zeros((0, 3)),
    [], [[[[]]]], (1, 2), (0, 0, 10, 10), {"a": {"b": [1]}}, {1, 2}, Raises(), [Raises()], dict_of_nothing(a=1), object, len,
    (lambda: 1), range(10**9), ep,
]  # fmt: skip


@pytest.mark.parametrize("value", HOSTILE, ids=range(len(HOSTILE)))
def test_any_value_has_a_control_that_can_be_sent_and_reads_as_that_value(value: Any) -> None:
    runner = runner_of(x=value)
    entries = controls(runner, {})
    (entry,) = entries
    given_value = runner.hyperparameters["x"]
    assert at(entry) is given_value or at(entry) == given_value
    json.dumps(entry.widget.get_state(), allow_nan=False, default=str).encode()
    listed = column(runner.cg, entries)
    json.dumps([listed.rows, listed.folders], allow_nan=False).encode()
    entry.write({"x": given_value})
    assert at(entry) is given_value or at(entry) == given_value


def test_a_recursive_list_and_an_array_are_shown() -> None:
    loop: list[Any] = []
    loop.append(loop)
    assert made(loop).kind == "shown"
    entry = made(np.zeros((3, 3)))
    assert (entry.kind, entry.widget.value) == ("shown", "float64 3 x 3")


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        (1e300, None),
        (1e300, ep.Param(1e-300, 1e300, log=True)),
        (5e-324, (0.0, 1e-323)),
        (5e-324, ep.Param(5e-324, 1.0, log=True)),
        (1.7e308, ep.Param(1.0, 1.7e308, log=True)),
        (0.5, (0.5, 0.5)),
        (3, (3, 3)),
        (3, ep.Param(3, 3, log=True)),
        (3, ep.Param(3, 3, odd=True)),
        (5, ep.Param(0, 10, soft=(5, 5))),
        (0.0, (-1.7e308, 1.7e308)),
        (1.0, (0.0, math.inf)),
        (1.0, ep.Param(-math.inf, 1.0)),
        (1e16, (1e16, 1e16 + 4)),
        (1.0, ep.Param(1.0, 1.0 + 1e-9, log=True)),
        (2**60, (0, 2**61)),
        (1e10, ep.Param(1e10, 1e10 + 1e-5, log=True)),
        (1e-310, ep.Param(5e-324, 1e-309, log=True)),
    ],
)
def test_ranges_at_the_limits_of_numbers_make_controls_of_finite_numbers(value: Any, hint: Any) -> None:
    entry = made(value, hint)
    assert at(entry) == value
    state = entry.widget.get_state()
    json.dumps(state, allow_nan=False, default=str)
    if entry.kind in ("slider", "log"):
        assert state["min"] < state["max"]
        assert state["step"] > 0
        for place in (entry.widget.min, entry.widget.max):
            entry.widget.value = 10.0**place if entry.kind == "log" else place
            assert (
                hint is None or hint[0] <= at(entry) <= hint[1] if isinstance(hint, tuple) else math.isfinite(at(entry))
            )


@pytest.mark.slow
@given(st.floats(-1e6, 1e6), st.lists(st.floats(-1e6, 1e6), max_size=5))
def test_a_float_that_is_written_is_read_to_the_last_bit(first: float, written: list[float]) -> None:
    entry = made(first, ep.Param(-1e6, 1e6, soft=(-10.0, 10.0)))
    told = moves(entry)
    for value in written:
        entry.write({"x": value})
        assert at(entry) == value
        assert math.copysign(1, at(entry)) == math.copysign(1, value)
        assert entry.widget.min <= value <= entry.widget.max
    assert told == []


@given(st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6), st.integers(1, 1000))
def test_a_whole_number_that_is_written_is_read_whatever_the_steps(first: int, value: int, step: int) -> None:
    entry = made(first, ep.Param(-(10**6), 10**6, step, soft=(0, 50)))
    entry.write({"x": value})
    assert (at(entry), type(at(entry))) == (value, int)


@given(st.integers(1, 10**9), st.floats(0, 9))
def test_a_logarithmic_slider_of_whole_numbers_keeps_them_within_its_range(value: int, power: float) -> None:
    entry = made(value, ep.Param(1, 10**9, log=True))
    assert at(entry) == value
    entry.widget.value = 10.0**power
    assert isinstance(at(entry), int)
    assert 1 <= at(entry) <= 10**9


@pytest.mark.parametrize("value", [np.uint8(7), np.int16(7), np.int64(7), np.float32(7.5), np.float64(7.5)])
def test_a_number_of_numpy_keeps_its_type_when_it_is_moved_and_written(value: Any) -> None:
    entry = made(value, (0, 20))
    told = moves(entry)
    entry.widget.value = 8
    assert (at(entry), type(at(entry))) == (8, type(value))
    assert told == [{"x": 8}]
    entry.write({"x": 9})
    assert (at(entry), type(at(entry))) == (9, type(value))


def test_numpy_texts_and_choices_keep_their_types_too() -> None:
    text = made(np.str_("one"))
    text.widget.value = "two"
    assert type(at(text)) is np.str_
    choice = made(np.int64(1), [0, 1, 2])
    choice.widget.index = 2
    assert (at(choice), type(at(choice))) == (2, np.int64)


@pytest.mark.parametrize(("value", "new"), [(np.uint8(7), 300), (np.uint8(7), -1), (np.int16(7), 40_000)])
def test_a_number_that_does_not_fit_into_its_type_is_refused(value: Any, new: Any) -> None:
    entry = made(value, (-1000, 10_000_000))
    with pytest.raises(ValueError, match=rf"it is of type {type(value).__name__}.*runner\['x'\] = 7"):
        entry.write({"x": new})
    assert at(entry) == 7
    assert entry.widget.max <= 10**6


@pytest.mark.parametrize("new", [math.nan, math.inf, "5", None, True, np.array([1, 2]), 1j, 10**400])
@pytest.mark.parametrize(("value", "hint"), [(5, (0, 10)), (0.5, (0.0, 1.0)), (5, ep.Param(1, 100, log=True))])
def test_what_is_no_number_is_refused_by_a_slider(value: Any, hint: Any, new: Any) -> None:
    entry = made(value, hint)
    with pytest.raises(ValueError, match="'x' can't be"):
        entry.write({"x": new})
    assert at(entry) == value


def test_an_even_number_is_refused_where_only_odd_ones_are_taken() -> None:
    entry = made(11, ep.Param(1, 31, odd=True))
    with pytest.raises(ValueError, match="'x' can't be 12: its range is odd 1 to 31"):
        entry.write({"x": 12})


@pytest.mark.parametrize(
    ("value", "hint", "kind"),
    [
        (1.7e308, ep.Param(1.0, 1.7e308, log=True), "log"),
        (1e308, (0.0, 1.7e308), "slider"),
        (1e308, ep.Param(soft=(1e307, 1.7e308)), "slider"),
        (5, ep.Param(0, soft=(5, 5)), "slider"),
        (5.0, ep.Param(0.0, soft=(0.0, math.inf)), "slider"),
    ],
)
def test_a_number_near_the_greatest_or_in_an_open_range_has_a_slider(value: Any, hint: Any, kind: str) -> None:
    assert made(value, hint).kind == kind


def test_a_slider_that_is_stretched_keeps_its_places() -> None:
    entry = made(32, ep.Param(0, 1000, 16, soft=(16, 64)))
    entry.write({"x": 100})
    assert (entry.widget.min, entry.widget.max) == (16, 112)
    entry.write({"x": 3})
    assert entry.widget.min == 0
    odd = made(5, ep.Param(1, 99, odd=True, soft=(3, 9)))
    odd.write({"x": 21})
    assert (odd.widget.min, odd.widget.max) == (3, 21)


def test_a_value_outside_of_the_soft_range_is_offered_from_the_beginning() -> None:
    assert made(60, ep.Param(0, 100, soft=(0, 10))).widget.max == 60


def test_a_choice_that_is_gone_back_to_is_the_value_that_was_there() -> None:
    entry = made(1.0, [0, 1, 2])
    told = moves(entry)
    entry.widget.index = 2
    entry.widget.index = 1
    assert [(values["x"], type(values["x"])) for values in told] == [(2, int), (1.0, float)]


def test_named_choices_are_shown_by_name_and_two_may_have_one_value() -> None:
    entry = made(1, ep.Param(choices=(0, 1, 1, 2), labels=("NEAREST", "LINEAR", "BILINEAR", "CUBIC")))
    assert entry.widget.options == ("NEAREST", "LINEAR", "BILINEAR", "CUBIC")
    assert entry.widget.index == 1
    entry.write({"x": 2})
    entry.write({"x": 1})
    assert entry.widget.index == 1
    entry.widget.index = 3
    assert at(entry) == 2


def test_choices_tell_true_from_one_and_take_objects_that_do_not_compare() -> None:
    entry = made(1, [True, 1, 1.0])
    assert (entry.widget.index, at(entry)) == (1, 1)
    entry.write({"x": True})
    assert at(entry) is True
    entry.widget.index = 2
    assert type(at(entry)) is float
    with pytest.raises(ValueError, match=r"can't be 5: its range is one of True, 1, 1\.0"):
        entry.write({"x": 5})


@pytest.mark.parametrize("choices", [[False, True], [True, False]])
def test_true_and_false_in_any_order_are_a_checkbox(choices: list[bool]) -> None:
    entry = made(True, choices)
    told = moves(entry)
    assert (entry.kind, entry.widget.value) == ("check", True)
    entry.widget.value = False
    assert told == [{"x": False}]
    entry.write({"x": True})
    assert at(entry) is True
    with pytest.raises(ValueError, match="can't be 1"):
        entry.write({"x": 1})


def test_a_text_is_typed_and_counts_to_the_last_character() -> None:
    entry = made("two\nlines")
    told = moves(entry)
    assert isinstance(entry.widget, ipywidgets.Textarea)
    assert not entry.widget.continuous_update
    entry.widget.value = "typed"
    entry.write({"x": "half a pair \ud800"})
    assert (at(entry), told) == ("half a pair \ud800", [{"x": "typed"}])
    with pytest.raises(ValueError, match="can't be 5: its range is any text"):
        entry.write({"x": 5})


def test_a_rectangle_is_said_in_words_and_stays_a_list() -> None:
    entry = made([10, 20, 100, 80], Roi())
    assert (entry.kind, entry.widget.value) == ("roi", "x 10, y 20, 100 x 80")
    entry.write({"x": (1, np.int64(2), 3, 4)})
    assert at(entry) == [1, 2, 3, 4]
    assert entry.widget.value == "x 1, y 2, 3 x 4"
    for wrong in ((1, 2, 3), (1, 2, 3, 4.5), "1234", None, (-1, 0, 5, 5), Raises()):
        with pytest.raises(ValueError, match="'x' can't be .* it is a rectangle"):
            entry.write({"x": wrong})
    assert at(entry) == [1, 2, 3, 4]


def test_a_selector_of_a_switch_gets_its_branches() -> None:
    branches = ep.CompGraph({"a": lambda i: i, "b": lambda i: -i}, {"a": ("i", "plus"), "b": ("i", "minus")})
    runner = ep.CompGraphRunner(
        branches | ep.switch("s", {"p": "plus", "m": "minus"}, by="sign", output="o"), {"sign": "m"}
    )
    (entry,) = controls(runner, {})
    assert (entry.kind, entry.widget.options, at(entry)) == ("choice", ("p", "m"), "m")
    (hinted,) = controls(runner, {"sign": ep.Param(choices=("m", "p"))})
    assert hinted.widget.options == ("m", "p")


def test_a_selector_of_two_switches_gets_the_branches_of_both() -> None:
    first = ep.switch("s1", {"p": "a", "q": "b", "r": "c"}, by="by", output="o1")
    second = ep.switch("s2", {"q": "d", "p": "e"}, by="by", output="o2")
    (entry,) = controls(ep.CompGraphRunner(first | second, {"by": "q"}), {})
    assert entry.widget.options == ("p", "q")


def test_who_listens_to_the_hand_does_not_hear_of_what_code_writes() -> None:
    for value, new in ((5, 6), ("a", "b"), (True, False)):
        entry = made(value)
        told = moves(entry)
        entry.write({"x": new})
        assert (at(entry), told) == (new, [])


def test_a_write_to_a_token_of_another_control_names_it() -> None:
    with pytest.raises(UnknownName, match="No hyperparameter 'y' of this control"):
        made(5).write({"y": 5})


def test_a_hand_that_moves_while_code_writes_is_heard_unless_it_was_written_over() -> None:
    entry = made(0, (0, 1000))
    told = moves(entry)
    start = threading.Barrier(2)

    def write() -> None:
        start.wait(60)
        for value in range(0, 1000, 2):
            entry.write({"x": value})

    thread = threading.Thread(target=write)
    thread.start()
    start.wait(60)
    for value in range(1, 1000, 2):
        entry.widget.set_state({"value": value})  # as a message of the front end does
    thread.join(60)
    assert at(entry) == entry.widget.value
    assert at(entry) == 998 or told[-1] == {"x": 999}
    assert {values["x"] % 2 for values in told} <= {1}


def test_a_hand_on_a_logarithmic_slider_means_short_numbers_one_for_each_place() -> None:
    for value, low, high in ((0.5, 0.001, 10.0), (1.2, 1.0, 1.5), (1.0, 1.0, 1.0 + 1e-9), (5.0, 1e-300, 1e300)):
        entry = made(value, ep.Param(low, high, log=True))
        widget, seen = entry.widget, []
        for place in range(1, 20):
            widget.value = 10 ** (widget.min + place * widget.step)
            seen.append(at(entry))
        assert seen == sorted(set(seen))
        assert low <= seen[0]
        assert seen[-1] <= high
    wide = made(0.5, ep.Param(0.001, 10, log=True))
    wide.widget.value = 0.036307805477
    assert at(wide) == 0.03631


def test_what_is_only_shown_stands_beside_its_name_and_is_no_markup() -> None:
    entry = made(["<b>"])
    assert (entry.widget.description, entry.widget.value) == ("x", "[&#x27;&lt;b&gt;&#x27;]")
    entry.write({"x": ["<i>"]})
    assert entry.widget.value == "[&#x27;&lt;i&gt;&#x27;]"


@pytest.mark.parametrize(
    ("value", "hint", "written", "trait", "moved", "meant"),
    [
        (5, (0, 10), 7, "value", 9, 9),
        (0.5, (0.0, 1.0), 0.123456, "value", 0.9, 0.9),
        (5, ep.Param(1, 1000, log=True), 7, "value", 100.0, 100),
        ("a", ["a", "b", "c"], "b", "index", 2, "c"),
        ("one", None, "two", "value", "three", "three"),
    ],
)
def test_a_hand_that_moves_in_the_middle_of_a_write_is_heard(
    value: Any, hint: Any, written: Any, trait: str, moved: Any, meant: Any
) -> None:
    entry = made(value, hint)
    told = moves(entry)
    hands: list[threading.Thread] = []

    def interfere(_change: object) -> None:
        if not hands:
            hands.append(threading.Thread(target=setattr, args=(entry.widget, trait, moved)))
            hands[0].start()
            while getattr(entry.widget, trait) != moved:  # it is heard only when the write is over
                pass

    entry.widget.observe(interfere, trait)
    entry.write({"x": written})
    hands[0].join(60)
    assert (at(entry), told) == (meant, [{"x": meant}])


# -- a range that is widened --------------------------------------------------------------------------------------


def test_a_value_outside_of_the_soft_range_widens_the_slider_until_it_returns() -> None:
    control = made(70, ep.Param(soft=(0, 100)))
    slider = control.widget
    told = moves(control)
    control.write({"x": 700})
    assert (slider.min, slider.max, slider.value) == (0, 700, 700)
    slider.value = 40
    control.write({"x": 30})
    assert slider.max == 700, "what was typed once can be dragged to again"
    control.write({"x": 70}, is_return=True)
    assert (slider.min, slider.max, at(control)) == (0, 100, 70)
    control.write({"x": -30}, is_return=True)
    assert (slider.min, slider.max, at(control)) == (-30, 100, -30)
    assert told == [{"x": 40}]


@pytest.mark.parametrize("value", [np.bool_(False), np.bool_(True)])
def test_a_truth_value_of_numpy_has_a_tick_box(value: Any) -> None:
    control = made(value)
    assert (control.kind, control.widget.value, type(at(control))) == ("check", bool(value), type(value))
    control.widget.value = not value
    assert at(control) == np.bool_(not value)
    assert type(at(control)) is np.bool_


def test_numbers_and_truth_values_of_numpy_are_written_as_short_as_they_are() -> None:
    runner = runner_of(x=np.float32(0.3), is_on=np.bool_(True))
    assert [row["default"] for row in column(runner.cg, controls(runner, {})).rows] == [[0.3], [True]]
    assert at(made(np.float32(0.3))).dtype == np.float32
