"""Which control does each hyperparameter get?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from epypes.graph import CompGraph, as_switch
from epypes.hints import Param, Roi, Text
from epypes_widgets.controls.choices import choice, index_of
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.look import Look
from epypes_widgets.controls.pair import pair
from epypes_widgets.controls.roi import roi
from epypes_widgets.controls.scale import Scale, scale
from epypes_widgets.controls.shown import shown
from epypes_widgets.controls.sliders import slider
from epypes_widgets.controls.text import text
from epypes_widgets.places import Tunable
from epypes_widgets.ranges import ranges
from epypes_widgets.tips import tip

Kind = Param | Roi | Text | None


def controls(runner: Tunable, hints: Mapping[str, Any]) -> tuple[Control, ...]:
    """Return the controls of a runner's hyperparameters, in graph order; a pair stands where its first token does.

    Raises
    ------
    UnknownName, TypeError, ValueError
        A hint is for no hyperparameter, can't be read, or does not fit: see ``ranges``.
    """
    values = runner.hyperparameters
    params = {
        token: param if token in hints else _branches(runner.cg, token, values[token]) or param
        for token, param in ranges(runner, hints).items()
    }
    return tuple(_Bench(runner, params).made())


class _Bench:
    """What is needed to make controls that belong together."""

    def __init__(self, runner: Tunable, params: Mapping[str, Kind]) -> None:
        self._cg, self._params, self._look = runner.cg, params, Look()
        self._values, self._first = runner.hyperparameters, runner.first_hyperparameters

    def made(self) -> Iterator[Control]:
        partner = dict(self._pairs())
        done: set[str] = set()
        for token, param in self._params.items():
            if token in done:
                continue
            scales = partner.get(token)
            if scales is None:
                yield self._single(token, param)
                continue
            done |= {entry.name for entry in scales}
            yield self._pair(*scales)

    def _pairs(self) -> Iterator[tuple[str, tuple[Scale, Scale]]]:
        """Give for both tokens of each range pair their scales, the lower one first; a token is in one pair only."""
        taken: set[str] = set()
        for token, param in self._params.items():
            above = param.below if isinstance(param, Param) else ""
            if above not in self._params or above == token or {token, above} & taken:
                continue
            low, high = self._scale(token), self._scale(above)
            if low is None or high is None or low.param.log or high.param.log:
                continue
            if self._values[token] <= self._values[above]:
                taken |= {token, above}
                yield token, (low, high)
                yield above, (low, high)

    def _scale(self, token: str) -> Scale | None:
        param = self._params[token]
        return scale(token, self._values[token], param) if isinstance(param, Param) else None

    def _pair(self, low: Scale, high: Scale) -> Control:
        values = self._values[low.name], self._values[high.name]
        first = self._first.get(low.name), self._first.get(high.name)
        tips = [f"{entry.name}: {tip(self._cg, entry.name, entry.param)}" for entry in (low, high)]
        return pair(low, high, values, first, self._look, "\n".join(tips))

    def _single(self, token: str, param: Kind) -> Control:
        value, first, said = self._values[token], self._first.get(token), tip(self._cg, token, param)
        found: Control | None = None
        if isinstance(param, Roi):
            found = roi(token, value, param, first, self._look, said)
        elif isinstance(param, Text):
            found = text(token, value, param, first, self._look, said)
        elif isinstance(param, Param) and param.choices is not None:
            found = choice(token, value, param, first, self._look, said)
        else:
            place = self._scale(token)
            found = slider(place, value, first, self._look, said) if place is not None else None
        return found or shown(token, value, param, first, self._look, said)


def _branches(cg: CompGraph, token: str, value: Any) -> Param | None:
    """Return the branches that a selector chooses from, in each of its switches; None if it is no selector."""
    found = [as_switch(cg.functions[name]) for name in cg.digraph.consumers.get(token, ()) if _selects(cg, name, token)]
    switches = [switch for switch in found if switch is not None]
    if not switches:
        return None
    first, *others = switches
    keys = tuple(key for key in first.branches if all(key in other.branches for other in others))
    return Param(choices=keys) if index_of(keys, value) is not None else None


def _selects(cg: CompGraph, function: str, token: str) -> bool:
    return cg.func_inputs(function)[0] == token and as_switch(cg.functions[function]) is not None
