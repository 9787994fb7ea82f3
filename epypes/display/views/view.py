"""What is to be seen of a graph, a runner, a run or a plan, whoever paints it?

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from dataclasses import replace

from epypes.display.views.graphview import GraphView
from epypes.display.views.plans import plan_view
from epypes.display.views.runs import run_structure, with_run
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import valueless_view, with_values
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Plan, Run

Shown = CompGraph | CompGraphRunner | Run | Plan


def view(shown: Shown) -> GraphView:
    """Look at a graph, a runner, a run or a plan; nothing is computed but previews."""
    if isinstance(shown, CompGraph):
        return _graph_view(shown)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown)
    if isinstance(shown, Plan):
        return plan_view(shown)
    return with_run(run_structure(shown), shown, shown.hyperparameters, frozenset())


def _graph_view(cg: CompGraph) -> GraphView:
    """Look at a graph; tokens with a default are shown as the hyperparameters that a runner makes of them."""
    structure = structure_of(cg, {}, ())
    every = [valueless_view(token, cg.defaults, "static") for token in structure.tokens]
    tokens, _ = with_values(every, cg.defaults)
    return replace(structure, tokens=tokens)


def _runner_view(runner: CompGraphRunner) -> GraphView:
    last, plan = runner.last, runner.plan()
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    if last is not None:
        return with_run(structure, last, plan.hyperparameters, frozenset(plan.order))
    functions = tuple(
        function if function.state == "left out" else replace(function, state="not run")
        for function in structure.functions
    )
    every = [valueless_view(token, plan.hyperparameters, "not computed") for token in structure.tokens]
    tokens, _ = with_values(every, plan.hyperparameters)
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption("not run yet", structure))
