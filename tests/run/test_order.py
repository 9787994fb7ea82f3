"""The same graph gives the same order of everything, whatever the hash seed is."""

from __future__ import annotations

import pytest

from tests.seeds import printed

PROGRAM = """
import epypes as ep
from epypes.errors import EpypesError

def sum_of(*values):
    return sum(values)

def pair(*values):
    return sum(values), len(values)

def told(run):
    try:
        run()
    except EpypesError as error:
        print(type(error).__name__, error)

names = "kiwi fig apple date banana cherry elder grape".split()
one = ep.CompGraph(
    {**dict.fromkeys(names[:4], sum_of), **dict.fromkeys(names[4:], pair)},
    {
        "kiwi": (("zeta", "alpha"), "lime"), "fig": ("lime", "olive"), "apple": (("mu", "lime"), "pear"),
        "date": ("olive", "plum"), "banana": (("pear", "plum"), ("yam", "beet")), "cherry": ("alpha", ("corn", "leek")),
        "elder": (("beet", "corn", "nu"), ("kale", "rice")), "grape": (("xi", "nu"), ("rye", "oat")),
    },
)
two = ep.union(one, one, suffixes=("_1", "_2"), keep=("nu", "alpha", "grape", "xi", "rye", "oat"))
cg = ep.extend(
    two | ep.switch("choose", {"l": "kale_1", "r": "kale_2"}, by="method", output="chosen"),
    {"zest": sum_of, "adze": sum_of},
    {"zest": (("chosen", "rice_1", "omega"), "end"), "adze": (("end", "psi"), "last")},
)
print(cg.tokens, cg.source_tokens, cg.sink_tokens, list(cg.functions), list(cg.func_io), list(cg.defaults))
hparams = dict(method="r", omega=1, psi=2, nu=3)
for workers in (1, 2):
    runner = ep.CompGraphRunner(cg, hparams, workers=workers)
    print(runner.free_source_tokens, list(runner.hyperparameters), runner.stale, runner.plan(), dict(runner.plan().why))
    told(lambda: runner.run(zeta_1=1))
    told(lambda: runner.run(xie=1))
    for value in range(6):
        run = runner.run(**dict.fromkeys(runner.free_source_tokens, value))
        runner.rerun(omega=value, psi=value)
    print(list(run.items()), run.report.ran, list(runner.keys()), list(runner.last))
    for changes in (dict(method="l"), dict(nu=4), dict(omega=7, nu=5)):
        for token, value in changes.items():
            runner[token] = value
        plan = runner.plan()
        print(runner.stale, plan.order, plan.reused, plan.left_out, dict(plan.why), dict(plan.branches))
        print(runner.rerun().report.ran, runner.last.report.reused)
    plan = runner.plan("kale_2", "plum_1")
    print(plan.order, plan.reused, plan.left_out, list(ep.subgraph(cg, ["leek_2", "plum_1", "rye"]).functions))
told(lambda: ep.CompGraph({name: sum_of for name in "dbca"}, {"d": ("p", "q"), "b": ("q", "p"), "c": ("r", "q"), "e": (7,)}))
told(lambda: one | ep.CompGraph(dict.fromkeys(names, abs), {name: ("x", "y" + name) for name in names}))
told(lambda: ep.extend(cg, {name + "_1": abs for name in names}))
told(lambda: ep.union(one, one, suffixes=("_1", "_2"), keep=("nope",)))
sketch = ep.CompGraph({name: ep.Placeholder() for name in names}, {name: ("x", name) for name in names})
told(lambda: ep.CompGraphRunner(sketch).run(x=1))
"""


@pytest.mark.slow
def test_what_is_joined_planned_and_run_has_one_order_under_any_hash_seed():
    texts = printed(PROGRAM)
    assert len(texts) == 1
    (text,) = texts
    assert text.count("\n") > 30, "the program has come to its end"
    assert "PlaceholderNeeded Functions 'kiwi', 'fig', 'apple'" in text
