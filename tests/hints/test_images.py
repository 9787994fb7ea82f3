from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import ContractBroken, EpypesError

RGB = ep.Image("uint8", ("h", "w", 3), order="rgb")
GRAY = ep.Image("uint8", (None, None))
UNIT = ep.Image(("float32", "float64"), range=(0, 1))


def gray(image: Annotated[np.ndarray, RGB], k: int = 3) -> Annotated[np.ndarray, GRAY]: ...


def split(a, b: Annotated[np.ndarray, UNIT]) -> tuple[Annotated[np.ndarray, GRAY], int, Annotated[np.ndarray, RGB]]: ...


def stack(*images: Annotated[np.ndarray, GRAY]) -> list[Annotated[np.ndarray, RGB]]: ...


def lost(image: Annotated[np.ndarray, NoSuchMark], other: Annotated[np.ndarray, RGB] = None): ...  # noqa: F821


def contracts_of(function, inputs, outputs):
    """The contracts of a function in a graph."""
    taken, made = (
        tuple(f"{side}{place}" for place in range(count)) for side, count in (("in", inputs), ("out", outputs))
    )
    cg = ep.CompGraph({"f": function}, {"f": (taken, made if outputs > 1 else (*made, None)[0])}, types=False)
    return cg.contracts.get("f", ((), ()))


def pixels(dtype, *shape, value=0):
    return np.full(shape, value, dtype)


@pytest.mark.parametrize(
    ("contract", "value", "wrong"),
    [
        (RGB, pixels(np.uint8, 480, 640, 3), None),
        (RGB, pixels(np.uint8, 480, 640), "uint8 480 x 640, expected uint8 (h, w, 3) rgb"),
        (GRAY, pixels(np.float64, 480, 640), "float64 480 x 640, expected uint8 (h, w)"),
        (RGB, pixels(np.uint8, 480, 640, 4), "uint8 480 x 640 x 4, expected uint8 (h, w, 3) rgb"),
        (RGB, [[1, 2]], "of type 'list', expected uint8 (h, w, 3) rgb"),
        (RGB, None, "of type 'NoneType', expected uint8 (h, w, 3) rgb"),
        (UNIT, pixels(np.float32, 2, 2, value=1), None),
        (UNIT, pixels(">f4", 2, 2, value=1), None),
        (UNIT, pixels(np.float64, 2, 2, value=1.5), "float64 2 x 2 from 1.5 to 1.5, expected float32 or float64 from 0 to 1"),
        (UNIT, pixels(np.float64, 2, 2, value=np.nan), "float64 2 x 2 with NaN, expected float32 or float64 from 0 to 1"),
        (UNIT, pixels(np.float64, 0, 2), None),
        (ep.Image(range=(0, 255)), pixels(np.uint8, 2, 2, value=255), None),
        (ep.Image(range=(0, 200)), pixels(np.uint8, 2, 2, value=201), "uint8 2 x 2 from 201 to 201, expected from 0 to 200"),
        (ep.Image(range=(-1, 127)), pixels(np.int8, 2, 2, value=-2), "int8 2 x 2 from -2 to -2, expected from -1 to 127"),
        (ep.Image(range=(0, 1)), pixels(np.complex64, 2), "complex64 2 without a range, expected from 0 to 1"),
        (ep.Image(shape=(4,)), np.uint8(3), "uint8 without axes, expected (4,)"),
        (ep.Image(order="rgb"), pixels(np.int64, 7), None),
        (ep.Image(), pixels(np.int64, 7), None),
        (ep.Image(), 7, "of type 'int', expected array"),
    ],
)  # fmt: skip
def test_a_contract_says_what_is_wrong_with_a_value(contract, value, wrong):
    assert contract.findings(value) == wrong


def test_only_a_declared_range_is_looked_for():
    class Untouchable(np.ndarray):
        def min(self, *args, **kwargs):
            raise AssertionError("the values were looked at")

    image = pixels(np.float64, 4, 4).view(Untouchable)
    assert ep.Image("float64", (4, 4)).findings(image) is None
    with pytest.raises(AssertionError, match="looked at"):
        UNIT.findings(image)
    assert ep.Image(range=(0, 255)).findings(pixels(np.uint8, 4, 4).view(Untouchable)) is None, "it can't be outside"


