"""The line of code that sets what the user has set by hand."""

from __future__ import annotations

import ast
import enum
import keyword
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import reduce
from operator import or_
from typing import Any, Final

from epypes.bundle.source.expressions import bracketed, literal_source
from epypes.errors import InvalidValue
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
    try:
        text = _constant(value, param) or _expression(value)
    except (ValueError, RecursionError):
        return ""
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
    choices, labels = getattr(param, "choices", None) or (), getattr(param, "labels", None) or ()
    label = next((label for choice, label in zip(choices, labels, strict=False) if choice == value), "")
    names = [part.strip().removeprefix("cv2.") for part in re.split(r"[+|]", label)]
    constants = [getattr(sys.modules.get("cv2"), name, None) for name in names]
    if type(value) is not int or any(type(constant) is not int for constant in constants):
        return ""
    return " | ".join(f"cv2.{name}" for name in names) if reduce(or_, constants) == value else ""


def _expression(value: Any) -> str:
    """Return the expression of a value; ValueError if there is none."""
    if isinstance(value, enum.Enum):
        parts = (value.name or "").split("|")  # the parts of a flag have names of their own
        if not type(value).__members__.keys() >= set(parts):
            raise InvalidValue(f"{value!r} has no name")
        return " | ".join(f"{type(value).__name__}.{part}" for part in parts)
    if type(value) in (tuple, list, dict):
        if len(value) > _MAX_CHARACTERS:
            raise InvalidValue("too many items")
        return bracketed(value, _expression)
    text = _numpy_scalar(value) or literal_source(value) or (f'float("{value!r}")' if type(value) is float else "")
    if not text:
        raise InvalidValue(f"no text makes a {type(value).__name__}")
    return text


def _numpy_scalar(value: Any) -> str:
    """Return the call that makes a number of NumPy; "" for anything else."""
    numpy = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, numpy.number | numpy.bool_):
        return ""
    kind = type(value)
    # NumPy 2 calls its bool "bool", NumPy 1 does not know that name.
    name = "bool_" if kind is numpy.bool_ else kind.__name__
    for text in (str(value), f'"{value!s}"'):
        # By their texts, which are exact, and tell -0.0 from 0.0: a long double has bytes that mean nothing.
        with suppress(ValueError, SyntaxError, TypeError):
            if repr(kind(ast.literal_eval(text))) == repr(value):
                return f"np.{name}({text})"
    return ""
