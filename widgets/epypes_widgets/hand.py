"""At which values do the controls stand, and which of them does the hand hold?

What moves by itself under the hand is never moved by us: a value for a control that is held waits until it is let go.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import Any

from epypes.errors import UnknownName
from epypes.hints import Param, Roi, Text
from epypes_widgets.controls import Control
from epypes_widgets.route import Route
from epypes_widgets.values import differing


class Hand:
    """The controls of a panel; may be used from any thread.

    Parameters
    ----------
    controls
        In the order in which they are listed.

    Attributes
    ----------
    route
        By which the controls are moved.
    """

    def __init__(self, controls: Iterable[Control]) -> None:
        self.controls, self.route = tuple(controls), Route()
        self._by_name = {name: control for control in self.controls for name in control.names}
        self._lock = threading.RLock()
        self._held: set[str] = set()
        self._waiting: dict[str, Any] = {}

    @property
    def values(self) -> dict[str, Any]:
        """The values of all controls, by token."""
        return {name: value for control in self.controls for name, value in control.read().items()}

    @property
    def params(self) -> dict[str, Param | Roi | Text | None]:
        """What each hyperparameter may be, by token."""
        return {
            name: param for control in self.controls for name, param in zip(control.names, control.params, strict=True)
        }

    def control(self, name: str) -> Control:
        """Return the control of a token; UnknownName if there is none."""
        if name not in self._by_name:
            raise UnknownName("hyperparameter", name, self._by_name, "of this panel")
        return self._by_name[name]

    def hear(self) -> None:
        """Have what the front end says handled on this thread from now on, so that no cell that runs holds it up."""
        self.route.hear()
        for control in self.controls:
            # Whatever is sent: the control's next message comes as an answer to it.
            self.route.call(control.widget.send, {})

    def set(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Move controls because the user said so, all or none, and return the values as the hyperparameters take them.

        Raises
        ------
        UnknownName
            There is no such control.
        ValueError
            A value is outside of its range.
        """
        parts = self._parts(values)
        with self._lock:
            before = {control: control.read() for control, _ in parts}
            try:
                for control, own in parts:
                    self.route.call(control.write, own)
            except ValueError:
                for control, own in before.items():
                    if differing(own, control.read()):
                        self.route.call(control.write, own)
                raise
            for name in values:
                self._waiting.pop(name, None)
            return {name: control.read()[name] for control, own in parts for name in own}

    def follow(self, values: Mapping[str, Any]) -> list[str]:
        """Move controls to what the runner has got from elsewhere; those that are held follow when they are let go.

        Returns
        -------
        list of str
            A sentence for each value that its control can't show.
        """
        refused = []
        with self._lock:
            for control, own in self._parts({name: value for name, value in values.items() if name in self._by_name}):
                if self._held.intersection(control.names):
                    self._waiting.update(own)
                    continue
                try:
                    self.route.call(control.write, own)
                except ValueError as error:
                    refused.append(f"The control stays where it was: {error}")
        return refused

    def moved(self, names: Iterable[str]) -> None:
        """Know that the hand has moved these controls: what waited for them is out of date."""
        with self._lock:
            for name in names:
                self._waiting.pop(name, None)

    def hold(self, names: Iterable[str]) -> None:
        """Know that these controls are held."""
        with self._lock:
            self._held.update(name for name in names if name in self._by_name)

    def release(self) -> list[str]:
        """Know that nothing is held any more, and move the controls that had to wait; sentences as from ``follow``."""
        with self._lock:
            self._held.clear()
            waiting, self._waiting = self._waiting, {}
            return self.follow(waiting)

    def _parts(self, values: Mapping[str, Any]) -> list[tuple[Control, dict[str, Any]]]:
        """Return the values by control."""
        parts: dict[Control, dict[str, Any]] = {}
        for name, value in values.items():
            parts.setdefault(self.control(name), {})[name] = value
        return list(parts.items())
