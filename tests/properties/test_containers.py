"""Whatever functions do to their inputs, each run computes what the functions compute one after another on copies.

The values are containers and arrays; the functions change them in place, pass them on, hold them and use them again.
"""

from __future__ import annotations

import bisect
import collections
import copy
import heapq
import operator

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.run import execute

pytestmark = [pytest.mark.slow, pytest.mark.fuzz]

KINDS = {
    "list": lambda n: [n, n + 2, n + 4],
    "dict": lambda n: {0: n, n: 1},
    "set": lambda n: {n, n + 1},
    "deque": lambda n: collections.deque([n, 3]),
    "bytes": lambda n: bytearray([n, 3]),
    "array": lambda n: np.full((3, 3), n, np.uint8),
    "rec": lambda n: np.rec.array([(n, 1), (n, 2)]),
    "arrays": lambda n: [np.full(2, n), np.full(2, n + 1)],
    "table": lambda n: {"a": np.full(2, n), "b": n},
}


def written(x, k):
    x[...] = k
    return x.sum()


def spread(x, k):
    x["a"][:] = k
    return x


# What is done to a value of a kind and an integer; what comes of it is a value of a kind, or a number.
CHANGES = {
    "list": [heapq.heappush, bisect.insort, operator.iconcat, lambda x, k: heapq.heappop(x), lambda x, k: x.append(k),
             lambda x, k: (x.reverse(), x)[1], lambda x, k: x.clear()],
    "dict": [lambda x, k: operator.setitem(x, k, k), lambda x, k: x.update({k: 9}), lambda x, k: x.popitem(), lambda x, k: (x.clear(), x)[1]],
    "set": [lambda x, k: x.add(k), lambda x, k: operator.ior(x, {k}), lambda x, k: x.clear()],
    "deque": [lambda x, k: x.rotate(k), lambda x, k: operator.iadd(x, [k]), lambda x, k: x.popleft()],
    "bytes": [lambda x, k: x.append(k), lambda x, k: operator.delitem(x, 0), operator.iconcat],
    "array": [written, lambda x, k: setattr(x, "shape", (9,)), cv2.add, np.add, lambda x, k: x[1:], lambda x, k: cv2.blur(x, (3, 3))],
    "rec": [written, lambda x, k: operator.setitem(x, 0, (k, k)), lambda x, k: x[:1]],
    "arrays": [lambda x, k: operator.setitem(x[0], 0, k), lambda x, k: x.pop(), lambda x, k: (x.append(k), x)[1]],
    "table": [spread, lambda x, k: x.pop("a"), lambda x, k: operator.setitem(x, "b", k)],
}  # fmt: skip


class Held:
    """A function that makes a value once, changes it at each call, and returns the same one again."""

    def __init__(self, kind):
        self.kind, self.value = kind, KINDS[kind](1)

    def __call__(self, n):
        new = KINDS[self.kind](n)
        if isinstance(self.value, list) and self.kind == "arrays":
            for old, now in zip(self.value, new, strict=True):
                old[:] = now
        elif isinstance(self.value, np.ndarray | list | bytearray):
            self.value[:] = new
        else:
            self.value.clear()
            operator.iadd(self.value, new) if self.kind == "deque" else self.value.update(new)
        return self.value


def safely(function):
    """Return the function, whose failures are values too: a builtin as it is, where it can't fail."""
    if type(function) in (type(len), np.ufunc):
        return function

    def safe(*args):
        try:
            return function(*args)
        except Exception as error:
            return type(error).__name__

    return safe


@st.composite
def graphs(draw):
    functions, io, kinds = {}, {}, {}
    for number in range(draw(st.integers(1, 3))):
        kind, token = draw(st.sampled_from(sorted(KINDS))), f"t{number}"
        how = draw(st.sampled_from(["payload", "made", "held"]))
        if how != "payload":
            functions[f"make{number}"] = KINDS[kind] if how == "made" else Held(kind)
            io[f"make{number}"] = ("n", token)
        kinds[token] = kind
    for number in range(draw(st.integers(1, 6))):
        token, name = draw(st.sampled_from(sorted(kinds))), f"change{number}"
        functions[name] = safely(draw(st.sampled_from(CHANGES[kinds[token]])))
        more = draw(st.sampled_from(["k", "m"]))
        if functions[name] in (operator.iconcat, cv2.add):  # which want a value of the same kind
            more = token
        io[name] = ((token, more), f"c{number}")
    return ep.CompGraph(functions, io), kinds


def text(value):
    """Return a value as a text by which equal ones are known."""
    if isinstance(value, np.ndarray):
        return f"{type(value).__name__}{value.shape}{value.tolist()}"
    if isinstance(value, list | tuple | collections.deque):
        return f"{type(value).__name__}{[*map(text, value)]}"
    if isinstance(value, dict):
        return f"dict{[(key, text(item)) for key, item in value.items()]}"
    return f"{type(value).__name__}{sorted(value) if isinstance(value, set) else value}"


def locked(value):
    """Return a copy of a value, whose arrays can't be written to, as functions get them."""
    value = copy.deepcopy(value)
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else [value]
    for item in items:
        if isinstance(item, np.ndarray):
            item.flags.writeable = False
    return value


def straight(cg, values):
    """Return the values of all tokens, each function being given copies of its own."""
    values = dict(values)
    for name, function in cg.functions.items():
        (made,) = cg.func_outputs(name)
        values[made] = copy.deepcopy(function(*(locked(values[token]) for token in cg.func_inputs(name))))
    return {token: text(value) for token, value in values.items() if cg.has_token(token)}


@pytest.mark.parametrize("way", ["the loop", "compiled", "in threads"])
def test_no_function_spoils_what_another_reads_nor_an_earlier_run(way):
    @given(graphs(), st.lists(st.tuples(st.booleans(), st.integers(0, 5)), min_size=2, max_size=7))
    def check(drawn, edits):
        cg, kinds = drawn
        payload = {token: KINDS[kind](2) for token, kind in kinds.items() if token in cg.source_tokens}
        before = text([*payload.values()])
        hparams = {token: 1 for token in ("n", "k", "m") if cg.has_token(token)}
        runner = ep.CompGraphRunner(cg, hparams, workers=1 + (way == "in threads"))
        runner.run(**payload)
        runs = []
        for again, number in edits:
            token = [*hparams][number % len(hparams)] if hparams else None
            if token is not None:
                hparams[token] = number
                runner[token] = number
            runs.append((runner.run(**payload) if again else runner.rerun(), straight(cg, {**payload, **hparams})))
        for run, expected in runs:
            assert {token: text(run[token]) for token in cg.tokens} == expected
        assert text([*payload.values()]) == before

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execute, "RUNS_BEFORE", 0 if way == "compiled" else 10_000)
        if way == "in threads":
            patch.setattr(execute, "has_independent_steps", lambda program: True)
            patch.setattr(execute.Gain, "is_worth_it", lambda self: True)
        check()
