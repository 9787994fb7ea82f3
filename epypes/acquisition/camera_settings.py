"""The settings of a camera with a node map, by the names that it has for them, mostly those of GenICam's SFNC."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from numbers import Integral, Real
from textwrap import shorten
from typing import Any, Final, Literal, Protocol

from epypes.errors import InvalidValue, UnknownName

_log = logging.getLogger("epypes.acquisition")

Kind = Literal["int", "float", "bool", "choice", "text"]
_TYPES: Final[Mapping[str, tuple[type, ...]]] = {
    "int": (Integral,),
    "float": (Real,),
    "bool": (bool,),
    "choice": (str,),
    "text": (str,),
}
# What changes the size of a frame, and what a camera must stand still for also where its node map does not say so.
_NEEDS_STOP: Final = frozenset(
    {"PixelFormat", "Width", "Height", "BinningHorizontal", "BinningVertical"}
    | {"DecimationHorizontal", "DecimationVertical"}
)


@dataclass(frozen=True, slots=True)
class CameraSetting:
    """One setting of a camera as it was when it was read.

    Attributes
    ----------
    name
        As the camera calls it.
    kind
        ``"int"``, ``"float"``, ``"bool"``, ``"choice"`` or ``"text"``.
    value
        None where the camera does not let it be read now.
    low, high, step
        The range of a number now: other settings may change it. None where there is none.
    choices
        Of a choice, the values that are available now.
    unit
        As the camera says, such as ``us``.
    is_writable
        Whether it can be set now. What needs a camera that stands still counts as writable: setting it stops the
        camera for that moment.
    about
        The camera's own sentence about it.
    """

    name: str
    kind: Kind
    value: Any
    low: float | None = None
    high: float | None = None
    step: float | None = None
    choices: tuple[str, ...] = ()
    unit: str = ""
    is_writable: bool = True
    about: str = ""

    def require(self, value: Any) -> Any:
        """Return a value as the camera takes it: of a step, the nearest one below.

        Raises
        ------
        ValueError
            It can't be set now, or not to this value; the text has the range.
        """
        unit = f" {self.unit}" if self.unit else ""
        if not self.is_writable:
            text = f"{self.name} is {self.value!r:.40}{unit} and can't be set to {value!r:.40} now"
            raise InvalidValue(f"{text}: the camera has locked it. Look at the settings that it depends on.")
        is_one = isinstance(value, _TYPES[self.kind]) and isinstance(value, bool) == (self.kind == "bool")
        allowed = {"bool": "True or False", "text": "a text"}.get(self.kind, f"one of {', '.join(self.choices)}")
        if self.kind == "choice":
            is_one = is_one and value in self.choices
        elif self.kind in ("int", "float"):
            low, high = -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high
            is_one = is_one and low <= value <= high
            allowed = (
                f"a{' whole' * (self.kind == 'int')} number from {round(low, 6):,.12g} to {round(high, 6):,.12g}{unit}"
            )
        if not is_one:
            raise InvalidValue(f"{self.name} can't be {value!r:.60}. Give {allowed}.")
        if self.kind == "int":
            return int(value) - (int(value) - int(self.low or 0)) % int(self.step or 1)
        return float(value) if self.kind == "float" else value


class NodeMap(Protocol):
    """The features of an opened camera, by name, and its stream; what a backend implements."""

    def names(self) -> tuple[str, ...]:
        """Return the names of the settings, as the camera orders them."""

    def setting(self, name: str) -> CameraSetting | None:
        """Return a setting; None if the camera has none of this name."""

    def write(self, name: str, value: Any) -> None:
        """Set it."""

    def execute(self, name: str) -> None:
        """Run a command, such as ``TriggerSoftware``; UnknownName if there is none of this name."""


@dataclass(slots=True)
class SettingsMemory:
    """What was set on a camera, to be set again when it is opened anew."""

    # By the selectors that were set before, since ``TriggerMode`` is another one for each ``TriggerSelector``.
    written: dict[tuple[tuple[tuple[str, str], ...], str], Any] = field(default_factory=dict)
    selected: dict[str, str] = field(default_factory=dict)

    def note(self, name: str, value: Any) -> None:
        """Keep what was set."""
        if name.endswith("Selector"):
            self.selected[name] = value
            return
        key = tuple(sorted(self.selected.items())), name
        self.written.pop(key, None)  # what is set last is restored last
        self.written[key] = value

    def restore(self, nodes: NodeMap) -> None:
        """Set on a camera that was opened anew what was set before; what it refuses now is logged."""
        for (selected, name), value in self.written.items():
            _write_all(nodes, (*selected, (name, value)))
        _write_all(nodes, self.selected.items())


class CameraSettings(Mapping[str, CameraSetting]):
    """The settings of a camera: ``settings["ExposureTime"]`` reads one, ``settings["ExposureTime"] = 20_000`` sets it.

    Any thread may use it, also while the camera streams. What was set is set again when the camera was opened anew,
    because it had been unplugged or closed.

    Parameters
    ----------
    opened
        A context that has the camera's node map; CameraUnavailable if it can't be opened.
    stopped
        The same, in which the camera stands still.
    memory
        Takes what is set.
    """

    def __init__(
        self,
        opened: Callable[[], AbstractContextManager[NodeMap]],
        stopped: Callable[[], AbstractContextManager[NodeMap]],
        memory: SettingsMemory,
    ) -> None:
        self._opened, self._stopped, self._memory = opened, stopped, memory

    def __getitem__(self, name: str) -> CameraSetting:
        with self._opened() as nodes:
            return _found(nodes, name)

    def __setitem__(self, name: str, value: Any) -> None:
        """Set one; ValueError with its range if that can't be."""
        with self._opened() as nodes:
            found = _found(nodes, name)
            if found.is_writable and name not in _NEEDS_STOP:
                self._write(nodes, found, value)
                return
        with self._stopped() as nodes:
            self._write(nodes, _found(nodes, name), value)

    def set(self, /, **values: Any) -> None:
        """Set several, in this order: ``settings.set(TriggerSource="Software", TriggerMode="On")``."""
        for name, value in values.items():
            self[name] = value

    def execute(self, command: str) -> None:
        """Run a command of the camera, such as ``TriggerSoftware``; UnknownName if it has none of this name."""
        with self._opened() as nodes:
            nodes.execute(command)

    def _write(self, nodes: NodeMap, found: CameraSetting, value: Any) -> None:
        checked = found.require(value)
        nodes.write(found.name, checked)
        self._memory.note(found.name, checked)

    def __iter__(self) -> Iterator[str]:
        with self._opened() as nodes:
            names = nodes.names()
        return iter(names)

    def __len__(self) -> int:
        return len(tuple(iter(self)))

    def __repr__(self) -> str:
        return f"<CameraSettings: {shorten(', '.join(self), 200, placeholder=' ...')}>"


def _write_all(nodes: NodeMap, values: Iterable[tuple[str, Any]]) -> None:
    for name, value in values:
        try:
            nodes.write(name, value)
        except ValueError as error:
            _log.warning("%s could not be set again: %s", name, error)


def _found(nodes: NodeMap, name: str) -> CameraSetting:
    found = nodes.setting(name)
    if found is None:
        raise UnknownName("setting", name, nodes.names(), "of this camera")
    return found
