"""The hyperparameters of a running service: their values and ranges, and how they are changed.

A change is all or nothing, happens between two events, and has a revision that every output is stamped with.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.settings import encode_value
from epypes.errors import InvalidValue, ParametersRefused, RevisionConflict, ServiceError, UnknownName

if TYPE_CHECKING:
    from epypes.bundle.settings import Settings
    from epypes.service.bundle_info import BundleInfo
    from epypes.service.dispatcher import Dispatcher
    from epypes.service.result_publisher import Listener
    from epypes.service.supervision.worker_connection import WorkerConnection

_log = logging.getLogger("epypes.service")

Entries = Mapping[str, Mapping[str, Any]]
# Of one step: a float that was typed or sent as text is not on a step to the last bit.
_STEP_TOLERANCE: Final = 1e-6
# Kinds of `epypes.bundle.settings` that JSON can give: a number, a text or a flat list.
_KINDS: Final = (None, "none", "tuple", "numpy", "enum")
_VALUE_KEYS: Final = ("value", "kind", "dtype", "enum", "shape")
_TYPES: Final[Mapping[type, str]] = {bool: "bool", int: "int", float: "float", str: "text", list: "list"}
# TOML has no larger integer.
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


def entries_of(settings: Settings) -> dict[str, dict[str, Any]]:
    """Return the hyperparameters of a bundle with their ranges, as JSON has them."""
    return {token: _json_ready(entry) for token, entry in settings.entries.items()}


def _json_ready(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry without numbers that JSON lacks: a range that is open at an end."""
    return {key: part for key, part in entry.items() if not any(map(_has_no_number, _items(part)))}


def _items(part: Any) -> Any:
    return part if isinstance(part, list) else (part,)


def _has_no_number(item: Any) -> bool:
    return isinstance(item, float) and not math.isfinite(item)


