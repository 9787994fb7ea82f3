"""After any sequence of edits, what can be read equals a run from scratch, and nothing ran in vain.

A machine edits, runs and reads a random graph beside a model of a few lines: a dictionary of values, each with a
version, and for each function the versions that it last ran with. Values are integers, None and Nothing; functions have
any number of inputs and outputs, fail now and then, find nothing, are switches or placeholders. A function that is given
Nothing is not called.
"""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
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
from epypes.errors import NotComputed, PayloadError, PlaceholderNeeded
from epypes.run import execute
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.program import Program

NOT_COMPUTED = object()
VALUES = st.integers(0, 4)


class Recorded:
    """A function of integers and None that counts its calls; fails on some inputs, and finds nothing on others."""

    def __init__(self, index: int, outputs: int, fails: bool):
        self.index, self.outputs, self.fails = index, outputs, fails
        self.calls = 0

    def compute(self, *args):
        total = (self.index + 1) * 31 + sum(
            (place + 2) * (-3 if arg is None else arg) for place, arg in enumerate(args)
        )
        if self.fails and total % 5 == 0:
            raise ArithmeticError(total)
        if total % 11 == 0:
            return ep.Nothing
        values = tuple(self.value(total + place) for place in range(self.outputs))
        return values if self.outputs != 1 else values[0]

    def value(self, number):
        return None if number % 7 == 0 else ep.Nothing if number % 6 == 0 else number % 4

    def __call__(self, *args):
        assert ep.Nothing not in args
        self.calls += 1
        return self.compute(*args)


@st.composite
def graphs(draw, placeholders=True):
    """Return functions and io of a random graph, its source tokens and the selectors of its switches."""
    functions, io, selectors = {}, {}, {}
    tokens = [f"s{index}" for index in range(draw(st.integers(1, 3)))]
    sources = list(tokens)
    for index in range(draw(st.integers(1, 8))):
        kind = draw(st.sampled_from(["plain"] * 6 + ["switch", "placeholder"]))
        inputs = tuple(draw(st.lists(st.sampled_from(tokens), max_size=3)))
        name, made = f"f{index}", [f"t{index}_{place}" for place in range(draw(st.integers(0, 3)))]
        if kind == "switch" and inputs:
            selector = f"by{index}"
            graph = ep.switch(name, dict(enumerate(inputs)), by=selector, output=f"t{index}")
            functions[name], io[name] = graph.functions[name], graph.func_io[name]
            selectors[selector], made = len(inputs), [f"t{index}"]
            sources.append(selector)
        else:
            fails = draw(st.integers(0, 4)) == 0
            functions[name] = Recorded(index, len(made), fails)
            io[name] = (inputs, made[0] if len(made) == 1 else tuple(made) if made else None)
            if kind == "placeholder" and placeholders:
                functions[name] = ep.Placeholder()
        tokens += made
    return functions, io, sources, selectors


