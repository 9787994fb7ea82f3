"""With check_mutation, a function that changes an object inside its input is named, and what it changed is put back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import EpypesError, InputMutated, PromotionRefused


class Shape:
    def __init__(self):
        self.points = [1, 2]


def set_item(x, key, value):
    x[key] = value


DEEP = {
    "a list in a list": (lambda: [[1, 2]], lambda x: x[0].append(3)),
    "a list in a tuple": (lambda: ([1, 2],), lambda x: x[0].append(3)),
    "a list in a dict": (lambda: {"a": [1, 2]}, lambda x: x["a"].append(3)),
    "an array in a list of lists": (lambda: [[np.zeros(2)]], lambda x: set_item(x[0][0], 0, 1)),
    "an attribute": (Shape, lambda x: setattr(x, "points", [])),
    "a list in an attribute": (Shape, lambda x: x.points.append(3)),
    "a key point": (lambda: [cv2.KeyPoint(1, 2, 3)], lambda x: setattr(x[0], "size", 9.0)),
    "a match": (lambda: [cv2.DMatch(1, 2, 3)], lambda x: setattr(x[0], "queryIdx", 9)),
    "an object in an array": (lambda: np.array([[1], None], object), lambda x: x[0].append(3)),
}


def read(value):
    """Return all that a value holds as a text."""
    if isinstance(value, list) and isinstance(value[0], cv2.KeyPoint | cv2.DMatch):
        return repr([(getattr(one, "size", 0), getattr(one, "queryIdx", 0)) for one in value])
    return repr(value.points if isinstance(value, Shape) else value)


def graph(spoil, make=None):
    cg = ep.CompGraph(
        {"spoil": lambda x, k: spoil(x) if k else None, "read": lambda x, k: read(x)},
        {"spoil": (("x", "k"), "none"), "read": (("x", "k"), "seen")},
    )
    return cg if make is None else cg | ep.CompGraph({"make": lambda n: make()}, {"make": ("n", "x")})


def test_an_iterator_inside_an_input_that_is_read_names_function_and_token():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: list(x[0])}, {"f": ("x", "y")}), check_mutation=True)
    with pytest.raises(InputMutated, match=r"'f' has read an iterator inside its input 'x', .* Make it a list"):
        runner.run(x=[map(int, "12")])


@pytest.mark.parametrize("deep", DEEP)
def test_a_change_deep_inside_an_input_names_function_and_token_and_is_put_back(way, deep):
    make, spoil = DEEP[deep]
    expected = read(make())
    for how in ("made", "payload", "hyperparameter"):
        hparams = {"x": make()} if how == "hyperparameter" else {}
        payload = {"made": {"n": 0}, "payload": {"x": make()}}.get(how, {})
        cg = graph(spoil, make if how == "made" else None)
        runner = ep.CompGraphRunner(cg, {"k": 0, **hparams}, check_mutation=True)
        for _ in range(way.runs):
            assert runner.run(**payload)["seen"] == expected
        for _ in range(2):
            with pytest.raises(InputMutated, match="'spoil' has changed its input 'x'") as error:
                runner.rerun(k=1)
            assert (error.value.function, error.value.token) == ("spoil", "x")
            assert isinstance(error.value, EpypesError)
            assert runner.last.failure.function == "spoil"
            assert runner.rerun(k=0)["seen"] == expected == read(runner["x"])


def test_what_a_function_that_fails_had_changed_is_put_back_and_its_own_error_stays():
    def spoil(x):
        x[0].append(3)
        raise ArithmeticError("its own")

    runner = ep.CompGraphRunner(graph(spoil), {"k": 1}, check_mutation=True)
    with pytest.raises(ArithmeticError, match="its own"):
        runner.run(x=[[1]])
    assert runner["x"] == [[1]]


def test_what_functions_may_do_is_not_refused(way):
    class Counter:
        def __init__(self):
            self.count = 0

    own = Counter()

    @ep.unguarded
    def look(image):
        own.count += 1  # its own affair, nothing of its inputs
        return image.sum()

    cg = ep.CompGraph(
        {
            "sort": lambda xs: (xs.sort(), xs)[1],
            "drop": lambda table: (table.pop("a"), len(table))[1],
            "look": look,
            "pass": lambda xs: xs,
        },
        {"sort": ("xs", "sorted"), "drop": ("table", "left"), "look": ("image", "sum"), "pass": ("xs", "same")},
    )
    runner = ep.CompGraphRunner(cg, workers=2, check_mutation=True)
    for _ in range(way.runs):
        run = runner.run(xs=[3, 1], table={"a": 1, "b": 2}, image=np.ones(3))
        assert (run["sorted"], run["left"], run["sum"], run["same"]) == ([1, 3], 1, 3, [3, 1])


def test_an_unguarded_function_that_writes_is_found():
    @ep.unguarded
    def write(image):
        image[0] = 9

    cg = ep.CompGraph({"make": np.ones, "write": write}, {"make": ("n", "image"), "write": ("image", None)})
    runner = ep.CompGraphRunner(cg, {"n": 3}, check_mutation=True)
    with pytest.raises(InputMutated, match="'write' has changed its input 'image'"):
        runner.run()
    assert runner["image"].tolist() == [1, 1, 1]


def test_without_it_nothing_is_looked_at():
    given = [[1]]
    ep.CompGraphRunner(graph(lambda x: x[0].append(2)), {"k": 1}).run(x=given)
    assert given == [[1, 2]]


def grow(rows, k):
    rows[0].append(k)
    return len(rows[0])


def test_promotion_refuses_a_function_that_changes_an_object_inside_its_input(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"grow": grow}, {"grow": (("rows", "k"), "count")}), {"k": 1})
    runner.run(rows=[[1]])
    with pytest.raises(PromotionRefused, match="'grow' has changed its input 'rows'"):
        ep.promote(runner, tmp_path / "grow")