def changed_entries(entries: Entries, values: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
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
        raise InvalidValue(f"{token!r} is of kind {what!r}, which can't be changed while it is served. Promote again.")
    _check_plain(token, given)
    rest = {key: part for key, part in entry.items() if key not in _VALUE_KEYS}
    if entry.get("choices") is not None:
        return {**_chosen(token, given, entry), **rest}
    if "value" not in entry:
        # It was None, so its type is not known.
        return {**encode_value(tuple(given) if isinstance(given, list) else given), **rest}
    value = _converted(token, given, entry)
    _check_range(token, value, entry)
    return {**value_of(entry), "value": value, **rest}


def type_of(entry: Mapping[str, Any]) -> str:
    """Return the type of an entry's values, for readers of JSON, where 1.0 and 1 are the same.

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
    """Return the value of an entry, without its range."""
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
    """Return the values, by token, that differ from those of entries."""
    return {token: value for token, value in values.items() if value != value_of(entries.get(token, {}))}


def differing_values(written: Entries, before: Entries, after: Entries) -> list[str]:
    """Return a line for each hyperparameter whose value differs after a bundle has replaced another one.

    Parameters
    ----------
    written
        Entries in the pipeline.toml of the bundle before.
    before, after
        Entries before and after.

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
    """Raise ValueError for anything but a scalar of JSON or a list of them."""
    for item in _items(given):
        is_beyond = isinstance(item, int) and abs(item) >= _MOST_WHOLE
        if not isinstance(item, bool | int | float | str | None) or is_beyond or _has_no_number(item):
            text = "give a number, text, true, false, null or a list of these"
            raise InvalidValue(f"{token!r} can't be {_brief(given)}: {text}.")


def _chosen(token: str, given: Any, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of the choice with this value."""
    choices = entry["choices"]
    for choice in choices:
        has_kind = isinstance(choice, dict) and "kind" in choice
        if _is_same(given, choice["value"] if has_kind and "value" in choice else choice):
            return dict(choice) if has_kind else {**value_of(entry), "value": choice}
    raise InvalidValue(f"{token!r} can't be {_brief(given)}. There are: {', '.join(map(_brief, choices))}.")


def _converted(token: str, given: Any, entry: Mapping[str, Any]) -> Any:
    """Return a value of JSON as the kind that the hyperparameter has."""
    before, is_float = entry["value"], str(entry.get("dtype", "")).startswith("float")
    if type(given) is int and (type(before) is float or is_float):
        return float(given)
    if type(given) is float and type(before) is int and not is_float:
        return _whole(token, given, entry)
    if type(given) is not type(before) and not (is_float and type(given) is float):
        raise InvalidValue(f"{token!r} is {_kind(before)}, and {_brief(given)} is {_kind(given)}.")
    if isinstance(before, list) and len(before) != len(given):
        raise InvalidValue(f"{token!r} has {len(before)} items, and {_brief(given)} has {len(given)}.")
    return given


def _whole(token: str, value: float, entry: Mapping[str, Any]) -> int | float:
    """Return a number without a fraction as an int, unless its range says that it may have one."""
    if _may_have_fraction(entry):
        return value
    if not value.is_integer():
        raise InvalidValue(f"{token!r} is a whole number, and {value} is none.")
    return int(value)


def _check_range(token: str, value: Any, entry: Mapping[str, Any]) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    low, high = entry.get("low"), entry.get("high")
    if (low is not None and value < low) or (high is not None and value > high):
        ends = f"from {low}" if high is None else f"up to {high}" if low is None else f"from {low} to {high}"
        raise InvalidValue(f"{token!r} goes {ends}, and {value} is outside.")
    if entry.get("odd") and value % 2 != 1:
        raise InvalidValue(f"{token!r} is odd, and {value} is not.")
    _check_step(token, value, entry.get("step"), low or 0)


def _check_step(token: str, value: float, step: float | None, begin: float) -> None:
    if not step:
        return
    steps = (value - begin) / step
    if abs(steps - round(steps)) > _STEP_TOLERANCE:
        raise InvalidValue(f"{token!r} goes in steps of {step} from {begin}, and {value} is between two.")


def _is_same(given: Any, choice: Any) -> bool:
    # True is not 1.
    return bool(given == choice) and isinstance(given, bool) == isinstance(choice, bool)


def _kind(value: Any) -> str:
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "null"}
    return kinds.get(type(value), "a list")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# -- changing them ----------------------------------------------------------------------------------------------------


class ParameterControl:
    """The parameters of the worker, kept over its restarts.

    Parameters
    ----------
    bundle
        The bundle, whose parameters are the first ones.
    dispatcher
        Knows the worker.
    notify
        Called with ``"parameters"`` and their new values.
    timeout_s
        How long a change may wait for the event that is worked on, in seconds.

    Attributes
    ----------
    current
        The parameters.
    bundle
        The bundle that they belong to.
    newest
        Returns revision and values, by the digest of a bundle, that its other replicas compute with; None without any.
    """

    def __init__(self, bundle: BundleInfo, dispatcher: Dispatcher, notify: Listener, timeout_s: float) -> None:
        self.current = Parameters(0, bundle.entries)
        self.bundle, self._path = bundle, bundle.path
        self.newest: Callable[[str], tuple[int, Mapping[str, Any]] | None] = lambda digest: None
        self._dispatcher, self._notify, self._timeout_s = dispatcher, notify, timeout_s
        self._changing = threading.Lock()
        self._pending: Parameters | None = None

    @property
    def digest(self) -> str:
        """Of the bundle that the parameters belong to."""
        return self.bundle.digest

    def snapshot(self) -> tuple[str, Parameters]:
        """Return the digest of the bundle and its parameters, read together."""
        with self._dispatcher.lock:
            return self.bundle.digest, self.current

    def set(self, values: Mapping[str, Any], revision: int | None, at_least: int = 0) -> Parameters:
        """Change values, under a revision of ``at_least`` or more; return all of them, with their revision.

        Raises
        ------
        RevisionConflict
            They have another revision by now.
        ParametersRefused
            A value can't be taken; nothing is changed.
        ServiceError
            There is no worker, or it is busy.
        """
        with self._exclusive():
            while True:
                before = self.current
                if revision is not None and revision != before.revision:
                    raise RevisionConflict(self._path, before)
                entries, problems = changed_entries(before.entries, values)
                if problems:
                    raise ParametersRefused(self._path, problems)
                sent = _differing(before.entries, entries)
                if not sent:
                    return before
                wanted = Parameters(max(before.revision + 1, at_least), entries)
                connection = self._begin(before, wanted)
                # Otherwise another bundle has taken over since.
                if connection is not None:
                    break
            problems = connection.change_parameters(wanted.revision, sent, self._timeout_s)
            if problems:
                raise ParametersRefused(self._path, problems)
            if self.current is not wanted:
                # Another bundle has taken over meanwhile, with parameters of its own.
                raise RevisionConflict(self._path, self.current)
            return wanted

    def follow(self, digest: str, revision: int, values: Mapping[str, Any]) -> Mapping[str, str]:
        """Take the values of another replica under their revision; return the problems by token, if there are any.

        Raises
        ------
        ServiceError
            There is no worker, it is busy, or it is one of another bundle by now.
        """
        with self._exclusive():
            before, bundle = self.current, self.bundle
            if bundle.digest == digest and (problems := misfits(bundle.entries, values)):
                return problems
            wanted = Parameters(revision, _with_values(bundle.entries, values))
            connection = self._begin(before, wanted) if bundle.digest == digest else None
            if connection is None:
                raise ServiceError(self._path, "Another bundle has taken over. Try again.")
            sent = _differing(before.entries, wanted.entries)
            return connection.change_parameters(revision, sent, self._timeout_s)

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        if not self._changing.acquire(timeout=self._timeout_s):
            raise ServiceError(self._path, "The parameters are being changed by another caller. Try again.")
        try:
            yield
        finally:
            self._changing.release()
            self._dispatcher.publish()

    def _begin(self, before: Parameters, wanted: Parameters) -> WorkerConnection | None:
        """Return the worker that must take a change; None if the parameters changed concurrently."""
        with self._dispatcher.lock:
            if self.current is not before:
                return None
            connection = self._dispatcher.connection
            if connection is None:
                raise ServiceError(self._path, "There is no worker just now. Try again in a moment.")
            if self._pending is not None:
                raise ServiceError(self._path, "A change is waiting for an event to end. Try again in a moment.")
            self._pending = wanted
            return connection

    def settled(self, connection: WorkerConnection, answer: Mapping[str, Any]) -> None:
        """Take a worker's answer to a change; called on its receiving thread, before events that come after it."""
        with self._dispatcher.lock:
            pending = self._pending
            if connection is not self._dispatcher.connection or pending is None:
                return
            if answer["revision"] != pending.revision:
                return
            self._pending = None
            if not (answer["problems"] or answer["is_withdrawn"]):
                changes = differing_values(self.current.entries, self.current.entries, pending.entries)
                _log.info("parameters, revision %d: %s", pending.revision, "; ".join(changes))
                self._change(pending)

    def _change(self, parameters: Parameters) -> None:
        self.current = parameters
        data = {"revision": parameters.revision, "parameters": parameters.entries}
        self._dispatcher.publish_later(lambda: self._notify("parameters", data))

    def for_new_worker(self) -> tuple[int, dict[str, Any]] | None:
        """Return the revision and the values that a new worker must take; None if it has them. With the lock held."""
        # A change that the last worker has not confirmed was in no output.
        self._pending = None
        if not self.current.revision:
            return None
        return self.current.revision, {token: value_of(entry) for token, entry in self.current.entries.items()}

    def take_over(self, bundle: BundleInfo) -> None:
        """Begin with the parameters of another bundle, or of its other replicas. With the lock held.

        The revision rises, so that these are newer than all earlier ones.
        """
        self._pending, self.bundle = None, bundle
        revision, values = self.newest(bundle.digest) or (0, {})
        problems = misfits(bundle.entries, values)
        if problems:
            _log.error("revision %d of the other replicas of %s is ignored: %s", revision, bundle.path, problems)
            # So that the bundle's own values are newer for all replicas.
            revision, values = revision + 1, {}
        self._change(Parameters(max(revision, self.current.revision + 1), _with_values(bundle.entries, values)))


def _differing(before: Entries, after: Entries) -> dict[str, dict[str, Any]]:
    """Return the values of the entries that changed."""
    return {token: value_of(entry) for token, entry in after.items() if entry != before.get(token)}


def _with_values(entries: Entries, values: Mapping[str, Any]) -> Entries:
    """Return entries with these values, and with their own where there is none."""
    return {token: with_value(entry, values[token]) if token in values else entry for token, entry in entries.items()}
