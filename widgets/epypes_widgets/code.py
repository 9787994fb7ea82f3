"""The line of code that sets what the user has set by hand."""

from __future__ import annotations

import ast
import enum
import keyword
import re
import sys
from collections.abc import Mapping
from typing import Any, Final

from epypes.bundle.expressions import literal_source
from epypes_widgets.values import differing, listed

# A longer text of one value is for a file, not for a line.
_MAX_CHARACTERS: Final = 400


def line(
    runner_name: str,
    first_values: Mapping[str, Any],
    values: Mapping[str, Any],
    params: Mapping[str, object] | None = None,
    verb: str = "rerun",
) -> str:
    """Return the call that leads from the first values to these.

    Parameters
    ----------
    runner_name
        What the runner is called where the line is to be put.
    first_values, values
        By hyperparameter.
    params
        Hints by hyperparameter. Where one has ``labels``, a value is written by its label, as in ``cv2.INTER_LINEAR``,
        if OpenCV has a constant of that name and value.
    verb
        The method that is called.

    Returns
    -------
    str
        One line. What can't be written, such as an array, is left out and named in a comment.

    Examples
    --------
    >>> line("runner", {"lo": 70, "hi": 200}, {"lo": 90, "hi": 200})
    'runner.rerun(lo=90)'
    >>> line("runner", {"lambda": 1}, {"lambda": 2})
    "runner.rerun(**{'lambda': 2})"
    """
    changed = [name for name in differing(first_values, values) if name in values]
    sources = {name: source(values[name], (params or {}).get(name)) for name in changed}
    arguments = [f"{name}={text}" for name, text in sources.items() if text and _is_name(name)]
    others = [f"{name!r}: {text}" for name, text in sources.items() if text and not _is_name(name)]
    if others:
        arguments.append(f"**{{{', '.join(others)}}}")
    left_out = [repr(name) if "\n" in name else name for name, text in sources.items() if not text]
    comment = f"  # without {listed(left_out)}: no short text makes that value" if left_out else ""
    return f"{runner_name}.{verb}({', '.join(arguments)}){comment}"


def source(value: Any, param: object = None) -> str:
    """Return the expression of a value; "" if there is no short one."""
    text = _constant(value, param) or _expression(value)
    return text if len(text) <= _MAX_CHARACTERS else ""


def name_of(runner: object, namespace: Mapping[str, Any] | None = None, default: str = "runner") -> str:
    """Return what a runner is called in a namespace: the first name that was given to it, or the default if none was.

    Parameters
    ----------
    runner
        Is looked for by identity.
    namespace
        Objects by name; without, those that the cells of the notebook have defined.
    default
        What it is called otherwise.
    """
    if namespace is None:
        ipython = sys.modules.get("IPython")
        shell = ipython.get_ipython() if ipython is not None else None
        namespace = getattr(shell, "user_ns", {})
    for name, value in dict(namespace).items():
        if value is runner and isinstance(name, str) and not name.startswith("_") and _is_name(name):
            return name
    return default


def _is_name(name: str) -> bool:
    return name.isidentifier() and not keyword.iskeyword(name)


def _constant(value: Any, param: object) -> str:
    """Return a choice by its label, if that is the name of a constant, or of several that are joined by + or |."""
    choices, labels = getattr(param, "choices", None), getattr(param, "labels", None)
    cv2 = sys.modules.get("cv2")
    if not choices or not labels or cv2 is None or type(value) is not int:
        return ""
    label = next((label for choice, label in zip(choices, labels, strict=False) if choice == value), "")
    names = [part.strip().removeprefix("cv2.") for part in re.split(r"[+|]", label)]
    constants = [vars(cv2).get(name) for name in names]
    total = 0
    for constant in constants:
        if type(constant) is not int:
            return ""
        total |= constant
    return " | ".join(f"cv2.{name}" for name in names) if total == value else ""


def _expression(value: Any) -> str:
    if isinstance(value, enum.Enum):
        parts = (value.name or "").split("|")  # the parts of a flag have names of their own
        known = type(value).__members__
        return " | ".join(f"{type(value).__name__}.{part}" for part in parts) if known.keys() >= set(parts) else ""
    if type(value) in (tuple, list):
        return _sequence(value)
    if type(value) is float and not literal_source(value):
        return f'float("{value!r}")'
    return _numpy_scalar(value) or literal_source(value)


def _sequence(values: tuple[Any, ...] | list[Any]) -> str:
    parts = [_expression(item) for item in values[:_MAX_CHARACTERS]]
    if len(parts) < len(values) or not all(parts):
        return ""
    inner = ", ".join(parts)
    return f"[{inner}]" if isinstance(values, list) else f"({inner},)" if len(parts) == 1 else f"({inner})"


def _numpy_scalar(value: Any) -> str:
    numpy = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, numpy.number | numpy.bool_):
        return ""
    kind = type(value)
    # NumPy 2 calls its bool "bool", NumPy 1 does not know that name.
    name = "bool_" if kind is numpy.bool_ else kind.__name__
    for text in (str(value), f'"{value!s}"'):
        try:
            again = kind(ast.literal_eval(text))
        except (ValueError, SyntaxError, TypeError):
            continue
        # By their texts, which are exact, and tell -0.0 from 0.0: a long double has bytes that mean nothing.
        if repr(again) == repr(value):
            return f"np.{name}({text})"
    return ""
