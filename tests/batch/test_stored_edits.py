"""Failure 72: stored results of a named map survive an edit behind a wrapper or a method."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.batch.cache import function_digest
from epypes.errors import ScaleError
from tests.calls import log_to

# Each makes `f`; {} is what the user edits, 1 before and 2 after.
FORMS = {
    "lru_cache of a lambda": "f = lru_cache(lambda image: image.sum() * {})",
    "np.vectorize": "scale = np.vectorize(lambda pixel: pixel * {})\ndef f(image): return float(scale(image).sum())",
    "np.vectorize with types": "scale = np.vectorize(lambda pixel: pixel * {}, otypes=[float])\ndef f(image): return float(scale(image))",
    "class as a decorator": """
        class Logged:
            def __init__(self, function): self.function = function
            def __call__(self, image): return self.function(image)
        @Logged
        def f(image): return image.sum() * {}
        """,
    "decorated class with __call__": """
        def named(cls):
            cls.label = "scale"
            return cls
        @named
        class Scale:
            def __call__(self, image): return self.factor() * image.sum()
            def factor(self): return {}
        f = Scale()
        """,
    "method that calls another method": """
        class Scale:
            def run(self, image): return self.factor() * image.sum()
            def factor(self): return {}
        f = Scale().run
        """,
    "method of a base class": """
        class Base:
            def factor(self): return {}
        class Scale(Base):
            def run(self, image): return self.factor() * image.sum()
        f = Scale().run
        """,
    "method with slots": """
        class Scale:
            __slots__ = ("factor",)
            def run(self, image): return self.factor * image.sum()
        f = Scale().run
        f.__self__.factor = {}
        """,
    "property": """
        class Scale:
            @property
            def factor(self): return {}
            def run(self, image): return self.factor * image.sum()
        f = Scale().run
        """,
    "descriptor": """
        class Factor:
            def __get__(self, scale, owner): return {}
        class Scale:
            factor = Factor()
            def __call__(self, image): return self.factor * image.sum()
        f = Scale()
        """,
    "classmethod": """
        class Scale:
            @classmethod
            def factor(cls): return {}
            @classmethod
            def run(cls, image): return cls.factor() * image.sum()
        f = Scale.run
        """,
    "metaclass": """
        class Meta(type):
            def factor(cls): return {}
        class Scale(metaclass=Meta):
            @classmethod
            def run(cls, image): return cls.factor() * image.sum()
        f = Scale.run
        """,
    "singledispatch": """
        @singledispatch
        def f(image): raise TypeError
        @f.register
        def _(image: np.floating): return image.sum() * {}
        """,
    "partialmethod": """
        class Scale:
            def by(self, image, factor): return factor * image.sum()
            run = partialmethod(by, factor={})
        f = Scale().run
        """,
    "partial of a partial": "f = partial(partial(lambda factor, step, image: image.sum() * factor, {}), 1)",
    "nested closures": """
        def outer(factor):
            def middle():
                def inner(image): return image.sum() * factor
                return inner
            return middle()
        f = outer({})
        """,
    "decorator with wraps": """
        def logged(function):
            @wraps(function)
            def wrapper(image): return function(image)
            return wrapper
        @logged
        def f(image): return image.sum() * {}
        """,
    "default argument that is an object": """
        class Scale:
            def __init__(self, factor): self.factor = factor
        def f(image, scale=Scale({})): return image.sum() * scale.factor
        """,
    "dataclass": """
        @dataclass
        class Scale:
            factor: int = {}
            steps: list[int] = field(default_factory=list)
            def __call__(self, image): return image.sum() * self.factor
        f = Scale()
        """,
    "enumeration": """
        class Mode(Enum):
            FINE = 1
            @property
            def factor(self): return {}
        def f(image): return image.sum() * Mode.FINE.factor
        """,
    "value in a dict": "table = dict(gain=dict(factor={}))\ndef f(image): return image.sum() * table['gain']['factor']",
    "function in a list": "steps = [lambda image: image.sum() * {}]\ndef f(image): return steps[0](image)",
    "array of objects": """
        steps = np.empty(1, object)
        steps[0] = lambda image: image.sum() * {}
        def f(image): return steps[0](image)
        """,
    "attribute of a function": "def f(image): return image.sum() * f.factor\nf.factor = {}",
    "bound method of a dict": "get = dict(factor={}).get\ndef f(image): return image.sum() * get('factor')",
}
# What was edited is in an object, a list or a dict: run again. Edited code has to have another name in the store.
HELD_BY_OBJECTS = {
    "np.vectorize",
    "np.vectorize with types",
    "class as a decorator",
    "method with slots",
    "singledispatch",
    "default argument that is an object",
    "value in a dict",
    "function in a list",
    "array of objects",
    "bound method of a dict",
}
BEFORE = """
    from dataclasses import dataclass, field
    from enum import Enum
    from functools import lru_cache, partial, partialmethod, singledispatch, wraps
    import numpy as np
    """


def notebook(form: str, factor: int, **names: Any) -> Any:
    """Run the cells of a notebook in a kernel of their own; return the `f` of it."""
    namespace = {"__name__": "__main__", **names}
    exec(textwrap.dedent(BEFORE), namespace)
    exec(textwrap.dedent(FORMS[form].replace("{}", str(factor))), namespace)
    return namespace["f"]


def mapped(function: Any, store: Any) -> ep.Outcome:
    """Return what a map gives that stores under the name "n"."""
    runner = ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": ("image", "out")}))
    (outcome,) = ep.map(runner, [{"image": np.float64(4)}], store=store, name="n")
    return outcome


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_failure_72_no_stored_result_of_a_named_map_survives_an_edit_behind(form: str, tmp_path: Path) -> None:
    store, function = tmp_path / "r.sqlite", notebook(form, 1)
    before = mapped(function, store)
    assert before.values == {"out": 4.0}
    # Durations included: it was not run again.
    assert mapped(function, store) == mapped(notebook(form, 1), store) == before
    if form in HELD_BY_OBJECTS:
        assert mapped(notebook(form, 2), store).values == {"out": 8.0}
    else:
        with pytest.raises(ScaleError, match="the graph has changed"):
            mapped(notebook(form, 2), store)
    # What was stored of the first computation is of that.
    assert mapped(notebook(form, 1), store) == before


@pytest.mark.slow
def test_results_that_another_process_has_stored_are_taken_if_nothing_was_edited(tmp_path: Path) -> None:
    script = f"""
        from pathlib import Path
        from tests.batch.test_stored_edits import FORMS, mapped, notebook
        for number, form in enumerate(FORMS):
            print(form, mapped(notebook(form, 1), Path({str(tmp_path)!r}) / f"{{number}}.sqlite").total_ns)
        """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    root = Path(__file__).parents[2]
    first, second = (
        subprocess.check_output(
            command, cwd=root, env={**os.environ, "PYTHONHASHSEED": seed}, text=True, timeout=120
        ).splitlines()
        for seed in "05"
    )
    assert first == second
    assert len(first) == len(FORMS)


def test_a_graph_that_uses_what_nobody_can_see_through_is_run_again_each_time(tmp_path: Path) -> None:
    orb = [cv2.ORB_create(5)]
    calls: list[int] = []
    logger = log_to(calls.append)

    def count(image: Any) -> int:
        logger.info(1)
        return int(orb[0].getMaxFeatures())

    for expected in (5, 7):
        orb[0].setMaxFeatures(expected)
        with pytest.warns(UserWarning, match=r"The graph uses a 'ORB' as 'orb', .* every item is run again"):
            assert mapped(count, tmp_path / "r.sqlite").values == {"out": expected}
    assert len(calls) == 2


def test_a_function_that_keeps_what_it_has_seen_is_run_again(tmp_path: Path) -> None:
    seen: list[float] = []

    def count(image: Any) -> int:
        seen.append(image)
        return len(seen)

    assert [mapped(count, tmp_path / "r.sqlite").values["out"] for _ in range(3)] == [1, 2, 3]


MODULE = "GAIN = 1\ndef h(image): return image * {}\n"


def test_an_edited_module_that_is_not_loaded_again_stores_nothing_of_what_it_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old code is at work after the edit; what it gives is not what the edited one would give."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    file = tmp_path / "edited_helper.py"
    file.write_text(MODULE.format(1))
    helper = importlib.import_module("edited_helper")
    monkeypatch.delitem(sys.modules, "edited_helper")
    monkeypatch.setitem(sys.modules, "edited_helper", helper)
    file.write_text(MODULE.format(2))
    cg = ep.CompGraph({"h": helper.h}, {"h": ("image", "out")})
    (stale,) = ep.map(ep.CompGraphRunner(cg), [{"image": 4.0}], store=tmp_path / "r.sqlite")
    assert stale.values == {"out": 4.0}
    importlib.reload(helper)
    cg = ep.CompGraph({"h": helper.h}, {"h": ("image", "out")})
    (fresh,) = ep.map(ep.CompGraphRunner(cg), [{"image": 4.0}], store=tmp_path / "r.sqlite")
    assert fresh.values == {"out": 8.0}


@pytest.mark.parametrize("form", FORMS)
def test_trials_of_a_search_with_a_metric_that_was_edited_are_not_taken_for_its_own(form: str) -> None:
    one, again, other = (function_digest(notebook(form, factor)) for factor in (1, 1, 2))
    assert one == again != other
