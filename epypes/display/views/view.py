"""What is to be seen of a graph, a runner, a run, a plan or a pipeline, whoever paints it?

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from dataclasses import replace

from epypes.display.views.graphview import GraphView
from epypes.display.views.pipelines import PipelineLike, in_pipeline
from epypes.display.views.plans import plan_view
from epypes.display.views.runs import run_structure, with_run
from epypes.display.views.states import with_first, with_running
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import valueless_view, within_budget
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Plan, Run

Shown = CompGraph | CompGraphRunner | Run | Plan | PipelineLike


def view(shown: Shown) -> GraphView:
    """Look at a graph, a runner, a run, a plan or a pipeline; nothing is computed but previews."""
    if isinstance(shown, CompGraph):
        return _graph_view(shown)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown)
    if isinstance(shown, Plan):
        return with_first(plan_view(shown), shown.hyperparameters, shown.first_hyperparameters)
    if isinstance(shown, Run):
        graph = with_run(run_structure(shown), shown, shown.hyperparameters, frozenset())
        return with_first(graph, shown.hyperparameters, shown.first_hyperparameters)
    return in_pipeline(_runner_view(shown.runner), shown)


def _graph_view(cg: CompGraph) -> GraphView:
    """Look at a graph; tokens with a default are shown as the hyperparameters that a runner makes of them."""
    structure = structure_of(cg, {}, ())
    every = [valueless_view(token, cg.defaults, "static") for token in structure.tokens]
    tokens, _ = within_budget(every, ())
    return replace(structure, tokens=tokens)


def _runner_view(runner: CompGraphRunner) -> GraphView:
    # First, so that what ends meanwhile shows as running, not as never run.
    running, last, plan = runner.running, runner.last, runner.plan()
    graph = _between_runs(last, plan)
    return with_running(with_first(graph, plan.hyperparameters, plan.first_hyperparameters), running)


def _between_runs(last: Run | None, plan: Plan) -> GraphView:
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    if last is not None:
        return with_run(structure, last, plan.hyperparameters, frozenset(plan.order))
    functions = tuple(
        function if function.state == "left out" else replace(function, state="not run")
        for function in structure.functions
    )
    tokens = tuple(valueless_view(token, plan.hyperparameters, "not computed") for token in structure.tokens)
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption("not run yet", structure))
