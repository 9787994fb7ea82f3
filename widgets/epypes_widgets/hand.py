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
from epypes_widgets.controls.quiet import slide
from epypes_widgets.values import differing


class Hand:
    """The controls of a panel; may be used from any thread.

    Parameters
    ----------
    controls
        In the order in which they are listed.
    """

    def __init__(self, controls: Iterable[Control]) -> None:
        self.controls = tuple(controls)
        self._sliders = {control.widget.model_id: control.widget for control in self.controls}
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
        movable = (control for control in self.controls if control.kind != "shown")
        return {name: value for control in movable for name, value in control.read().items()}

    @property
    def params(self) -> dict[str, Param | Roi | Text | None]:
        """What each hyperparameter may be, by token."""
        return {
            name: param for control in self.controls for name, param in zip(control.names, control.params, strict=True)
        }

    @property
    def is_holding(self) -> bool:
        """Whether any control is held."""
        return bool(self._held)

    def control(self, name: str) -> Control:
        """Return the control of a token; UnknownName if there is none."""
        if name not in self._by_name:
            raise UnknownName("hyperparameter", name, self._by_name, "of this panel")
        return self._by_name[name]

    def set(self, values: Mapping[str, Any], *, is_by_hand: bool = False) -> dict[str, Any]:
        """Move controls to values that were set, all or none, and return them as the hyperparameters take them.

        Those of controls that are held are not among them, unless it is the hand that sets them: they wait until the
        control is let go.

        Raises
        ------
        UnknownName
            There is no such control.
        ValueError
            A value is outside of its range.
        """
        parts = self._parts(values)
        with self._lock:
            held = [part for part in parts if not is_by_hand and self._held.intersection(part[0].names)]
            for control, own in held:
                control.mechanism.checked(own)
            parts = [part for part in parts if part not in held]
            before = {control: control.read() for control, _ in parts}
            try:
                for control, own in parts:
                    control.write(own)
            except ValueError:
                for control, own in before.items():
                    if differing(own, control.read()):
                        control.write(own)
                raise
            for _, own in held:
                self._waiting.update(own)
            return {name: control.read()[name] for control, own in parts for name in own}

    def slide(self, places: Mapping[str, Any]) -> None:
        """Take where sliders are that are being dragged, by the id of their model; they tell as if let go there."""
        for model, place in places.items():
            if model in self._sliders:
                slide(self._sliders[model], place)

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
                    control.write(own)
                except ValueError as error:
                    refused.append(f"The control stays where it was: {error}")
        return refused

    def moved(self, names: Iterable[str]) -> None:
        """Know that the hand has moved these controls: what waited for them is out of date, unless it is contested."""
        with self._lock:
            for name in names:
                if name not in self._contested:
                    self._waiting.pop(name, None)

    def contest(self, names: Iterable[str]) -> list[str]:
        """Know that somebody else has set these: where one is held, the hand sets nothing until it has let go.

        Returns
        -------
        list of str
            Those that are held.
        """
        with self._lock:
            held = [name for name in names if name in self._held]
            self._contested.update(held)
            return held

    def uncontested(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values that the hand may set."""
        with self._lock:
            return {name: value for name, value in values.items() if name not in self._contested}

    def hold(self, names: Iterable[str]) -> None:
        """Know that these controls are held."""
        with self._lock:
            self._held.update(name for name in names if name in self._by_name)

    def release(self) -> tuple[dict[str, Any], list[str]]:
        """Know that nothing is held any more, and move the controls that had to wait.

        Returns
        -------
        dict
            The values that they had to wait for, by token.
        list of str
            Sentences as from ``follow``.
        """
        with self._lock:
            self._held.clear()
            self._contested.clear()
            waiting, self._waiting = self._waiting, {}
            return waiting, self.follow(waiting)

    def _parts(self, values: Mapping[str, Any]) -> list[tuple[Control, dict[str, Any]]]:
        """Return the values by control."""
        parts: dict[Control, dict[str, Any]] = {}
        for name, value in values.items():
            parts.setdefault(self.control(name), {})[name] = value
        return list(parts.items())
