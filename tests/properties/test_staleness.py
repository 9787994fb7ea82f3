"""After any sequence of edits, what can be read equals a from-scratch run, and nothing ran in vain."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import epypes as ep
from epypes.errors import NotComputed

PRIME = 10_007


class Recorded:
    """A function of integers that records what it was called with; fails on multiples of seven if told so."""

    def __init__(self, index: int, outputs: int, fails: bool):
        self.index, self.outputs, self.fails = index, outputs, fails
        self.calls: list[tuple[int, ...]] = []

    def __call__(self, *args):
        self.calls.append(args)
        total = (self.index + 1) * 31 + sum((place + 2) * arg for place, arg in enumerate(args))
        if self.fails and total % 7 == 0:
            raise ArithmeticError(total)
        values = tuple((total * (place + 3)) % PRIME for place in range(self.outputs))
        return values if self.outputs != 1 else values[0]


@st.composite
def graphs(draw):
    """Return functions, io and hyperparameter names of a random bipartite DAG."""
    functions, io = {}, {}
    tokens = [f"s{index}" for index in range(draw(st.integers(1, 4)))]
    sources = list(tokens)
    for index in range(draw(st.integers(1, 8))):
        inputs = draw(st.lists(st.sampled_from(tokens), max_size=3))
        count = draw(st.integers(0, 3))
        outputs = [f"t{index}_{place}" for place in range(count)]
        functions[f"f{index}"] = (index, count, draw(st.booleans()) and draw(st.booleans()))
        io[f"f{index}"] = (tuple(inputs), outputs[0] if count == 1 else tuple(outputs) if outputs else None)
        tokens += outputs
    return functions, io, sources, tokens


def build(functions, io):
    return ep.CompGraph({name: Recorded(*made) for name, made in functions.items()}, io)


def attempt(runner, call):
    """Run, and return the run even if a function failed."""
    try:
        return call()
    except ArithmeticError:
        return runner.last


def from_scratch(functions, io, hparams, payload, *targets):
    runner = ep.CompGraphRunner(build(functions, io), hparams)
    return attempt(runner, lambda: runner.run(*targets, **payload))


@settings(max_examples=150, deadline=None)
@given(graphs(), st.data())
def test_readable_tokens_always_equal_a_run_from_scratch(parts, data):
    functions, io, sources, _ = parts
    cg = build(functions, io)
    used = [token for token in sources if token in cg.tokens]
    hparams = dict.fromkeys(used[: len(used) // 2 + 1], 1)
    payload = {token: 2 for token in used if token not in hparams}
    runner = ep.CompGraphRunner(cg, hparams)
    attempt(runner, lambda: runner.run(**payload))
    edits = st.dictionaries(st.sampled_from(sorted(hparams)), st.integers(0, 5), max_size=2) if hparams else st.just({})
    wanted = st.lists(st.sampled_from(cg.tokens), max_size=2) if cg.tokens else st.just([])
    for changes, targets in data.draw(st.lists(st.tuples(edits, wanted), min_size=1, max_size=5)):
        before = {name: len(function.calls) for name, function in cg.functions.items()}
        for token, value in changes.items():
            runner[token] = value
        hparams.update(changes)
        stale = set(runner.stale)
        run = attempt(runner, lambda targets=targets: runner.rerun(*targets))
        times = {name: len(function.calls) - before[name] for name, function in cg.functions.items()}
        assert {name for name, count in times.items() if count} <= stale, "a function ran whose inputs did not change"
        assert max(times.values(), default=0) <= 1
        check_against_scratch(run, from_scratch(functions, io, hparams, payload), functions, io, hparams, payload)


def check_against_scratch(run, expected, functions, io, hparams, payload):
    for token in run.cg.tokens:
        if token not in run:
            with pytest.raises(NotComputed):
                run[token]
        elif token in expected:
            assert run[token] == expected[token]
        else:
            # The run from scratch ended in a failure before it came here; the token by itself must be reachable.
            assert from_scratch(functions, io, hparams, payload, token)[token] == run[token]
