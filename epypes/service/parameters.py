"""Which values do the hyperparameters of a service have, and which may they be given?"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.bundle.entries import fits, read, written
from epypes.errors import BundleError, UnknownName

Entries = Mapping[str, Mapping[str, Any]]
# Of one step; a float that was typed or sent as text is not on a step to the last bit.
_STEP_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Parameters:
    """The hyperparameters of a running service.

    Attributes
    ----------
    revision
        How often they were changed.
    entries
        By token, as in pipeline.toml: ``value``, its ``kind`` where TOML has none like it, and its range; JSON-ready.
    """

    revision: int
    entries: Entries


def read_entries(settings: Path) -> dict[str, dict[str, Any]]:
    """Return the hyperparameters of a pipeline.toml with their ranges.

    Raises
    ------
    BundleError
        The file can't be read.
    """
    try:
        document = tomllib.loads(settings.read_text(encoding="utf-8"))
        return {token: _json_ready(entry) for token, entry in document.get("hyperparameters", {}).items()}
    except (OSError, ValueError, AttributeError) as error:
        raise BundleError(settings, f"{settings} can't be read: {error}.") from error


def _json_ready(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry without what JSON has no number for: a range that is open at an end."""
    return {key: part for key, part in entry.items() if not (isinstance(part, float) and not math.isfinite(part))}


def changed(entries: Entries, values: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Return the entries with new values, and a reason for each value that can't be taken; then nothing is changed.

    Parameters
    ----------
    entries
        As they are.
    values
        By token, as JSON has them: a list is a tuple too, and a number without a fraction a float.
    """
    after = {token: dict(entry) for token, entry in entries.items()}
    problems: dict[str, str] = {}
    for token, value in values.items():
        try:
            after[token] = _with_value(entries, token, value)
        except (ValueError, UnknownName) as error:
            problems[token] = str(error)
    return ({}, problems) if problems else (after, {})


def _with_value(entries: Entries, token: str, given: Any) -> dict[str, Any]:
    if token not in entries:
        raise UnknownName("hyperparameter", token, entries, "in this service")
    entry = entries[token]
    value = _converted(token, given, entry)
    _check_range(token, value, entry)
    rest = {key: part for key, part in entry.items() if key not in ("value", "kind")}
    return {**written(value), **rest}


def _converted(token: str, given: Any, entry: Mapping[str, Any]) -> Any:
    """Return a value of JSON as the kind that the hyperparameter has."""
    before = read(entry)
    value = tuple(given) if isinstance(given, list) and type(before) is not list else given
    if not fits(value) or _has_no_number(value):
        raise ValueError(f"{token!r} can't be {_brief(given)}: write a number, text, true, false, null or a list.")
    if entry.get("choices") is not None:
        return value
    if type(before) is float and type(value) is int:
        return float(value)
    if type(before) is int and type(value) is float:
        return _whole(token, value, entry)
    if before is not None and type(value) is not type(before):
        raise ValueError(f"{token!r} is {_kind(before)}, and {_brief(given)} is {_kind(value)}.")
    if isinstance(before, tuple | list) and len(before) != len(value):
        raise ValueError(f"{token!r} has {len(before)} items, and {_brief(given)} has {len(value)}.")
    return value


def _whole(token: str, value: float, entry: Mapping[str, Any]) -> int | float:
    """Return a number without a fraction as an int, unless its range says that it may have one."""
    if any(type(entry.get(key)) is float for key in ("low", "high", "step")):
        return value
    if not value.is_integer():
        raise ValueError(f"{token!r} is a whole number, and {value} is none.")
    return int(value)


def _has_no_number(value: Any) -> bool:
    items = value if isinstance(value, tuple | list) else (value,)
    return any(isinstance(item, float) and not math.isfinite(item) for item in items)


def _check_range(token: str, value: Any, entry: Mapping[str, Any]) -> None:
    choices = entry.get("choices")
    if choices is not None:
        if not any(_is_same(value, choice) for choice in choices):
            raise ValueError(f"{token!r} can't be {_brief(value)}. There are: {', '.join(map(repr, choices))}.")
        return
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    low, high = entry.get("low"), entry.get("high")
    if (low is not None and value < low) or (high is not None and value > high):
        ends = f"from {low}" if high is None else f"up to {high}" if low is None else f"from {low} to {high}"
        raise ValueError(f"{token!r} goes {ends}, and {value} is outside.")
    if entry.get("odd") and value % 2 != 1:
        raise ValueError(f"{token!r} is odd, and {value} is not.")
    _check_step(token, value, entry.get("step"), low or 0)


def _check_step(token: str, value: float, step: float | None, begin: float) -> None:
    if not step:
        return
    steps = (value - begin) / step
    if abs(steps - round(steps)) > _STEP_TOLERANCE:
        raise ValueError(f"{token!r} goes in steps of {step} from {begin}, and {value} is between two.")


def _is_same(value: Any, choice: Any) -> bool:
    if isinstance(value, tuple) and isinstance(choice, list):
        choice = tuple(choice)
    # True is not 1.
    return value == choice and isinstance(value, bool) == isinstance(choice, bool)


def _kind(value: Any) -> str:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "null"}
    return kinds.get(type(value), "a list")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
