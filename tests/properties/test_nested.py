"""After any sequence of edits, a graph with pipelines inside computes what the flat graph does, and nothing more runs.

The last functions of a random graph become a pipeline, and the last ones of these another one inside it. A machine
edits and runs the graph, sets hyperparameters through the graph and in the pipelines, beside the model of the flat graph
in `test_staleness`. Runs that have ended never change.
"""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

import epypes as ep
from epypes.errors import NotComputed
from epypes.run import execute
from tests.properties.test_staleness import VALUES, Model, Recorded


class Counted(Recorded):
    """A function of integers that counts its calls, and fails on some inputs."""

    last = None

    def __call__(self, *args):
        self.last = args
        return super().__call__(*args)

    def compute(self, *args):
        total = (self.index + 1) * 31 + sum((place + 2) * arg for place, arg in enumerate(args))
        if self.fails and total % 5 == 0:
            raise ArithmeticError(total)
        values = tuple((total + place) % 4 for place in range(self.outputs))
        return values if self.outputs != 1 else values[0]


@st.composite
def graphs(draw):
    """Return functions and io of a random graph, and after how many functions a pipeline begins, and one inside it."""
    functions, io, tokens = {}, {}, [f"s{index}" for index in range(draw(st.integers(1, 5)))]
    for index in range(draw(st.integers(2, 8))):
        inputs = tuple(draw(st.lists(st.sampled_from(tokens), max_size=3, unique=True)))
        made = [f"t{index}_{place}" for place in range(draw(st.integers(1, 2)))]
        functions[f"f{index}"] = Counted(index, len(made), draw(st.integers(0, 4)) == 0)
        io[f"f{index}"] = (inputs, made[0] if len(made) == 1 else tuple(made))
        tokens += made
    cuts = sorted(draw(st.sets(st.integers(0, len(io) - 1), min_size=1, max_size=2)))
    return functions, io, cuts


class Nest:
    """A graph whose last functions are a pipeline, in which the last functions are one again.

    Attributes
    ----------
    cg
        The outermost graph.
    names
        By source token of the flat graph, its name in the outermost one.
    owners
        By source token that only a pipeline takes, that pipeline.
    """

    def __init__(self, functions, io, cuts, hparams):
        self.names, self.owners = {token: token for token in hparams}, {}
        self.cg = self._graph(functions, io, cuts, hparams, 0)

    def _graph(self, functions, io, cuts, hparams, start):
        if not cuts:
            return ep.CompGraph(functions, io)
        names = list(functions)
        first, last = names[: cuts[0] - start], names[cuts[0] - start :]
        outer = ep.CompGraph({name: functions[name] for name in first}, {name: io[name] for name in first})
        own = {token: hparams[token] for token in hparams if token not in outer.tokens}
        name = f"nest{start}"
        rest = self._graph({n: functions[n] for n in last}, {n: io[n] for n in last}, cuts[1:], own, cuts[0])
        inside = ep.CompGraph({n: functions[n] for n in last}, {n: io[n] for n in last})
        taken = {token: value for token, value in own.items() if token in rest.tokens}
        pipe = ep.Pipeline(name, rest, taken)
        for token in own:
            if token in inside.tokens:
                self.names[token] = f"{name}__{self.names[token]}"
                self.owners.setdefault(token, pipe)
        return ep.CompGraph(
            {**{n: functions[n] for n in first}, name: pipe},
            {
                **{n: io[n] for n in first},
                name: (
                    pipe.runner.free_source_tokens,
                    rest.sink_tokens[0] if len(rest.sink_tokens) == 1 else rest.sink_tokens,
                ),
            },
        )


