from __future__ import annotations

import abc
import collections.abc
import enum
import functools
import numbers
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, TypedDict, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

import epypes as ep
from epypes.errors import GraphError
from epypes.graph.type_check import are_disjoint

T = TypeVar("T")


class Circle:
    pass


class Square:
    pass


class Round:
    pass


class Disc(Circle, Round):
    pass


class Shape(abc.ABC):
    @abc.abstractmethod
    def area(self): ...


class Drawn(Protocol):
    def draw(self): ...


class Table(TypedDict):
    x: int


class Colour(enum.Enum):
    RED = 1


Metres = typing.NewType("Metres", float)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (int, str), (np.ndarray, int), (str, np.ndarray), (None, int), (list[int], dict[str, int]), (tuple, list),
        (Circle, Square), (Colour, str), (Path, str), (typing.Optional[int], str),  # noqa: UP045
        (typing.Union[int, str], list[int] | tuple),  # noqa: UP007
        (Literal["a"], int), (Literal["a", "b"], Literal[2]), (Literal[Colour.RED], int),
        (Annotated[int, "pixels"], str), (Annotated[int | None, 1], Annotated[str, 2]),
        (NDArray[np.uint8], NDArray[np.float64]), (NDArray[np.float32], NDArray[np.float64]), (NDArray[np.uint8], str),
        (np.float64, str), (bytes, str),
    ],
)  # fmt: skip
def test_types_without_a_common_value_are_told_apart(left, right):
    assert are_disjoint(left, right)
    assert are_disjoint(right, left)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (int, int), (bool, int), (int, float), (float, complex), (int, object), (Any, int), (T, int), (Circle, Drawn),
        (Shape, Circle), (Circle, Disc), (Circle, Round), (Table, dict), (Table, list), (Metres, str), (int | None, None),
        (int | str, str | None), (Literal["a"], str), (Literal["a", 1], Literal[1]), (Literal[1], float), (list[int], list[str]),
        (list[int], collections.abc.Sequence), (tuple[int, int], tuple[int, ...]), (np.uint8, int), (np.float64, float),
        (np.float32, int), (np.bool_, bool), (np.float32, np.float64), (numbers.Integral, int), (bytes, bytearray),
        (NDArray[np.uint8], np.ndarray), (NDArray[np.uint8], NDArray[np.uint8]), (NDArray[np.uint8], NDArray[Any]),
        (NDArray[np.uint8], NDArray[np.integer]), (NDArray[np.floating], NDArray[np.integer]),
        (NDArray[np.longlong], NDArray[np.int64]), (collections.abc.Callable[[], int], Circle), ("no type", int),
        (typing.Never, int), (type[int], type),
    ],
)  # fmt: skip
def test_types_that_may_have_a_common_value_are_let_pass(left, right):
    assert not are_disjoint(left, right)
    assert not are_disjoint(right, left)


def made(x) -> str:
    return str(x)


def takes_int(y: int):
    return y


def takes_str(y: str):
    return y


IO = {"f": ("x", "y"), "g": ("y", "z")}


def test_a_token_made_as_one_type_and_taken_as_another_is_refused_with_all_names():
    with pytest.raises(GraphError) as error:
        ep.CompGraph({"f": made, "g": takes_int}, IO)
    assert str(error.value) == (
        "Function 'f' makes token 'y' as str, but 'g' takes it as int, and no value is both. "
        "Change one of the annotations, or build the graph with types=False."
    )
    (finding,) = error.value.findings
    assert (finding.kind, finding.names) == ("types", ("y", "f", "g"))


def test_types_false_asks_nothing_and_algebra_stays_lenient():
    cg = ep.CompGraph({"f": made, "g": takes_int}, IO, types=False)
    other = ep.CompGraph({"h": takes_int}, {"h": ("y", "w")})
    for same in (cg | other, other | cg, ep.suffix(cg, "_1"), ep.rename(cg), ep.subgraph(cg, "z"), ep.extend(cg, {})):
        assert same.types is False
    with pytest.raises(GraphError, match="and no value is both"):
        ep.CompGraph({"f": made}, {"f": ("x", "y")}) | other
    ep.CompGraph.from_functions(made, takes_int, types=False)


