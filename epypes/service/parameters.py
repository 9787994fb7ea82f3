"""Which values do the hyperparameters of a service have, and which may they be given?"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.bundle.entries import written
from epypes.errors import BundleError, UnknownName

Entries = Mapping[str, Mapping[str, Any]]
# Of one step; a float that was typed or sent as text is not on a step to the last bit.
_STEP_TOLERANCE: Final = 1e-6
# What may be given anew as JSON has it: the kinds of `epypes.bundle.entries` that are a number, a text or a flat list.
_KINDS: Final = (None, "none", "tuple", "numpy", "enum")
_VALUE_KEYS: Final = ("value", "kind", "dtype", "enum", "shape")
_TYPES: Final[Mapping[type, str]] = {bool: "bool", int: "int", float: "float", str: "text", list: "list"}
# What TOML has no whole number for.
_MOST_WHOLE: Final = 2**63


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
    return {key: part for key, part in entry.items() if not any(map(_has_no_number, _items(part)))}


def _items(part: Any) -> Any:
    return part if isinstance(part, list) else (part,)


def _has_no_number(item: Any) -> bool:
    return isinstance(item, float) and not math.isfinite(item)


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
    if entry.get("kind") not in _KINDS or isinstance(entry.get("value"), dict):
        what = entry.get("kind", "table")
        raise ValueError(f"{token!r} is of kind {what!r}, which can't be changed while it is served. Promote it anew.")
    _check_plain(token, given)
    rest = {key: part for key, part in entry.items() if key not in _VALUE_KEYS}
    if entry.get("choices") is not None:
        return {**_chosen(token, given, entry), **rest}
    if "value" not in entry:
        # It was None, which says nothing of what else it may be.
        return {**written(tuple(given) if isinstance(given, list) else given), **rest}
    value = _converted(token, given, entry)
    _check_range(token, value, entry)
    return {**value_of(entry), "value": value, **rest}


def type_of(entry: Mapping[str, Any]) -> str:
    """Return which values an entry takes, for readers of JSON, to whom 1.0 and 1 are the same.

    Returns
    -------
    str
        ``int``, ``float``, ``bool``, ``text``, ``list``, ``none`` or ``other``.
    """
    value = entry.get("value")
    if "value" not in entry or value is None:
        return "none"
    if type(value) is int and (_may_have_fraction(entry) or str(entry.get("dtype", "")).startswith("float")):
        return "float"
    return _TYPES.get(type(value), "other")


def _may_have_fraction(entry: Mapping[str, Any]) -> bool:
    """Whether the range of a whole number says that it may be another one too."""
    return "dtype" not in entry and any(type(entry.get(key)) is float for key in ("low", "high", "step"))


def value_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of an entry is its value, without its range."""
    return {key: entry[key] for key in _VALUE_KEYS if key in entry}


def with_value(entry: Mapping[str, Any], value: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry with another value, as `value_of` returns one, and its own range."""
    return {**value_of(value), **{key: part for key, part in entry.items() if key not in _VALUE_KEYS}}


def misfits(entries: Entries, values: Mapping[str, Any]) -> dict[str, str]:
    """Return a reason for each value, as `value_of` returns one, that no change could have given to its entry."""
    problems: dict[str, str] = {}
    for token, value in others_than(entries, values).items():
        if token not in entries:
            continue
        try:
            is_so = value_of(_with_value(entries, token, value.get("value"))) == value
        except ValueError as error:
            problems[token] = str(error)
            continue
        if not is_so:
            problems[token] = f"{token!r} can't be {_brief(value)}: it is of another kind."
    return problems


def others_than(entries: Entries, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of some values, by token, that are others than those of entries."""
    return {token: value for token, value in values.items() if value != value_of(entries.get(token, {}))}


def differing_values(written: Entries, before: Entries, after: Entries) -> list[str]:
    """Return a line for each hyperparameter that has another value after a bundle has taken another's place.

    Parameters
    ----------
    written
        What the bundle before has in its pipeline.toml.
    before, after
        What was, and what is.

    Examples
    --------
    >>> differing_values({"sigma": {"value": 1.0}}, {"sigma": {"value": 1.4}}, {"sigma": {"value": 1.0}})
    ['sigma 1.4 -> 1.0 (tuned, not written back)']
    """
    found = []
    for token in (token for token in before if token in after):
        if value_of(before[token]) != value_of(after[token]):
            is_tuned = value_of(before[token]) != value_of(written.get(token, {}))
            note = " (tuned, not written back)" if is_tuned else ""
            found.append(f"{token} {_shown(before[token])} -> {_shown(after[token])}{note}")
    return found


def _shown(entry: Mapping[str, Any]) -> str:
    return _brief(entry.get("value"))


def _check_plain(token: str, given: Any) -> None:
    """Raise ValueError for what is neither a scalar of JSON nor a list of them, or has no number."""
    for item in _items(given):
        is_beyond = isinstance(item, int) and abs(item) >= _MOST_WHOLE
        if not isinstance(item, bool | int | float | str | None) or is_beyond or _has_no_number(item):
            text = "write a number, text, true, false, null or a list of these"
            raise ValueError(f"{token!r} can't be {_brief(given)}: {text}.")


def _chosen(token: str, given: Any, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of the choice that was meant."""
    choices = entry["choices"]
    for choice in choices:
        has_kind = isinstance(choice, dict) and "kind" in choice
        if _is_same(given, choice["value"] if has_kind and "value" in choice else choice):
            return dict(choice) if has_kind else {**value_of(entry), "value": choice}
    raise ValueError(f"{token!r} can't be {_brief(given)}. There are: {', '.join(map(_brief, choices))}.")


def _converted(token: str, given: Any, entry: Mapping[str, Any]) -> Any:
    """Return a value of JSON as the kind that the hyperparameter has."""
    before, is_float = entry["value"], str(entry.get("dtype", "")).startswith("float")
    if type(given) is int and (type(before) is float or is_float):
        return float(given)
    if type(given) is float and type(before) is int and not is_float:
        return _whole(token, given, entry)
    if type(given) is not type(before) and not (is_float and type(given) is float):
        raise ValueError(f"{token!r} is {_kind(before)}, and {_brief(given)} is {_kind(given)}.")
    if isinstance(before, list) and len(before) != len(given):
        raise ValueError(f"{token!r} has {len(before)} items, and {_brief(given)} has {len(given)}.")
    return given


def _whole(token: str, value: float, entry: Mapping[str, Any]) -> int | float:
    """Return a number without a fraction as an int, unless its range says that it may have one."""
    if _may_have_fraction(entry):
        return value
    if not value.is_integer():
        raise ValueError(f"{token!r} is a whole number, and {value} is none.")
    return int(value)


def _check_range(token: str, value: Any, entry: Mapping[str, Any]) -> None:
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


def _is_same(given: Any, choice: Any) -> bool:
    # True is not 1.
    return bool(given == choice) and isinstance(given, bool) == isinstance(choice, bool)


def _kind(value: Any) -> str:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "null"}
    return kinds.get(type(value), "a list")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
