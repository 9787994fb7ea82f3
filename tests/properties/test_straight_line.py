"""Any graph, written as one function, computes what its runner computes, and a linter has nothing against it."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.errors import SourceRefused
from epypes.graph import needed_for

pytestmark = pytest.mark.slow  # many graphs are written and run

RUFF = shutil.which("ruff", path=str(Path(sys.executable).parent)) or "ruff"
LOG: list[tuple] = []


def mixed(*values):
    return zlib.crc32(repr(values).encode())


def two(*values):
    return mixed(values, 1), mixed(values, 2)


def five_values_that_have_a_function_of_a_long_name(*values):
    return [mixed(values, number) for number in range(5)]


def lone(*values):
    return (mixed(*values),)


def some(*values):
    value = mixed(values)
    return value if value % 3 else ep.Nothing


def seen(*values):
    LOG.append(values)


MAKERS = {"mixed": (mixed, "1"), "two": (two, 2), "five": (five_values_that_have_a_function_of_a_long_name, 5),
          "lone": (lone, 1), "some": (some, "1"), "seen": (seen, 0), "max": (max, "1")}  # fmt: skip
ODD = ["x y", "lambda", "zlib", "l", "O", "ValueError", "größe", "画像", "画像 1", "ﬁ", "a.b", "x" * 60, "1st", "\n", '"""',
       "match", "max", "tests", "print", "__debug__", "run_graph", "None", "_", "a", "a_", "a__2", "A", "\\", "e\u0301", "a\u00a0b",
       "number_of_octave_layers_in_pyramid", "가", "\u200b", "\U0001d431", "if", "if_", "'\"", "lambda ", "z" * 30, "f(x)", "{x}", "\ud800"]  # fmt: skip
VALUES = st.one_of(
    st.integers(),
    st.floats(allow_nan=False),
    st.text(max_size=30),
    st.binary(max_size=9),
    st.sampled_from([None, True, -0.0, float("inf"), 1e16, 1e-7, 1 + 2j, {}, {"a": [1, (2,)]}, max, "\\'\"", '"']),
    st.recursive(st.integers() | st.text(max_size=9), lambda inner: st.lists(inner) | st.lists(inner).map(tuple)),
    st.dictionaries(st.text(max_size=9), st.lists(st.integers())),
)
KEYS = st.lists(
    st.one_of(st.integers(-5, 5), st.text(max_size=70), st.sampled_from([None, (1, "a"), 0.5])),
    min_size=1,
    max_size=4,
    unique_by=lambda key: (key,),
)


@st.composite
def graphs(draw):
    """Return a graph, its hyperparameters, and what each switch may choose by."""
    names = iter(draw(st.permutations(ODD)) + [f"t{number}" for number in range(99)])
    functions, io, hparams, choices, known = {}, {}, {}, {}, []
    for number in range(draw(st.integers(1, 9))):
        name = f"f{number}"
        if known and draw(st.integers(0, 3)) == 0:
            keys = draw(KEYS)
            selector = next(names)
            branches = {key: draw(st.sampled_from(known)) for key in keys}
            part = ep.switch(name, branches, by=selector, output=next(names))
            functions |= part.functions
            io |= part.func_io
            choices[selector] = keys
            known.append(io[name][1])
            continue
        kind = draw(st.sampled_from(sorted(MAKERS)))
        function, count = MAKERS[kind]
        fresh = [next(names) for _ in range(draw(st.integers(0 if known else 1, 3)))]
        given = [*fresh, *(draw(st.lists(st.sampled_from(known), max_size=4)) if known else ())]
        for token in fresh:
            if kind != "max" and draw(st.booleans()):
                hparams[token] = draw(VALUES)
        given = (given or known[:1]) * (2 if kind == "max" and len(given or "1") == 1 else 1)
        made = [next(names) for _ in range(int(count))]
        known += [*fresh, *made] if kind != "max" and not set(fresh) & set(hparams) else made
        functions[name] = function
        io[name] = (
            tuple(given),
            made[0] if count == "1" else tuple(made) if made else draw(st.sampled_from([None, ()])),
        )
    cg = ep.CompGraph(functions, io)
    return cg, hparams, {token: keys for token, keys in choices.items() if cg.has_token(token)}


