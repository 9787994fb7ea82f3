"""What stands in pipeline.toml comes back to the last bit, with the ranges that a service needs."""

from __future__ import annotations

import enum
import json
import math
import struct
import tomllib
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import epypes as ep
from epypes.bundle.settings import (
    MOST_NUMBERS,
    Member,
    Settings,
    Unwritable,
    cast_like,
    decode_value,
    encode_value,
    fits,
    read_settings,
    unwritable,
    write_settings,
)
from epypes.errors import BundleError
from epypes.graph import ColourOrder


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


CG = ep.CompGraph({"f": lambda k: k}, {"f": ("k", "y")})
HASHABLE = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary(max_size=9), st.complex_numbers(),
    st.sampled_from(Method),
)  # fmt: skip
DTYPES = st.one_of(arrays.floating_dtypes(sizes=(16, 32, 64)), arrays.integer_dtypes(), arrays.boolean_dtypes())
SHAPES = arrays.array_shapes(min_dims=0, min_side=0, max_side=4)
NUMBERS = st.one_of(*(arrays.from_dtype(np.dtype(kind)) for kind in ("f4", "u8", "f8", "?", "i2")))
VALUES = st.recursive(
    st.one_of(HASHABLE, arrays.arrays(DTYPES, SHAPES), NUMBERS),
    lambda part: st.one_of(
        st.lists(part, max_size=3), st.lists(part, max_size=3).map(tuple), st.frozensets(HASHABLE, max_size=3),
        st.dictionaries(st.text(max_size=5), part, max_size=3), st.dictionaries(HASHABLE, part, max_size=3),
    ),
    max_leaves=6,
)  # fmt: skip


def bits(value):
    """Return what tells any two values apart, also 0.0 from -0.0; a number that is NaN may have any bits of a NaN."""
    if isinstance(value, np.ndarray | np.generic):
        numbers = np.array(value, ndmin=1)
        if numbers.dtype.kind in "fc":
            parts = numbers.view(numbers.real.dtype)
            parts[np.isnan(parts)] = math.nan
        return type(value), str(value.dtype), value.shape, numbers.tobytes()
    if type(value) in (float, complex):
        whole = complex(value)
        parts = (math.nan if part != part else part for part in (whole.real, whole.imag))
        return type(value), struct.pack("dd", *parts)
    if type(value) in (list, tuple):
        return type(value), [bits(item) for item in value]
    if type(value) in (set, frozenset):
        return type(value), sorted(repr(bits(item)) for item in value)
    if type(value) is dict:
        return dict, [(bits(key), bits(item)) for key, item in value.items()]
    return type(value), value


def test_the_orders_of_colours_come_back_with_what_says_them(tmp_path):
    path = tmp_path / "pipeline.toml"
    colours = {"x": ColourOrder("rgb", "gray"), "y": ColourOrder("bgr")}
    write_settings(path, Settings("b", ("x",), ("y",), {}, colours), CG)
    assert (found := read_settings(path)).colours == colours
    assert (found.order("x"), found.order("y"), found.order("z"), found.rgb) == ("rgb", "bgr", "bgr", ("x",))
    assert [found.colour(token).is_assumed for token in ("x", "y", "z")] == [False, True, True]
    assert 'order = "bgr"  # assumed\n' in path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('order = "rgb"', 'order = "rbg"', "the order of the colours of 'x' is 'rbg', not bgr or rgb"),
        ("[ports]", '[ports]\nrgb = ["x"]', "its orders of colours stand under .ports., where an older EPypes"),
    ],
)
def test_orders_of_colours_that_cannot_be_read_are_refused(tmp_path, old, new, text):
    path = tmp_path / "pipeline.toml"
    write_settings(path, Settings("b", ("x",), ("y",), {}, {"x": ColourOrder("rgb", "gray")}), CG)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(BundleError, match=text):
        read_settings(path)


