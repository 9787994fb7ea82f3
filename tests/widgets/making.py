"""Which controls has a runner with these hyperparameters?"""

from __future__ import annotations

from typing import Any

import epypes as ep
from epypes_widgets.controls.control import Control, controls


def runner_of(**values: Any) -> ep.CompGraphRunner:
    """Return a runner of one function that takes these values as hyperparameters."""
    cg = ep.CompGraph({"f": lambda *values: values}, {"f": (tuple(values), "y")})
    runner = ep.CompGraphRunner(cg)
    runner.freeze(**values)
    return runner


def made(value: Any, hint: Any = None) -> Control:
    """Return the control of a hyperparameter x."""
    (entry,) = controls(runner_of(x=value), {} if hint is None else {"x": hint})
    return entry


def at(entry: Control) -> Any:
    """Return the value of the one hyperparameter of a control."""
    (value,) = entry.read().values()
    return value


def moves(entry: Control) -> list[dict[str, Any]]:
    """Return a list that grows with what the hand moves."""
    told: list[dict[str, Any]] = []
    entry.on_change(lambda values: told.append(dict(values)))
    return told
