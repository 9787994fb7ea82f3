"""What works in a notebook and fails elsewhere: it is promoted and replayed identical, or refused with the line named."""

from __future__ import annotations

import functools
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.promote import promote_notebook
from epypes.bundle.proof.compare import first_difference
from epypes.errors import PromotionRefused, SourceRefused
from tests.bundle.hostile import IMPORTS, MAGIC, MAGIC_INSIDE, PROMOTED, REFUSED, graph_cell, in_notebook


@pytest.fixture(scope="module")
def promoted(tmp_path_factory):
    """All that must be promoted, in one bundle, since each is proved in a process of its own."""
    cells = [cell for cell, _ in PROMOTED.values() if cell]
    functions = {name: source for _, used in PROMOTED.values() for name, source in used.items()}
    with pytest.MonkeyPatch.context() as monkeypatch:
        names = in_notebook(monkeypatch, IMPORTS, *cells, graph_cell(functions))
        runner = names["runner"]
        bundle = ep.promote(runner, tmp_path_factory.mktemp("hostile") / "b")
        loaded = ep.load(bundle.path)
        runs = [(runner.run(a=a), loaded.run(a=a)) for a in (runner.last["a"], runner.last["a"] + 5)]
    return SimpleNamespace(runs=runs, runner=runner, text=(bundle.path / "pipeline.py").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("case", PROMOTED)
def test_what_can_be_promoted_computes_the_same_also_on_another_input(case, promoted):
    for run, of_bundle in promoted.runs:
        for name in PROMOTED[case][1]:
            assert first_difference(run[f"{name}_made"], of_bundle[f"{name}_made"]) is None


@pytest.mark.parametrize("case", REFUSED)
def test_what_can_not_is_refused_with_its_line_and_a_way_out(case, monkeypatch, tmp_path):
    cell, function, words = REFUSED[case]
    monkeypatch.setenv("EPYPES_HOSTILE", "1")  # is put back in the end
    names = in_notebook(monkeypatch, cell, functools=functools, cv2=cv2, np=np)
    cg = ep.CompGraph({"f": eval(function, names)}, {"f": ("a", "b")})
    with pytest.raises(PromotionRefused) as error:
        ep.promote(ep.CompGraphRunner(cg), tmp_path / "b")
    assert len(error.value.reasons) == 2, "besides that nothing has been run"
    assert re.search(words, error.value.reasons[1])
    with pytest.raises(SourceRefused, match=words):
        ep.to_source(cg)


def notebook_file(path, *cells):
    import nbformat  # takes seconds

    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in cells]), path)
    return path


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.notebook
def test_restart_and_run_all_gives_the_same_bytes_as_the_live_notebook(promoted, tmp_path):
    """Magics and shell escapes stand between the cells; the last cell promotes what is promoted from outside too."""
    cells = [cell for cell, _ in PROMOTED.values() if cell]
    functions = {name: source for _, used in PROMOTED.values() for name, source in used.items()}
    live = f"_ = ep.promote(runner, {str(tmp_path / 'live' / 'b')!r})"
    functions["captured"] = "captured"
    path = notebook_file(tmp_path / "n.ipynb", IMPORTS, *cells, *MAGIC, graph_cell(functions), live)
    promote_notebook(path, "runner", tmp_path / "file" / "b")
    files = contents(tmp_path / "file" / "b")
    assert files == contents(tmp_path / "live" / "b")
    text = files["pipeline.py"].decode()
    assert "total_time = 36  # sum(range(9)) in the notebook\n" in text
    assert "# In a cell that is captured.\ndef captured(a):\n    return a + total_time\n" in text
    gone = [line for line in promoted.text.splitlines()[1:] if line not in text.splitlines()]
    assert gone == [], "in a kernel, all else is as in this process"


@pytest.mark.notebook
def test_magics_inside_of_functions_are_refused_by_line(tmp_path):
    functions = {name: name for name in ("shell", "magic", "timed")}
    path = notebook_file(tmp_path / "n.ipynb", IMPORTS, *MAGIC_INSIDE, graph_cell(functions))
    with pytest.raises(PromotionRefused) as error:
        promote_notebook(path, "runner", tmp_path / "b")
    words = (
        r"'shell' uses 'get_ipython' \(cell \[2\], line 2\), the notebook itself, as magics and shell escapes do",
        r"'magic' uses 'get_ipython' \(cell \[3\], line 2\)",
        r"'timed' has no source \(<timed exec>, line 1\)\. Define it in a cell without %%time",
    )
    assert len(error.value.reasons) == len(words)
    for reason, expected in zip(error.value.reasons, words, strict=True):
        assert re.search(expected, reason)


@pytest.mark.slow
def test_to_source_writes_all_of_it_too(promoted):
    text = ep.to_source(promoted.runner)
    names: dict = {}
    exec(compile(text, "straight", "exec", dont_inherit=True), names)
    made = dict(zip(promoted.runner.cg.sink_tokens, names["run_graph"](promoted.runner.last["a"]), strict=True))
    assert {token: first_difference(promoted.runner[token], value) for token, value in made.items()} == dict.fromkeys(
        made
    )
