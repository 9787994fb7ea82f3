from __future__ import annotations

import json
import math

import numpy as np
import pytest

from epypes.bundle.settings import Member, decode_value, read_settings
from epypes.errors import BundleError
from epypes.service.parameters import changed_entries, entries_of, misfits, type_of, value_of

ENTRIES = {
    "side": {"value": 5, "low": 1, "high": 31, "odd": True, "unit": "px"},
    "step": {"value": 4, "low": 0, "high": 10, "step": 2},
    "share": {"value": 0.5, "low": 0.0, "high": 1.0, "step": 0.1},
    "whole": {"value": 1, "low": 0.0, "high": 2.0},
    "sigma": {"value": 1.5},
    "name": {"value": "canny", "choices": ["canny", "sobel"]},
    "flag": {"value": True},
    "size": {"value": [3, 3], "kind": "tuple"},
    "list": {"value": [1, 2]},
    "mask": {"kind": "none"},
    "kind": {"value": 1, "choices": [1, 2]},
    "open": {"value": 2, "high": 9},
    "byte": {"value": 7, "kind": "numpy", "dtype": "uint8"},
    "single": {"value": 0.5, "kind": "numpy", "dtype": "float32"},
    "border": {"value": [1, 1], "kind": "tuple", "choices": [{"value": [1, 1], "kind": "tuple"}, {"kind": "none"}]},
    "mode": {"value": "FAST", "kind": "enum", "enum": "Mode"},
    "table": {"value": {"a": 1}},
    "array": {"value": [1, 2], "kind": "array", "dtype": "int64"},
}


@pytest.mark.parametrize(
    ("token", "name"),
    [("side", "int"), ("share", "float"), ("whole", "float"), ("sigma", "float"), ("name", "text"), ("flag", "bool"),
     ("size", "list"), ("mask", "none"), ("byte", "int"), ("single", "float"), ("table", "other")],
)  # fmt: skip
def test_an_entry_says_which_type_its_value_has_also_where_json_does_not(token, name):
    assert type_of(ENTRIES[token]) == name
    assert type_of({"value": 1.0}) == "float"


@pytest.mark.parametrize(
    ("token", "given", "value"),
    [
        ("side", 7, 7), ("side", 7.0, 7), ("step", 6, 6), ("share", 0.3, 0.3), ("share", 1, 1.0), ("whole", 1.5, 1.5),
        ("sigma", 2, 2.0), ("name", "sobel", "sobel"), ("flag", False, False), ("size", [5, 7], (5, 7)),
        ("list", [3, 4], [3, 4]), ("mask", None, None), ("mask", 3, 3), ("kind", 2, 2), ("open", -100, -100),
        ("byte", 9, np.uint8(9)), ("single", 1, np.float32(1)), ("border", [1, 1], (1, 1)),
        ("mode", "SLOW", Member("Mode", "SLOW")),
    ],
)  # fmt: skip
def test_a_value_within_its_range_is_taken_as_the_kind_it_was(token, given, value):
    after, problems = changed_entries(ENTRIES, {token: given})
    assert not problems
    found = decode_value(after[token])
    assert (found, type(found)) == (value, type(value))
    assert {"value", "kind"} | after[token].keys() == {"value", "kind"} | ENTRIES[token].keys()
    assert {name: entry for name, entry in after.items() if name != token} == {
        name: entry for name, entry in ENTRIES.items() if name != token
    }
    json.dumps(after, allow_nan=False)


@pytest.mark.parametrize(
    ("token", "given", "text"),
    [
        ("side", 6, "odd"), ("side", 33, "from 1 to 31"), ("side", 5.5, "whole number"), ("side", True, "true or false"),
        ("side", "5", "a text"), ("side", None, "null"), ("step", 3, "steps of 2"), ("share", 0.35, "steps of 0.1"),
        ("share", math.nan, "can't be nan"), ("sigma", math.inf, "can't be inf"), ("name", "prewitt", "There are: 'canny'"),
        ("name", 1, "There are"), ("flag", 1, "a whole number"), ("size", [5], "has 2 items"), ("size", 5, "a list"),
        ("size", [[1], 2], "can't be"), ("kind", True, "There are: 1, 2"), ("open", 10, "up to 9"), ("sid", 5, "Did you mean 'side'"),
        ("sigma", {"value": 1}, "can't be"), ("sigma", 10**400, "can't be"), ("mask", 10**30, "can't be"),
        ("byte", 1.5, "whole number"), ("border", [2, 1], "There are"), ("mode", 3, "is a text"), ("table", {"a": 2}, "Promote"),
        ("array", [1, 3], "Promote again"),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_is_refused_with_the_reason(token, given, text):
    after, problems = changed_entries(ENTRIES, {"sigma": 9.0, token: given})
    assert not after, "nothing is changed"
    assert list(problems) == [token]
    assert text in problems[token]
    assert repr(token) in problems[token]


def test_entries_are_json_ready_whatever_the_file_says(tmp_path):
    file = tmp_path / "pipeline.toml"
    head = '[bundle]\nformat = 1\nname = "b"\n[ports]\ninputs = []\noutputs = ["y"]\n'
    file.write_text(head + "[hyperparameters.k]\nvalue = 1.0\nlow = -inf\nhigh = 3\nsoft = [0, inf]\n")
    assert entries_of(read_settings(file)) == {"k": {"value": 1.0, "high": 3}}
    for text in ("[", f"{head}[hyperparameters]\nk = 3"):
        file.write_text(text)
        with pytest.raises(BundleError, match="can't be read"):
            read_settings(file)


GIVEN = {
    "side": 7,
    "step": 6,
    "share": 1,
    "whole": 1.5,
    "sigma": 2,
    "name": "sobel",
    "flag": False,
    "size": [4, 5],
    "mask": [1, 2],
    "byte": 8,
    "single": 0.25,
    "border": [1, 1],
    "mode": "SLOW",
}


@pytest.mark.parametrize("token", GIVEN)
def test_what_a_change_has_made_of_an_entry_fits_it(token):
    after, problems = changed_entries(ENTRIES, {token: GIVEN[token]})
    assert not problems
    values = json.loads(json.dumps({name: value_of(entry) for name, entry in after.items()}))
    assert misfits(ENTRIES, values) == {}


@pytest.mark.parametrize(
    ("token", "value"),
    [
        ("side", {"value": 8}),
        ("side", {"value": 33}),
        ("side", {"value": True}),
        ("side", {"value": {"kind": "enum", "enum": "Mode", "value": "FAST"}}),
        ("side", {"value": 5, "kind": "numpy", "dtype": "uint8"}),
        ("side", {}),
        ("sigma", {"value": math.nan}),
        ("sigma", {"value": math.inf}),
        ("sigma", {"value": "x", "kind": "nan"}),
        ("size", {"value": [3, 3]}),
        ("size", {"value": [3, 3, 3], "kind": "tuple"}),
        ("byte", {"value": 7, "kind": "numpy", "dtype": "uint16"}),
        ("mode", {"value": "FAST", "kind": "enum", "enum": "Other"}),
        ("table", {"value": {"b": 1}}),
        ("name", {"value": "blur"}),
    ],
)
def test_what_no_change_can_make_of_an_entry_does_not_fit_it(token, value):
    assert list(misfits(ENTRIES, {token: value})) == [token]
    assert misfits(ENTRIES, {"elsewhere": value}) == {}