@pytest.mark.slow
@pytest.mark.fuzz
@given(VALUES)
@example({"kind": "tuple", "value": [1]})
@example({"": {"kind": None}, "a.b": "\x00\x7f\r\n\t\\\"'''"})
@example([-0.0, float("inf"), -float("nan"), 2**63, -(2**63)])
@example(np.array([[1, 2]], ">i4"))
def test_any_value_comes_back_to_the_last_bit(tmp_path_factory, value):
    if not fits(value):
        return
    path = tmp_path_factory.getbasetemp() / "pipeline.toml"
    write_settings(path, Settings("x", (), ("y",), {"k": value}, {}, attributes={"a": value}), CG)
    found = read_settings(path, {"Method": Method})
    assert bits(found.hyperparameters["k"]) == bits(value)
    assert bits(found.attributes["a"]) == bits(value)
    json.dumps(dict(found.entries["k"]))


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        (70, {"value": 70}),
        ("edges", {"value": "edges"}),
        ([1, 2.5], {"value": [1, 2.5]}),
        ({"a": 1}, {"value": {"a": 1}}),
        (None, {"kind": "none"}),
        ((3, (5, None)), {"value": [3, {"value": [5, {"kind": "none"}], "kind": "tuple"}], "kind": "tuple"}),
        (np.float32(0.1), {"value": 0.1, "kind": "numpy", "dtype": "float32"}),
        (np.eye(2, dtype=np.uint8), {"value": [[1, 0], [0, 1]], "kind": "array", "dtype": "uint8"}),
        (np.array([0.1], np.float32), {"value": [0.1], "kind": "array", "dtype": "float32"}),
        (Method.SOBEL, {"value": "SOBEL", "kind": "enum", "enum": "Method"}),
    ],
)
def test_an_entry_is_what_a_person_would_write(value, entry):
    assert encode_value(value) == entry


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.zeros(MOST_NUMBERS + 1), "an array of 401 numbers"),
        (np.array([None]), "an array of object"),
        (object(), "a object"),
        ([object()], "a object"),
        ("\ud800", "half a character"),
    ],
)
def test_what_no_entry_holds_is_refused_with_the_way_out(value, words):
    with pytest.raises(Unwritable, match=words):
        encode_value(value)
    (reason,) = unwritable({"k": value})
    assert reason.startswith("Hyperparameter 'k' is ")
    assert reason.endswith("or unfreeze it and pass it to run().")


def test_a_number_in_the_place_of_another_is_of_its_kind():
    assert bits(cast_like(encode_value(np.float32(0.5)), 0.1)) == bits(np.float32(0.1))
    assert bits(cast_like(encode_value(3), np.int64(4))) == bits(4)


def test_a_value_that_holds_itself_is_refused():
    value: list = []
    value.append(value)
    assert not fits(value)


def test_without_the_module_a_member_is_known_by_its_names():
    assert decode_value(encode_value((Method.CANNY,))) == (Member("Method", "CANNY"),)


@pytest.mark.parametrize("entry", [{}, {"kind": "pickle", "value": "x"}, {"kind": ["tuple"], "value": []}])
def test_entries_that_make_no_sense_raise(entry):
    with pytest.raises((KeyError, TypeError)):
        decode_value(entry)


def test_a_matrix_stands_in_rows(tmp_path):
    kernel = np.array([[0.1, 0.2, 0.1]] * 2, np.float32)
    write_settings(tmp_path / "p.toml", Settings("x", (), ("y",), {"k": kernel}), CG)
    text = (tmp_path / "p.toml").read_text()
    assert "value = [\n    [0.1, 0.2, 0.1],\n    [0.1, 0.2, 0.1],\n]\n" in text
    assert tomllib.loads(text)["hyperparameters"]["k"]["dtype"] == "float32"


def cut(
    image: Any,
    part: Annotated[tuple, ep.Roi("image")],
    level: Annotated[int, ep.Param(0, 255, unit="DN", soft=(0, 100), cuts="image", about="What counts as bright.")],
    how: Annotated[int, ep.Param(choices=(0, 1), labels=("FAST", "EXACT"))],
) -> Any:
    return image


def test_ranges_and_their_texts_are_written_and_what_only_a_picture_needs_is_left_out(tmp_path):
    cg = ep.CompGraph.from_functions(cut)
    values = {"part": (1, 2, 30, 40), "level": 100, "how": 1}
    write_settings(tmp_path / "pipeline.toml", Settings("cut", ("image",), ("cut",), values), cg)
    entries = tomllib.loads((tmp_path / "pipeline.toml").read_text())["hyperparameters"]
    assert entries == {
        "part": {"value": [1, 2, 30, 40], "kind": "tuple"},
        "level": {
            "value": 100, "low": 0, "high": 255, "soft": [0, 100], "unit": "DN", "about": "What counts as bright.",
        },
        "how": {"value": 1, "choices": [0, 1], "labels": ["FAST", "EXACT"]},
    }  # fmt: skip
    assert read_settings(tmp_path / "pipeline.toml").hyperparameters == values


def test_nothing_is_a_value_of_its_own():
    assert encode_value(ep.Nothing) == {"kind": "nothing"}
    assert decode_value({"kind": "nothing"}) is ep.Nothing
    assert decode_value(encode_value([1, ep.Nothing, (ep.Nothing, None)])) == [1, ep.Nothing, (ep.Nothing, None)]