class Machine(RuleBasedStateMachine):
    workers = 1

    @initialize(graph=graphs(), data=st.data())
    def begin(self, graph, data):
        functions, io, cuts = graph
        self.flat = ep.CompGraph(functions, io)
        self.hparams = {t: data.draw(VALUES) for t in self.flat.source_tokens if data.draw(st.booleans())}
        self.nest = Nest(functions, io, cuts, self.hparams)
        given = {token: value for token, value in self.hparams.items() if token in self.nest.cg.tokens}
        self.runner = ep.CompGraphRunner(self.nest.cg, given, workers=self.workers)
        self.model, self.has_run, self.ended = Model(self.flat, {}), False, []

    def calls(self):
        return {name: function.calls for name, function in self.flat.functions.items()}

    def attempt(self, run):
        for token, value in self.hparams.items():
            self.model.put(token, value)
        before = self.calls()
        called, failed = self.model.run(list(self.flat.functions))
        if failed:
            with pytest.raises(ArithmeticError):
                run()
        else:
            run()
        calls = {name: count - before[name] for name, count in self.calls().items()}
        if failed and self.workers > 1:
            calls = {name: count if name in called else max(count - 1, 0) for name, count in calls.items()}
        for name in [name for name in called if not calls[name]]:
            # A pipeline that was not called when an input changed, nor before it changed back, has missed nothing.
            function, inputs = self.flat.functions[name], self.flat.func_inputs(name)
            # In threads what was called beside a failed function is dropped.
            assert self.workers > 1 or function.last == tuple(self.model.values[token] for token in inputs)
            called.remove(name)
        assert calls == {name: int(name in called) for name in calls}
        self.has_run = True
        last = self.runner.last
        assert {self.nest.names[token] for token in self.hparams} == set(last.hyperparameters)
        self.ended.append((last, everything(last)))
        if not failed:
            assert everything(last).items() >= {(token, self.model.values[token]) for token in self.flat.tokens}

    @rule(data=st.data())
    def run(self, data):
        payload = {token: data.draw(VALUES) for token in self.runner.free_source_tokens}
        self.model = Model(self.flat, {})
        for token, value in payload.items():
            self.model.put(token, value)
        self.attempt(lambda: self.runner.run(**payload))

    @precondition(lambda self: self.has_run)
    @rule(data=st.data())
    def rerun(self, data):
        changes = self.draw_changes(data)
        self.attempt(lambda: self.runner.rerun(**{self.nest.names[token]: changes[token] for token in changes}))

    @rule(data=st.data())
    def set(self, data):
        changes = self.draw_changes(data)
        self.runner.set(**{self.nest.names[token]: value for token, value in changes.items()})

    def draw_changes(self, data):
        names = data.draw(st.lists(st.sampled_from(sorted(self.hparams)), max_size=2)) if self.hparams else []
        changes = {token: data.draw(VALUES) for token in names}
        self.hparams.update(changes)
        return changes

    @precondition(lambda self: self.nest.owners)
    @rule(data=st.data())
    def set_in_the_pipeline(self, data):
        token = data.draw(st.sampled_from(sorted(self.nest.owners)))
        pipe, value = self.nest.owners[token], data.draw(VALUES)
        if pipe[token] != value:
            pipe[token] = self.hparams[token] = value

    @precondition(lambda self: self.has_run)
    @rule(data=st.data())
    def try_out(self, data):
        before = dict(self.hparams)
        changes, seen = self.draw_changes(data), self.runner.last
        self.hparams = before
        values = {self.nest.names[token]: value for token, value in changes.items()}
        count = {name: function.calls for name, function in self.flat.functions.items()}
        run = self.runner.trial(values)
        for name, function in self.flat.functions.items():
            function.calls = count[name]
        assert self.runner.last is seen
        fresh = Model(self.flat, {})
        for token, value in {**{t: self.model.values[t] for t in self.flat.source_tokens}, **before, **changes}.items():
            fresh.put(token, value)
        _, failed = fresh.run(list(self.flat.functions))
        assert bool(run.failure) == failed
        if not failed:
            assert everything(run).items() >= {(token, fresh.values[token]) for token in self.flat.tokens}

    @invariant()
    def what_can_be_read_is_that_of_the_flat_graph(self):
        now = Model(self.flat, {})
        now.values, now.versions, now.ran = dict(self.model.values), dict(self.model.versions), self.model.ran
        now.count = self.model.count
        for token, value in self.hparams.items():
            now.put(token, value)
            assert self.runner[self.nest.names[token]] == value
        for token in self.nest.cg.tokens if self.has_run else ():
            try:
                value = self.runner[token]
            except NotComputed:
                continue
            assert now.is_fresh(token)
            assert value == now.values[token]
        if self.has_run and all(map(now.is_fresh, self.flat.tokens)):
            assert self.runner.stale == ()

    @invariant()
    def runs_never_change(self):
        for run, values in self.ended[-5:]:
            assert everything(run) == values


def everything(run):
    """Return the values of a run's tokens, those inside pipelines included."""
    found = dict(run) | {name.rpartition("__")[2]: value for name, value in run.hyperparameters.items()}
    for inner in run.nested.values():
        found |= everything(inner)
    return found


@pytest.mark.slow
@pytest.mark.fuzz
@pytest.mark.parametrize("way", ["the loop", "compiled at once", "in threads"])
def test_a_graph_with_pipelines_computes_what_the_flat_graph_does_and_nothing_runs_in_vain(way, monkeypatch):
    monkeypatch.setattr(execute, "RUNS_BEFORE", 0 if way == "compiled at once" else 10_000)
    Machine.workers = 1
    if way == "in threads":
        Machine.workers = 2
        monkeypatch.setattr(execute, "has_independent_steps", lambda program: True)
        monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
    run_state_machine_as_test(Machine, settings=settings(max_examples=min(settings.default.max_examples, 500)))