class Model:
    """What the runner must know, in a few lines."""

    def __init__(self, cg, selectors):
        self.cg, self.selectors = cg, selectors
        self.values, self.versions, self.ran = {}, {}, {}
        self.count = itertools.count(1)

    def put(self, token, value):
        if token not in self.values or self.values[token] is NOT_COMPUTED or self.values[token] != value:
            self.values[token], self.versions[token] = value, next(self.count)

    def reads(self, name):
        inputs = self.cg.func_inputs(name)
        if name in self.cg.switches and inputs[0] in self.values:
            return inputs[0], inputs[1 + self.values[inputs[0]]]
        return inputs

    def used(self, name):
        return tuple((token, self.versions.get(token)) for token in self.reads(name))

    def wanted(self, targets):
        if targets:
            found, pending = set(), [self.cg.digraph.producer.get(token) for token in targets]
            while pending:
                name = pending.pop()
                if name is not None and name not in found:
                    found.add(name)
                    pending += [self.cg.digraph.producer.get(token) for token in self.reads(name)]
            return [name for name in self.cg.functions if name in found]
        kept = []
        for name in reversed(self.cg.functions):
            readers = [
                (reader, token)
                for token in self.cg.func_outputs(name)
                for reader in self.cg.digraph.consumers.get(token, ())
            ]
            has_sink = any(token in self.cg.sink_tokens for token in self.cg.func_outputs(name))
            if (
                not readers
                or has_sink
                or any(reader in kept and token in self.reads(reader) for reader, token in readers)
            ):
                kept.append(name)
        return kept[::-1]

    def missing(self, wanted):
        read = {token for name in wanted for token in self.reads(name)}
        return {token for token in read if token in self.cg.source_tokens and token not in self.values}

    def run(self, wanted):
        """Run what is out of date; return the functions that were called and whether one failed."""
        called = []
        for name in wanted:
            if self.ran.get(name) == self.used(name):
                continue
            function, inputs = self.cg.functions[name], [self.values[token] for token in self.reads(name)]
            outputs = self.cg.func_outputs(name)
            if ep.Nothing in inputs:
                made = ep.Nothing
            else:
                called.append(name)
                try:
                    made = inputs[1] if name in self.cg.switches else function.compute(*inputs)
                except ArithmeticError:
                    self.forget(name)
                    return called, True
            self.ran[name] = self.used(name)
            made = [made] * len(outputs) if made is ep.Nothing or len(outputs) == 1 else made
            for token, value in zip(outputs, made, strict=True):
                self.put(token, value)
        return called, False

    def forget(self, name):
        self.ran.pop(name, None)
        for token in self.cg.func_outputs(name):
            self.values[token] = NOT_COMPUTED
            for reader in self.cg.digraph.consumers.get(token, ()):
                if token in self.reads(reader):
                    self.forget(reader)

    def is_fresh(self, token):
        maker = self.cg.digraph.producer.get(token)
        if maker is None:
            return token in self.values
        reads = self.reads(maker)
        return self.ran.get(maker) == self.used(maker) and all(map(self.is_fresh, reads))


