"""Does a slider with two ends keep two hyperparameters in order, and move only the one that is moved?"""

from __future__ import annotations

import threading
from typing import Any

import ipywidgets
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes_widgets.controls.control import Control, controls
from tests.widgets.making import moves, runner_of

BOTH = ep.Param(0, 255, below="hi")


def paired(lo: Any, hi: Any, low: ep.Param = BOTH, high: Any = (0, 255)) -> Control:
    """Return the control of two hyperparameters, of which lo never exceeds hi."""
    (entry,) = controls(runner_of(lo=lo, hi=hi), {"lo": low, "hi": high})
    return entry


def test_two_tokens_of_which_one_stays_below_the_other_get_one_slider() -> None:
    entry = paired(70, 200)
    assert (entry.names, entry.kind, entry.read()) == (("lo", "hi"), "range", {"lo": 70, "hi": 200})
    assert isinstance(entry.widget, ipywidgets.IntRangeSlider)
    assert isinstance(paired(0.5, 1.5, ep.Param(0.0, 2.0, below="hi"), (0.0, 2.0)).widget, ipywidgets.FloatRangeSlider)


def test_a_pair_is_named_lower_first_and_stands_where_its_first_token_does() -> None:
    made = controls(runner_of(a=1, hi=200, b=1, lo=70), {"lo": BOTH, "hi": (0, 255)})
    assert [entry.names for entry in made] == [("a",), ("lo", "hi"), ("b",)]


def test_moving_one_end_moves_that_token_only() -> None:
    entry = paired(72, 203, ep.Param(0, 255, 5, below="hi"), (0, 255, 5))
    told = moves(entry)
    entry.widget.value = (70, 205)  # what the front end reports as soon as it is shown
    assert (entry.read(), told) == ({"lo": 72, "hi": 203}, [])
    entry.widget.value = (80, 205)
    assert (entry.read(), told) == ({"lo": 80, "hi": 203}, [{"lo": 80}])
    entry.widget.value = (80, 210)
    assert told == [{"lo": 80}, {"hi": 210}]


def test_a_write_that_would_exchange_the_two_is_refused_with_the_way_out() -> None:
    entry = paired(70, 200)
    with pytest.raises(
        ValueError, match="'lo' can't be 210: it is never above 'hi', which is 200. Set 'hi' first, or both"
    ):
        entry.write({"lo": 210})
    with pytest.raises(
        ValueError, match="'hi' can't be 60: it is never below 'lo', which is 70. Set 'lo' first, or both"
    ):
        entry.write({"hi": 60})
    with pytest.raises(ValueError, match="'hi' can't be 300: its range is 0 to 255"):
        entry.write({"lo": 80, "hi": 300})
    assert entry.read() == {"lo": 70, "hi": 200}
    assert entry.widget.value == (70, 200)


@pytest.mark.parametrize("values", [{"lo": 210, "hi": 220}, {"hi": 220, "lo": 210}, {"hi": 30, "lo": 20}, {"lo": 200}])
def test_both_may_be_written_at_once_in_any_order(values: dict[str, int]) -> None:
    entry = paired(70, 200)
    told = moves(entry)
    entry.write(values)
    assert entry.read() == {"lo": 70, "hi": 200, **values}
    assert told == []


def test_each_token_is_held_within_its_own_range() -> None:
    entry = paired(20, 150, ep.Param(0, 50, below="hi"), (100, 255))
    assert (entry.widget.min, entry.widget.max) == (0, 255)
    entry.widget.value = (80, 90)
    assert entry.read() == {"lo": 50, "hi": 100}


def test_each_token_keeps_its_type() -> None:
    entry = paired(np.uint8(7), np.uint8(9), ep.Param(0, 20, below="hi"), (0, 20))
    entry.widget.value = (6, 12)
    values = entry.read()
    assert values == {"lo": 6, "hi": 12}
    assert (type(values["lo"]), type(values["hi"])) == (np.uint8, np.uint8)


@pytest.mark.parametrize(
    ("lo", "hi", "low", "high"),
    [
        (9, 3, ep.Param(0, 10, below="hi"), (0, 10)),
        (3, 5, ep.Param(0, 10, below="lo"), (0, 10)),
        (3, None, ep.Param(0, 10, below="hi"), [None, 5]),
        (3, 5.0, ep.Param(0, 10, below="hi"), (0, 10)),
    ],
)
def test_a_hint_of_a_pair_that_can_be_none_is_refused(lo: Any, hi: Any, low: ep.Param, high: Any) -> None:
    with pytest.raises(ValueError, match="'lo' .* is hinted to stay below"):
        controls(runner_of(lo=lo, hi=hi), {"lo": low, "hi": high})


def test_tokens_that_are_no_pair_get_a_control_each() -> None:
    made = controls(runner_of(lo="a", hi="b"), {"lo": ["a", "b"], "hi": ["a", "b"]})
    assert [entry.names for entry in made] == [("lo",), ("hi",)]


def test_a_token_is_in_one_pair_only() -> None:
    hints = {"a": ep.Param(0, 9, below="b"), "b": ep.Param(0, 9, below="c"), "c": (0, 9)}
    with pytest.raises(ValueError, match="in no other pair"):
        controls(runner_of(a=1, b=2, c=3), hints)


PLACES = st.tuples(st.floats(-20, 300), st.floats(-20, 300)).map(lambda pair: tuple(sorted(pair)))
LOWS = st.sampled_from(
    [ep.Param(0, 255, below="hi"), ep.Param(50, 100, 7, below="hi"), ep.Param(0.0, 255.0, below="hi")]
)
HIGHS = st.sampled_from([ep.Param(0, 255), ep.Param(0, 80), ep.Param(1, 101, odd=True), ep.Param(0.0, 255.0, 0.3)])
VALUES = st.one_of(st.integers(0, 255).map(lambda value: ("write", value)), PLACES.map(lambda places: ("move", places)))


@pytest.mark.slow
@given(LOWS, HIGHS, st.lists(VALUES, max_size=12), st.booleans())
def test_whatever_is_moved_and_written_the_two_stay_in_order_and_range(
    low: ep.Param, high: ep.Param, events: list[Any], as_floats: bool
) -> None:
    lo, hi = (55.5, 71.0) if as_floats and not high.odd else (55, 71)
    entry = paired(lo, hi, low, high)
    assert entry.kind == "range"
    shadow = entry.read()
    entry.on_change(shadow.update)
    for kind, what in events:
        if kind == "move":
            entry.widget.value = what
        else:
            for values in ({"lo": what}, {"hi": what}):
                try:
                    entry.write(values)
                except ValueError:
                    continue
                shadow |= values
        values = entry.read()
        assert values["lo"] <= values["hi"]
        assert low.allows(values["lo"])
        assert high.allows(values["hi"])
        assert values == shadow


def test_a_hand_that_moves_in_the_middle_of_a_write_is_heard() -> None:
    entry = paired(70, 200)
    told = moves(entry)
    hands: list[threading.Thread] = []

    def interfere(_change: object) -> None:
        if not hands:
            hands.append(threading.Thread(target=setattr, args=(entry.widget, "value", (90, 210))))
            hands[0].start()
            while entry.widget.value != (90, 210):  # it is heard only when the write is over
                pass

    entry.widget.observe(interfere, "value")
    entry.write({"lo": 80})
    hands[0].join(60)
    assert (entry.read(), told) == ({"lo": 90, "hi": 210}, [{"lo": 90, "hi": 210}])
