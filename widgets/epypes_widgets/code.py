"""Which line of code does what the hand has done?"""

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
_MOST_CHARACTERS: Final = 400
_MISSING: Final = object()


def line(
    runner_name: str,
    first_values: Mapping[str, Any],
    values: Mapping[str, Any],
    params: Mapping[str, object] | None = None,
    module: str = "cv2",
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
        if the module has a constant of that name and value.
    module
        The module of these constants.
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
    sources = {name: source(values[name], (params or {}).get(name), module) for name in changed}
    words = [f"{name}={text}" for name, text in sources.items() if text and _is_keyword_argument(name)]
    others = [f"{name!r}: {text}" for name, text in sources.items() if text and not _is_keyword_argument(name)]
    if others:
        words.append(f"**{{{', '.join(others)}}}")
    left_out = [repr(name) if "\n" in name else name for name, text in sources.items() if not text]
    comment = f"  # without {listed(left_out)}: no short text makes that value" if left_out else ""
    return f"{runner_name}.{verb}({', '.join(words)}){comment}"


def source(value: Any, param: object = None, module: str = "cv2") -> str:
    """Return the expression of a value; "" if there is no short one."""
    text = _constant(value, param, module) or _expression(value)
    return text if len(text) <= _MOST_CHARACTERS else ""


def name_of(runner: object, namespace: Mapping[str, Any] | None = None, word: str = "runner") -> str:
    """Return what a runner is called in a namespace: the first name that was given to it, or ``word`` if none was.

    Parameters
    ----------
    runner
        Is looked for by identity.
    namespace
        Objects by name; that of the notebook without.
    word
        What it is called otherwise.
    """
    known = dict(_notebook() if namespace is None else namespace)
    return next((name for name, value in known.items() if value is runner and _is_variable(name)), word)


def _notebook() -> Mapping[str, Any]:
    """Return what the cells have defined; nothing outside of IPython."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "user_ns", {})


def _is_variable(name: object) -> bool:
    return isinstance(name, str) and not name.startswith("_") and _is_keyword_argument(name)


def _is_keyword_argument(name: str) -> bool:
    return name.isidentifier() and not keyword.iskeyword(name)


def _constant(value: Any, param: object, module: str) -> str:
    """Return a choice by its label, if that is the name of a constant, or of several that are joined by + or |."""
    choices, labels = getattr(param, "choices", None), getattr(param, "labels", None)
    home = sys.modules.get(module)
    if not choices or not labels or home is None or type(value) is not int:
        return ""
    label = next((label for choice, label in zip(choices, labels, strict=False) if choice == value), "")
    parts = [part.strip().removeprefix(f"{module}.") for part in re.split(r"[+|]", label)]
    total = 0
    for part in parts:
        constant = getattr(home, part, _MISSING) if part.isidentifier() else _MISSING
        if type(constant) is not int:
            return ""
        total |= constant
    return " | ".join(f"{module}.{part}" for part in parts) if total == value else ""


def _expression(value: Any) -> str:
    if isinstance(value, enum.Enum):
        return _member(value)
    if type(value) in (tuple, list):
        return _sequence(value)
    if type(value) is float and not literal_source(value):
        return f'float("{value!r}")'
    return _numpy_scalar(value) or literal_source(value)


def _member(value: enum.Enum) -> str:
    known = type(value).__members__
    parts = (value.name or "").split("|")
    # The parts of a flag have names of their own.
    return " | ".join(f"{type(value).__name__}.{part}" for part in parts) if all(map(known.__contains__, parts)) else ""


def _sequence(values: tuple[Any, ...] | list[Any]) -> str:
    if len(values) > _MOST_CHARACTERS:
        return ""
    parts = [_expression(item) for item in values]
    if not all(parts):
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
