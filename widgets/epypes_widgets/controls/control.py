"""What can every control do, whatever it looks like?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import ipywidgets

from epypes.errors import UnknownName
from epypes.hints import Param, Roi, Text
from epypes_widgets.controls.kinds import is_same

Told = Callable[[Mapping[str, Any]], None]


class Mechanism(Protocol):
    """How values and a widget belong together; a Control calls it from one thread at a time."""

    def read(self) -> dict[str, Any]:
        """Return the values that the widget is at, by token."""
        ...

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values as the hyperparameters take them; ValueError if they don't."""
        ...

    def place(self, values: Mapping[str, Any]) -> None:
        """Move the widget to checked values."""
        ...


class _Hand:
    """What is known of the hand: who hears of it, and which values were told or written last."""

    def __init__(self) -> None:
        # Held for moments only, and never while others are told, who may hold locks of their own.
        self.lock = threading.RLock()
        self.is_writing = False
        self.told: dict[str, Any] = {}
        self.listeners: list[Told] = []


@dataclass(frozen=True, slots=True, eq=False)
class Control:
    """One or two hyperparameters on screen; its methods may be called from any thread.

    Attributes
    ----------
    names
        The tokens: one, or two for a range pair, the lower one first.
    kind
        ``"slider"``, ``"range"``, ``"log"``, ``"choice"``, ``"check"``, ``"text"``, ``"roi"``, or ``"shown"`` for what
        can't be moved on screen.
    params
        The values that each may take; None for anything.
    widget
        What is seen.
    mechanism
        How the values and the widget belong together.
    trait
        The trait of the widget that changes when it is moved.
    first
        The values that the hyperparameters had when they were made.
    integer
        Whether all values are whole numbers.
    steps
        The distances between two values; None where there is none. On a logarithmic slider of exponents of ten.
    """

    names: tuple[str, ...]
    kind: str
    params: tuple[Param | Roi | Text | None, ...]
    widget: ipywidgets.Widget
    mechanism: Mechanism = field(repr=False)
    trait: str = "value"
    first: tuple[Any, ...] = field(default=(), repr=False)
    integer: bool = False
    steps: tuple[float | None, ...] = ()
    _hand: _Hand = field(default_factory=_Hand, init=False, repr=False)

    def __post_init__(self) -> None:
        self._hand.told = self.mechanism.read()
        self.widget.observe(self._moved, names=self.trait)

    def read(self) -> dict[str, Any]:
        """Return the values by token, to the last bit."""
        with self._hand.lock:
            return self.mechanism.read()

    def write(self, values: Mapping[str, Any]) -> None:
        """Move to values of some or all of the tokens; who listens to the hand does not hear of it.

        Raises
        ------
        UnknownName
            A token is not of this control.
        ValueError
            A token can't have its value. Nothing is moved then.
        """
        for name in values:
            if name not in self.names:
                raise UnknownName("hyperparameter", name, self.names, "of this control")
        hand = self._hand
        with hand.lock:
            checked = self.mechanism.checked(values)
            # A move of the hand on another thread waits for the lock, and then differs from what was written.
            hand.told = {**hand.told, **checked}
            hand.is_writing = True
            try:
                self.mechanism.place(checked)
            finally:
                hand.is_writing = False

    def on_change(self, callback: Told) -> None:
        """Call ``callback(values)`` with the tokens that the hand has moved, on the thread that answers the front end.

        A widget that was only shown, and has snapped to its steps, was not moved.
        """
        self._hand.listeners.append(callback)

    def _moved(self, _change: object) -> None:
        hand = self._hand
        with hand.lock:
            if hand.is_writing:
                return
            values = self.mechanism.read()
            moved = {name: value for name, value in values.items() if not is_same(hand.told[name], value)}
            hand.told = values
        if moved:
            for callback in hand.listeners:
                callback(moved)