class Machine(RuleBasedStateMachine):
    workers = 1

    @initialize(graph=graphs(), data=st.data())
    def begin(self, graph, data):
        self.functions, self.io, self.sources, self.selectors = graph
        self.sources = [token for token in self.sources if any(token in read for read, _ in self.io.values())]
        hparams = [token for token in self.sources if token in self.selectors or data.draw(st.booleans())]
        self.hparams = {token: self.draw_value(data, token) for token in hparams}
        self.start()

    def start(self):
        self.cg = ep.CompGraph(self.functions, self.io)
        self.runner = ep.CompGraphRunner(self.cg, self.hparams, workers=self.workers)
        self.model = Model(self.cg, self.selectors)
        self.has_run = False

    def draw_value(self, data, token):
        if token in self.selectors:
            return data.draw(st.integers(0, self.selectors[token] - 1))
        return data.draw(st.one_of(VALUES, st.none(), st.just(ep.Nothing)))

    def draw_targets(self, data):
        return data.draw(st.lists(st.sampled_from(self.cg.tokens), max_size=2)) if self.cg.tokens else []

    def calls(self):
        return {name: function.calls for name, function in self.cg.functions.items() if isinstance(function, Recorded)}

    def attempt(self, run, targets):
        """Run in the runner and in the model; both must call the same functions and end in the same way."""
        values, versions = dict(self.model.values), dict(self.model.versions)
        for token, value in self.hparams.items():
            self.model.put(token, value)
        wanted, before = self.model.wanted(targets), self.calls()
        placeholders = [name for name in wanted if name in self.cg.placeholders]
        missing = set() if placeholders else self.model.missing(wanted)
        if placeholders or missing:
            with pytest.raises(PlaceholderNeeded if placeholders else PayloadError) as error:
                run()
            told = error.value.functions if placeholders else error.value.tokens
            assert set(told) == set(placeholders or missing)
            self.model.values, self.model.versions = values, versions  # the last run stands
            return
        called, failed = self.model.run(wanted)
        if failed:
            with pytest.raises(ArithmeticError):
                run()
        else:
            run()
        self.has_run = True
        calls = {name: count - before[name] for name, count in self.calls().items()}
        if failed and self.workers > 1:
            # Others may have been called beside the one that failed; what they made is dropped.
            calls = {name: count if name in called else max(count - 1, 0) for name, count in calls.items()}
        assert calls == {name: int(name in called) for name in calls}
        report = self.runner.last.report
        assert report.ran == tuple(called)
        if not failed:
            # Of those that were wanted; others may have been skipped in an earlier run.
            skipped = [
                name for name in wanted if ep.Nothing in [self.model.values[token] for token in self.model.reads(name)]
            ]
            assert report.skipped == tuple(skipped)
            assert not {*report.skipped} & {*report.ran, *report.reused}

    @rule(data=st.data())
    def run(self, data):
        free = [token for token in self.sources if token not in self.hparams]
        given = [token for token in free if data.draw(st.integers(0, 9))]
        payload = {token: self.draw_value(data, token) for token in given}
        targets = self.draw_targets(data)
        fresh = Model(self.cg, self.selectors)
        for token, value in payload.items():
            fresh.put(token, value)
        old, self.model = self.model, fresh
        count = len(self.runner.reports)
        self.attempt(lambda: self.runner.run(*targets, **payload), targets)
        if len(self.runner.reports) == count:
            self.model = old  # refused: the last run stands

    @precondition(lambda self: self.has_run)
    @rule(data=st.data())
    def rerun(self, data):
        changes = {}
        if self.hparams:
            changed = data.draw(st.lists(st.sampled_from(sorted(self.hparams)), max_size=2, unique=True))
            changes = {token: self.draw_value(data, token) for token in changed}
        self.hparams.update(changes)
        targets = self.draw_targets(data)
        self.attempt(lambda: self.runner.rerun(*targets, **changes), targets)

    @precondition(lambda self: self.hparams)
    @rule(data=st.data())
    def set(self, data):
        token = data.draw(st.sampled_from(sorted(self.hparams)))
        self.runner[token] = self.hparams[token] = self.draw_value(data, token)

    @rule(data=st.data())
    def freeze_or_unfreeze(self, data):
        tokens = [token for token in self.sources if token not in self.selectors]
        if not tokens:
            return
        token = data.draw(st.sampled_from(tokens))
        if token in self.hparams:
            del self.hparams[token]
            self.runner.unfreeze(token)
        else:
            self.hparams[token] = self.draw_value(data, token)
            self.runner.freeze(**{token: self.hparams[token]})

    @precondition(lambda self: self.cg.placeholders)
    @rule(data=st.data())
    def fill(self, data):
        name = data.draw(st.sampled_from(self.cg.placeholders))
        outputs = self.cg.func_outputs(name)
        self.functions = {**self.functions, name: Recorded(99, len(outputs), False)}
        self.cg = ep.extend(self.cg, {name: self.functions[name]})
        self.start()

    @invariant()
    def what_can_be_read_is_what_the_model_says(self):
        now = Model(self.cg, self.selectors)
        now.values, now.versions, now.ran = dict(self.model.values), dict(self.model.versions), self.model.ran
        now.count = self.model.count
        for token, value in self.hparams.items():
            now.put(token, value)
        for token in self.cg.tokens:
            if now.is_fresh(token) and (self.has_run or token in self.hparams):
                assert self.runner[token] == now.values[token]
                assert token in self.runner
            else:
                with pytest.raises(NotComputed):
                    self.runner[token]
                assert token not in self.runner


@pytest.mark.slow
@pytest.mark.fuzz
@pytest.mark.parametrize("way", ["the loop", "compiled at once", "in threads"])
def test_after_any_edits_what_is_read_equals_a_run_from_scratch_and_nothing_runs_in_vain(way, monkeypatch):
    monkeypatch.setattr(execute, "RUNS_BEFORE", 0 if way == "compiled at once" else 10_000)
    Machine.workers = 1
    if way == "in threads":
        Machine.workers = 2
        monkeypatch.setattr(execute, "has_independent_steps", lambda program: True)
        monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
    run_state_machine_as_test(Machine, settings=settings())


@pytest.mark.slow
@pytest.mark.fuzz
@given(graphs(placeholders=False), st.data())
def test_side_by_side_ends_as_one_after_another(graph, data):
    functions, io, _, selectors = graph
    cg = ep.CompGraph(functions, io)
    program = Program(cg, True)
    values = [
        0 if token in selectors else data.draw(VALUES) if program.makers[slot] < 0 else NOT_COMPUTED
        for slot, token in enumerate(cg.tokens)
    ]
    ends = []
    for run in (execute.run_one_by_one, lambda tokens: execute.SideBySide(tokens, 3).run()):
        tokens = Hyperparameters(program, {}).tokens({}, ())
        tokens.values[:], failed = values, None
        try:
            run(tokens)
        except ArithmeticError:
            failed = tokens.running
        ends.append((tokens.values, bytes(tokens.dirty), set(tokens.durations_ns), failed))
    assert ends[0] == ends[1]
