from __future__ import annotations

from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import ContractBroken, GraphError, UnknownName
from epypes.graph import colour_order

RGB, BGR, UNSAID = ep.Image(order="rgb"), ep.Image(order="bgr"), ep.Image("uint8")


def load(path) -> Annotated[np.ndarray, RGB]: ...
def measure(image: Annotated[np.ndarray, UNSAID]) -> Annotated[np.ndarray, UNSAID]: ...
def show_bgr(image: Annotated[np.ndarray, BGR]): ...
def show_rgb(image: Annotated[np.ndarray, RGB]): ...
def both(image) -> tuple[Annotated[np.ndarray, RGB], Annotated[np.ndarray, BGR]]: ...
def plain(image): ...


def graph(**functions):
    return ep.CompGraph(
        {name: f for name, (f, _) in functions.items()}, {name: io for name, (_, io) in functions.items()}
    )


def test_the_function_that_makes_a_token_says_its_colours():
    cg = graph(load=(load, ("path", "image")), plain=(plain, ("image", "out")))
    assert cg.contracts == {"load": ((None,), (RGB,))}
    assert [colour_order(cg, token) for token in cg.tokens] == ["bgr", "rgb", "bgr"]


def test_without_it_those_that_take_the_token_say_them():
    cg = graph(plain=(plain, ("image", "a")), measure=(measure, ("image", "b")), show=(show_rgb, ("image", "c")))
    assert cg.contracts == {"measure": ((UNSAID,), (UNSAID,)), "show": ((RGB,), (None,))}
    assert [colour_order(cg, token) for token in ("image", "a", "b", "c")] == ["rgb", "bgr", "bgr", "bgr"]


def test_a_mark_without_order_leaves_the_order_to_those_that_take_the_token():
    cg = graph(measure=(measure, ("raw", "image")), show=(show_rgb, ("image", "c")))
    assert colour_order(cg, "image") == "rgb"


def test_several_outputs_have_a_mark_each():
    cg = graph(both=(both, ("image", ("left", "right"))))
    assert [colour_order(cg, token) for token in ("left", "right")] == ["rgb", "bgr"]


def test_a_token_that_is_not_there_has_no_colours():
    with pytest.raises(UnknownName, match="Did you mean 'image'"):
        colour_order(graph(plain=(plain, ("image", "out"))), "imag")


@pytest.mark.parametrize(
    ("functions", "text", "names"),
    [
        (
            {"show": (show_bgr, ("image", "out")), "load": (load, ("path", "image"))},
            "Function 'load' makes token 'image' as rgb, but 'show' takes it as bgr. Convert it in a function between "
            "them: cv2.cvtColor(image, cv2.COLOR_RGB2BGR).",
            ("image", "load", "show"),
        ),
        (
            {"a": (show_bgr, ("image", "x")), "b": (show_rgb, ("image", "y"))},
            "Function 'a' takes token 'image' as bgr, but 'b' takes it as rgb. Convert it in a function before 'b': "
            "cv2.cvtColor(image, cv2.COLOR_BGR2RGB).",
            ("image", "a", "b"),
        ),
    ],
)  # fmt: skip
def test_two_orders_of_one_token_are_refused(functions, text, names):
    with pytest.raises(GraphError) as error:
        graph(**functions)
    (finding,) = error.value.findings
    assert (finding.kind, finding.text, finding.names) == ("colour", text, names)


def test_colours_are_told_together_with_what_else_is_wrong():
    with pytest.raises(GraphError) as error:
        graph(load=(load, ("path", "image")), show=(show_bgr, ("image", "path")), odd=(plain, (("a", "b"), "c")))
    assert sorted(finding.kind for finding in error.value.findings) == ["arity", "colour", "cycle"]


def test_a_mark_that_says_no_order_disagrees_with_nobody():
    cg = graph(load=(load, ("path", "image")), measure=(measure, ("image", "out")), again=(show_rgb, ("image", "end")))
    assert colour_order(cg, "image") == "rgb"


@pytest.mark.parametrize(
    ("made", "taken", "fits"),
    [
        (ep.Image("uint8"), ep.Image("float32"), False),
        (ep.Image("uint8"), ep.Image(("float32", "uint8")), True),
        (ep.Image("uint8", ("h", "w")), ep.Image("uint8", ("h", "w", 3)), False),
        (ep.Image(shape=(480, "w")), ep.Image(shape=(640, None)), False),
        (ep.Image(shape=("h", 640)), ep.Image(shape=(480, None)), True),
        (ep.Image(range=(0, 1)), ep.Image(range=(2, 3)), False),
        (ep.Image(range=(0, 1)), ep.Image(range=(1, 3)), True),
        (ep.Image(), ep.Image("uint8", (1, 1), (0, 1)), True),
    ],
    ids=str,
)
def test_contracts_that_no_image_keeps_both_of_are_found_when_the_graph_is_made(made, taken, fits):
    def make(x):
        return x

    def take(image):
        return image

    make.__annotations__["return"] = made
    take.__annotations__["image"] = Annotated[np.ndarray, taken]
    functions, io = {"make": make, "take": take}, {"make": ("x", "image"), "take": ("image", "y")}
    ep.CompGraph(functions, io, types=False)
    if fits:
        ep.CompGraph(functions, io)
    else:
        with pytest.raises(GraphError, match="'make' makes token 'image' as .*, but 'take' takes it as .* no image is"):
            ep.CompGraph(functions, io)


def test_a_mark_may_stand_alone_as_the_annotation():
    def threshold(image: ep.Image("uint8", ("h", "w"))) -> ep.Image("uint8"):
        return image > 3

    runner = ep.CompGraphRunner(ep.CompGraph({"f": threshold}, {"f": ("image", "mask")}))
    with pytest.raises(ContractBroken, match="'f' takes token 'image' as uint8 \\(h, w\\)|bool"):
        runner.run(image=np.zeros((4, 4), np.uint8))
