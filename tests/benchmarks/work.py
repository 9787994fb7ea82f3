"""Which work is given to every contender?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np


@dataclass(frozen=True)
class Work:
    """A graph of functions with one output each, a payload, and the token that is asked for."""

    functions: Mapping[str, Callable[..., Any]]
    io: Mapping[str, tuple[tuple[str, ...], str]]
    payload: Mapping[str, Any]
    target: str
    hparams: Mapping[str, Any] = field(default_factory=dict)

    def downstream(self, token: str) -> dict[str, tuple[tuple[str, ...], str]]:
        """Return the functions, with their io, that a token's change makes stale; the io is in run order here."""
        changed, found = {token}, {}
        for name, (inputs, output) in self.io.items():
            if changed.intersection(inputs):
                changed.add(output)
                found[name] = (inputs, output)
        return found


def add_one(x: int) -> int:
    return x + 1


def passed(x: Any) -> Any:
    return x


def chain(count: int, function: Callable[..., Any] = add_one, payload: Any = 0, prefix: str = "") -> Work:
    """Functions in a row, from token ``t0`` to token ``t<count>``, with a prefix for all names."""
    names, tokens = ([f"{prefix}{letter}{index}" for index in range(count + 1)] for letter in "ft")
    return Work(
        {names[index]: function for index in range(count)},
        {names[index]: ((tokens[index],), tokens[index + 1]) for index in range(count)},
        {tokens[0]: payload},
        tokens[count],
    )


def tuned_chain(count: int, function: Callable[..., Any], payload: Any, last: Callable[..., Any]) -> Work:
    """A chain of which only the last function depends on a hyperparameter, ``k``."""
    above = chain(count - 1, function, payload)
    io = {**above.io, "last": ((above.target, "k"), "y")}
    return Work({**above.functions, "last": last}, io, above.payload, "y", {"k": 0})


def fan(count: int) -> Work:
    """One function, ``count`` that take its output, and one that gathers theirs."""
    outputs = tuple(f"b{index}" for index in range(count))
    # Peers go by the names of parameters, so the gathering function has one for each.
    gather = eval(f"lambda {', '.join(outputs)}: sum(({', '.join(outputs)}))")
    functions = {"first": add_one, **{f"f{index}": add_one for index in range(count)}, "gather": gather}
    branches = {f"f{index}": (("a",), output) for index, output in enumerate(outputs)}
    return Work(functions, {"first": (("x",), "a"), **branches, "gather": (outputs, "y")}, {"x": 0}, "y")


def grayscale(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def blur(image: np.ndarray, k: int) -> np.ndarray:
    return cv2.GaussianBlur(image, (k, k), 0)


def canny(image: np.ndarray, low: int, high: int) -> np.ndarray:
    return cv2.Canny(image, low, high)


def edge_graph(image: np.ndarray) -> Work:
    """The paper's edge graph."""
    return Work(
        {"grayscale": grayscale, "blur": blur, "canny": canny},
        {
            "grayscale": (("image",), "image_gray"),
            "blur": (("image_gray", "blur_kernel"), "image_blurred"),
            "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
        },
        {"image": image},
        "edges",
        {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200},
    )