def test_two_consumers_need_not_agree():
    ep.CompGraph({"g": takes_int, "h": takes_str}, {"g": ("y", "z"), "h": ("y", "w")})


@pytest.mark.parametrize(
    ("returned", "fits"),
    [(tuple[str, int], True), (tuple[int, str], False), (tuple[int, ...], True), (tuple[str, ...], False),
     (tuple[str, int, int], False), (tuple, True), (list[str], True), (Annotated[tuple[int, str], 1], False)],
)  # fmt: skip
def test_a_tuple_is_split_over_the_output_tokens(returned, fits):
    def f(x):
        return x

    f.__annotations__ = {"return": returned}
    functions, io = {"f": f, "g": takes_int}, {"f": ("x", ("w", "y")), "g": ("y", "z")}
    if fits:
        ep.CompGraph(functions, io)
    else:
        with pytest.raises(GraphError) as error:
            ep.CompGraph(functions, io)
        assert [finding.kind for finding in error.value.findings] == ["types"]


def test_variadic_parameters_speak_for_every_input_that_they_take():
    def stack(first: str, *others: int) -> str:
        return first

    io = {"f": ("x", "y"), "stack": (("a", "b", "y"), "z")}
    with pytest.raises(GraphError, match="'f' makes token 'y' as str, but 'stack' takes it as int"):
        ep.CompGraph({"f": made, "stack": stack}, io)
    ep.CompGraph({"f": made, "stack": stack}, {"f": ("x", "y"), "stack": (("y", "b"), "z")})


def test_a_tuple_of_another_length_than_the_outputs_is_named():
    def f(x) -> tuple[int, int, int]:
        return x, x, x

    with pytest.raises(GraphError, match=r"'f' returns tuple\[int, int, int\], 3 values, but its io names 2 outputs"):
        ep.CompGraph({"f": f}, {"f": ("x", ("a", "b"))})
    ep.CompGraph({"f": f}, {"f": ("x", "whole")})
    ep.CompGraph({"f": f}, {"f": ("x", None)})


def test_annotations_that_cannot_be_resolved_are_let_pass():
    def unknown(y: NotThere) -> AlsoNotThere:  # noqa: F821
        return y

    def broken(y: 1 / 0):
        return y

    ep.CompGraph({"f": made, "g": unknown}, IO)
    ep.CompGraph({"f": made, "g": broken}, IO)


def test_the_annotations_of_a_class_are_not_those_of_a_call():
    class Settings:
        y: int

        def __call__(self, y):
            return y

    ep.CompGraph({"f": made, "g": Settings()}, IO)


def test_methods_nodes_and_wrapped_functions_are_asked_too():
    class Camera:
        def shot(self, y: int):
            return y

    @functools.wraps(takes_int)
    def wrapped(*args):
        return takes_int(*args)

    for function in (Camera().shot, ep.Node("n", takes_int), wrapped):
        with pytest.raises(GraphError, match="'g' takes it as int"):
            ep.CompGraph({"f": made, "g": function}, IO)


def test_types_are_reported_beside_every_other_problem():
    with pytest.raises(GraphError) as error:
        ep.CompGraph({"f": made, "g": takes_int, "h": takes_str}, {**IO, "h": 3, "k": ("a", "b")})
    assert {finding.kind for finding in error.value.findings} == {"types", "bad io", "no function"}


@pytest.mark.parametrize("place", [1, 50, 100])
def test_one_function_that_does_not_fit_is_found_among_many(place):
    def add_one(x: int) -> int:
        return x + 1

    def as_text(x: int) -> str:
        return str(x)

    def split(x: int) -> tuple[int, int, int]:
        return x, x, x

    names = [f"f{index}" for index in range(101)]
    io = {name: (f"t{index}", f"t{index + 1}") for index, name in enumerate(names)}
    fits = dict.fromkeys(names, add_one)
    ep.CompGraph(fits, io)
    ep.CompGraph(fits | {names[-1]: as_text}, io)
    with pytest.raises(GraphError, match=f"makes token 't{place}' as str, but 'f{place}' takes it as int"):
        ep.CompGraph(fits | {names[place - 1]: as_text}, io)
    with pytest.raises(GraphError, match="3 values, but its io names 2"):
        ep.CompGraph(fits | {names[place]: split}, io | {names[place]: (f"t{place}", (f"t{place + 1}", "more"))})