def ruff_says(text: str) -> str:
    """Return what ruff does not like, but for long lines: names and constants may be long, as they are."""
    command = [RUFF, "check", "--select", "F,E", "--ignore", "E501", "--output-format", "concise", "--quiet"]
    done = subprocess.run([*command, "--isolated", "--no-cache", "-"], input=text.encode(), capture_output=True)
    return (done.stdout + done.stderr).decode() if done.returncode else ""


@pytest.mark.fuzz
@given(graphs(), st.data())
def test_any_graph_written_as_a_function_computes_the_same(drawn, data):
    cg, hparams, choices = drawn
    hparams |= {token: data.draw(st.sampled_from(keys)) for token, keys in choices.items()}
    wanted = data.draw(st.none() | st.lists(st.sampled_from(cg.tokens), min_size=1, max_size=3))
    text = ep.to_source(cg, hparams, returns=wanted)
    text.encode("utf-8")
    assert ruff_says(text) == ""
    names: dict = {}
    exec(compile(text, "straight", "exec"), names)
    runner = ep.CompGraphRunner(cg, hparams)
    payload = {token: number for number, token in enumerate(runner.free_source_tokens)}
    LOG.clear()
    returned = wanted or cg.sink_tokens
    if wanted is None:
        runner.run(**payload)
    logged = LOG.copy()
    run = runner.run(*returned, **payload) if returned else {}
    LOG.clear()
    needed = {*ep.subgraph(cg, wanted).source_tokens, *wanted} if wanted else cg.source_tokens
    made = names["run_graph"](*(payload[token] for token in cg.source_tokens if token in payload and token in needed))
    expected = tuple(run[token] for token in returned)
    assert repr(made) == repr(expected[0] if len(expected) == 1 else expected or None)
    assert logged == LOG


@pytest.mark.fuzz
@given(graphs(), st.data())
def test_any_graph_with_state_takes_and_returns_what_a_series_of_runs_leaves(drawn, data):
    cg, hparams, choices = drawn
    free = [token for token in cg.source_tokens if token not in {**hparams, **choices}]
    previous = data.draw(st.lists(st.sampled_from(free), min_size=1, max_size=3, unique=True)) if free else []
    for token in previous:
        others = [other for other in cg.tokens if other not in {token, *hparams, *choices}]
        cg = ep.delay(cg, data.draw(st.sampled_from(others)), token, data.draw(st.integers(0, 9))) if others else cg
    wanted = data.draw(st.none() | st.lists(st.sampled_from(cg.sink_tokens), min_size=1)) if cg.sink_tokens else None
    try:
        text = ep.to_source(cg, hparams, returns=wanted)
    except SourceRefused as refused:
        if not all("only some branches of switches need it" in reason for reason in refused.reasons):
            raise
        return
    names: dict = {}
    exec(compile(text, "straight", "exec"), names)
    runner, state = ep.CompGraphRunner(cg, hparams), {}
    found = needed_for(cg, wanted)[0] if wanted else {*cg.tokens}
    taken, left = ([token for token in tokens if token in found] for tokens in (runner.free_source_tokens, cg.delays))
    for number in range(4):
        payload = {
            token: data.draw(st.sampled_from(choices[token])) if token in choices else number
            for token in runner.free_source_tokens
        }
        run, returned = runner.run(**payload), wanted or cg.sink_tokens
        LOG.clear()
        made = names["run_graph"](*(payload[token] for token in taken), **state)
        made, state = made if left else (made, {})
        expected = tuple(run[token] for token in returned)
        assert repr(made) == repr(expected[0] if len(expected) == 1 else expected or None)
        assert [*map(repr, state.values())] == [repr(run.state[token]) for token in left]
