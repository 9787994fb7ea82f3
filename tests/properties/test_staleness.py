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


@settings(max_examples=150, deadline=None)
@given(graphs(), st.data())
def test_readable_tokens_always_equal_a_run_from_scratch(parts, data):
    functions, io, sources, tokens = parts
    cg = build(functions, io)
    used = [token for token in sources if token in cg.tokens]
    hparams = {token: 1 for token in used[: len(used) // 2 + 1]}
    payload = {token: 2 for token in used if token not in hparams}
    runner = ep.CompGraphRunner(cg, hparams)
    try:
        runner.run(**payload)
    except ArithmeticError:
        pass
    for _ in range(data.draw(st.integers(1, 5))):
        changes = data.draw(
            st.dictionaries(st.sampled_from(sorted(hparams)), st.integers(0, 5), max_size=2) if hparams else st.just({})
        )
        targets = data.draw(st.lists(st.sampled_from(cg.tokens), max_size=2)) if cg.tokens else []
        before = {name: len(function.calls) for name, function in cg.functions.items()}
        for token, value in changes.items():
            runner[token] = value
        hparams.update(changes)
        stale = set(runner.stale)
        try:
            run = runner.rerun(*targets)
        except ArithmeticError:
            run = runner.last
        ran = {name for name, function in cg.functions.items() if len(function.calls) > before[name]}
        assert ran <= stale, "a function ran whose inputs did not change"
        assert all(len(function.calls) - before[name] <= 1 for name, function in cg.functions.items())

        fresh = ep.CompGraphRunner(build(functions, io), hparams)
        try:
            expected = fresh.run(**payload)
        except ArithmeticError:
            expected = fresh.last
        for token in run:
            if token in expected:
                assert run[token] == expected[token]
            else:
                # The fresh run stopped at a failure before it came here: it must be reachable by itself.
                assert ep.CompGraphRunner(build(functions, io), hparams).run(token, **payload)[token] == run[token]
        for token in set(cg.tokens) - set(run):
            with pytest.raises(NotComputed):
                run[token]
