"""What is to be seen of a plan: what would run and why, what would be reused, what is missing?"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from epypes.display.views.graphview import FunctionView, GraphView
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import ROOM, Room, valueless_view, with_values
from epypes.errors import run_call
from epypes.run import Plan
from epypes.wording import counted

_NAMED: Final = 8


def plan_view(plan: Plan, room: Room = ROOM) -> GraphView:
    """Look at a plan; hyperparameters may be images, of which so many are shown."""
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    functions = tuple(_planned_view(function, plan) for function in structure.functions)
    missing = frozenset(plan.missing)
    every = [
        valueless_view(token, plan.hyperparameters, "missing" if token.name in missing else "static")
        for token in structure.tokens
    ]
    tokens, _ = with_values(every, plan.hyperparameters, plan.targets, room)
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption(_plan_caption(plan), structure))


def _planned_view(function: FunctionView, plan: Plan) -> FunctionView:
    name = function.name
    if function.state == "left out":
        message = "not needed for these targets" if plan.targets else "only for a branch that is not chosen"
        return replace(function, message=message)
    if name in plan.placeholders:
        return replace(function, state="missing", message="still to be written; ep.extend fills it")
    if name in plan.why:
        return replace(function, state="planned", message=plan.why[name])
    return replace(function, state="reused", message="up to date")


def _plan_caption(plan: Plan) -> str:
    placeholders = len(plan.placeholders)
    to_run = len(plan.order) - placeholders
    parts = [f"{counted(to_run, 'function')} to run, {len(plan.reused)} reused"]
    if plan.left_out:
        parts.append(f"{len(plan.left_out)} left out")
    if placeholders:
        parts.append(f"{placeholders} still to be written")
    text = ", ".join(parts)
    if plan.targets:
        text += f"; asked for: {_some(plan.targets)}"
    if plan.missing:
        text += f"; missing: {_some(plan.missing)}: call {run_call(plan.missing[:_NAMED])}"
    return text


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
