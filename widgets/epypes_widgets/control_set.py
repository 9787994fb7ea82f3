"""The controls of a panel: their values, and which of them the user holds.

A control that is held is never moved by the kernel: a value for it waits until it is released.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import Any

from epypes.errors import UnknownName
from epypes.hints import Param
from epypes_widgets.controls import Control
from epypes_widgets.ranges import Range


class ControlSet:
    """The controls of a panel; may be used from any thread.

    Parameters
    ----------
    controls
        In the order in which they are listed.
    """

    def __init__(self, controls: Iterable[Control]) -> None:
        self.controls = tuple(controls)
        self._widgets = {control.widget.model_id: control.widget for control in self.controls}
        self._by_name = {name: control for control in self.controls for name in control.names}
        self._lock = threading.RLock()
        self._held: set[str] = set()
        self._waiting: dict[str, Any] = {}
        self._contested: set[str] = set()

    @property
    def values(self) -> dict[str, Any]:
        """The values of all controls, by token."""
        return {name: value for control in self.controls for name, value in control.read().items()}

    @property
    def movable(self) -> dict[str, Any]:
        """The values of the controls that are not only shown, by token."""
        return {name: value for name, value in self.values.items() if self._by_name[name].kind != "shown"}

    @property
    def params(self) -> dict[str, Range]:
        """What each hyperparameter may be, by token."""
        return {n: param for control in self.controls for n, param in zip(control.names, control.params, strict=True)}

    @property
    def thresholds(self) -> dict[str, list[str]]:
        """The hyperparameters that are thresholds, by the token that they cut."""
        cuts: dict[str, list[str]] = {}
        for name, param in self.params.items():
            if isinstance(param, Param) and param.cuts:
                cuts.setdefault(param.cuts, []).append(name)
        return cuts

    @property
    def is_holding(self) -> bool:
        """Whether any control is held."""
        return bool(self._held)

    def control(self, name: str) -> Control:
        """Return the control of a token; UnknownName if there is none."""
        if name not in self._by_name:
            raise UnknownName("hyperparameter", name, self._by_name, "of this panel")
        return self._by_name[name]

    def set(self, values: Mapping[str, Any], *, by_user: bool = False) -> dict[str, Any]:
        """Move controls to values that were set, all or none, and return them as the hyperparameters take them.

        A value for a control that is held waits, unless the user sets it, and is not returned.

        Raises
        ------
        UnknownName
            There is no such control.
        ValueError
            A value is outside of its range.
        """
        parts = self._parts(values)
        with self._lock:
            for control, own in parts.items():
                control.check(own)
            moved: dict[str, Any] = {}
            for control, own in parts.items():
                if self._is_held(control) and not by_user:
                    self._waiting.update(own)
                    continue
                control.write(own)
                moved |= {name: control.read()[name] for name in own}
            return moved

    def slide(self, places: Mapping[str, Any]) -> None:
        """Move sliders that are being dragged, by the id of their model, as if the front end had set their value."""
        for model, place in places.items():
            if model in self._widgets:
                self._widgets[model].set_state({"value": place})

    def follow(self, values: Mapping[str, Any]) -> list[str]:
        """Move controls to values of the runner; those that are held follow when they are released.

        Returns
        -------
        list of str
            A sentence for each value that its control can't show.
        """
        refused = []
        with self._lock:
            for control, own in self._parts({n: value for n, value in values.items() if n in self._by_name}).items():
                if self._is_held(control):
                    self._waiting.update(own)
                    continue
                try:
                    control.write(own)
                except ValueError as error:
                    refused.append(f"The control stays where it was: {error}")
        return refused

    def moved(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Take note of what the user has moved, and return what may be set of it.

        What waited for these controls is out of date. A contested value is not set: it waits for the release.
        """
        with self._lock:
            allowed = {name: value for name, value in values.items() if name not in self._contested}
            for name in allowed:
                self._waiting.pop(name, None)
            return allowed

    def contest(self, names: Iterable[str]) -> list[str]:
        """Take note of what others have set, and return which of it is held: it can be set after a release only."""
        with self._lock:
            held = [name for name in names if name in self._held]
            self._contested.update(held)
            return held

    def hold(self, names: Iterable[str]) -> None:
        """Take note that the user holds these controls."""
        with self._lock:
            self._held.update(name for name in names if name in self._by_name)

    def release(self) -> tuple[dict[str, Any], list[str]]:
        """Take note that nothing is held, and move the controls that had to wait.

        Returns
        -------
        dict
            The values that waited, by token.
        list of str
            Sentences as from ``follow``.
        """
        with self._lock:
            self._held.clear()
            self._contested.clear()
            waiting, self._waiting = self._waiting, {}
            return waiting, self.follow(waiting)

    def _is_held(self, control: Control) -> bool:
        return not self._held.isdisjoint(control.names)

    def _parts(self, values: Mapping[str, Any]) -> dict[Control, dict[str, Any]]:
        parts: dict[Control, dict[str, Any]] = {}
        for name, value in values.items():
            parts.setdefault(self.control(name), {})[name] = value
        return parts