def test_a_dtype_can_be_given_in_every_way():
    for dtype in ("uint8", np.uint8, np.dtype(np.uint8), ["uint8"]):
        assert ep.Image(dtype) == ep.Image("uint8")
    assert ep.Image((float, bool)).dtype == ("float64", "bool")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"order": "RGB"}, "No order 'RGB' of an image. Did you mean 'rgb'"),
        ({"order": "hsv"}, "There are: bgr, rgb"),
        ({"dtype": "unit8"}, "Did you mean 'uint8'"),
        ({"dtype": str}, "No dtype 'str'"),
        ({"range": (1, 0)}, "is empty"),
        ({"range": (0, float("nan"))}, "is empty"),
        ({"range": 3}, r"must be \(low, high\)"),
        ({"shape": 3}, "must be a tuple such as"),
        ({"shape": ()}, "must be a tuple such as"),
        ({"shape": (0, 3)}, "must be a tuple such as"),
        ({"shape": ("h", "w"), "order": "rgb"}, r"shape \(h, w\) has no order 'rgb'"),
        ({"shape": ("h", "w", 2), "order": "rgb"}, "has no order"),
    ],
)
def test_a_contract_that_nothing_keeps_is_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        ep.Image(**settings)


def test_a_contract_is_read_from_every_parameter_and_every_output():
    assert contracts_of(gray, 2, 1) == ((RGB, None), (GRAY,))
    assert contracts_of(split, 2, 3) == ((None, UNIT), (GRAY, None, RGB))


def test_a_graph_reads_one_contract_per_token():
    assert contracts_of(gray, 1, 1) == ((RGB,), (GRAY,))
    assert contracts_of(gray, 2, 2) == ((RGB, None), (None, None)), "one mark does not say it of two outputs"
    assert contracts_of(stack, 3, 2) == ((GRAY,) * 3, (RGB,) * 2)
    assert contracts_of(stack, 3, 1) == ((GRAY,) * 3, (None,)), "the one token is the list, which is no image"


def test_methods_and_wrapped_functions_keep_their_contracts():
    class Camera:
        def shown(self, image: Annotated[np.ndarray, RGB]): ...

    @functools.wraps(gray)
    def wrapped(*args):
        return gray(*args)

    assert contracts_of(Camera().shown, 1, 0) == ((RGB,), ())
    assert contracts_of(wrapped, 1, 1) == ((RGB,), (GRAY,))
    assert contracts_of(ep.Node("gray", gray), 1, 1) == ((RGB,), (GRAY,))
    Camera.wrapped = functools.wraps(gray)(lambda self, *args: gray(*args))
    assert contracts_of(Camera().wrapped, 1, 1)[1] == (GRAY,)


@pytest.mark.parametrize("function", [len, int, lambda x: x, lost, functools.partial(gray), ep.Image])
def test_functions_that_say_nothing_have_no_contracts(function):
    assert contracts_of(function, 1, 1) == ((), ())


def test_a_broken_contract_is_told_with_everything_in_it():
    error = ContractBroken("blur", "image", GRAY, GRAY.found(pixels(np.float64, 480, 640, 3)))
    assert str(error) == (
        "Function 'blur' takes token 'image' as uint8 (h, w), but it is float64 480 x 640 x 3. "
        "Convert it, or change the annotation."
    )
    assert (error.function, error.token, error.contract, error.made) == ("blur", "image", GRAY, False)
    assert isinstance(error, EpypesError)
    assert isinstance(error, ValueError)
    assert "makes token" in str(ContractBroken("blur", "image", GRAY, "x", made=True))


def test_marks_need_no_numpy():
    code = (
        "import sys, epypes as ep; ep.Image('uint8', (None, None, 3), (0, 255), 'rgb'); print('numpy' in sys.modules)"
    )
    home = Path(ep.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=home, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
