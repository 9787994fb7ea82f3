"""What makes a stored result count as that of another computation, or of another item."""

from __future__ import annotations

import enum
import functools
import importlib
import os
import subprocess
import sys
import textwrap
import threading
import types
from collections.abc import Callable
from importlib import metadata
from multiprocessing import shared_memory
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.batch.cache import NoDigest, function_digest, payload_digest, value_digest, value_label
from epypes.errors import ScaleError
from tests.bundle.cells import cell
from tests.calls import log_to

# -- edited code ----------------------------------------------------------------------------------------------------

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
    "hook of an enumeration": """
        class Mode(Enum):
            FINE = 1
            COARSE = 2
            @classmethod
            def _missing_(cls, value): return cls({})
        def f(image): return image.sum() * Mode(9).value
        """,
    "factory of a dict of an own class": """
        class Table(defaultdict): pass
        table = Table(lambda: {})
        def f(image): return image.sum() * table.default_factory()
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
    "constant of an inner function": "def f(image): return (lambda: image.sum() * {})()",
    "array in a closure": """
        def scaled(table):
            def f(image): return image.sum() * table[0]
            return f
        f = scaled(np.full(2, {}))
        """,
    "global of an inner function": "gain = {}\ndef f(image): return sum((lambda y: y * gain)(y) for y in [image])",
    "default argument": "def f(image, gain={}): return image.sum() * gain",
}
BEFORE = """
    from collections import defaultdict
    from dataclasses import dataclass, field
    from enum import Enum
    from functools import lru_cache, partial, partialmethod, singledispatch, wraps
    import numpy as np
    """


def graph_of(function: Any, outputs: str = "out") -> ep.CompGraph:
    return ep.CompGraph({"f": function}, {"f": ("image", outputs)})


def notebook(form: str, factor: int) -> Any:
    """Run the cells of a notebook in a kernel of their own; return the `f` of it, which has no source."""
    namespace = {"__name__": "__main__"}
    exec(textwrap.dedent(BEFORE), namespace)
    exec(textwrap.dedent(FORMS[form].replace("{}", str(factor))), namespace)
    return namespace["f"]


def cell_of(form: str, factor: int) -> Any:
    """Return the `f` of a notebook's cell, which has its source."""
    return cell(textwrap.dedent(BEFORE) + textwrap.dedent(FORMS[form].replace("{}", str(factor))) + "\n")["f"]


def mapped(function: Any, store: Any, name: str | None = "n") -> ep.Outcome:
    """Return the one outcome of a map with a store."""
    runner = ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": ("image", "out")}))
    (outcome,) = ep.map(runner, [{"image": np.float64(4)}], store=store, name=name)
    return outcome


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_failure_72_no_stored_result_of_a_named_map_survives_an_edit_behind(form: str, tmp_path: Path) -> None:
    store, function = tmp_path / "r.sqlite", notebook(form, 1)
    before = mapped(function, store)
    assert before.values == {"out": 4.0}
    # Durations included: it was not run again.
    assert mapped(function, store) == mapped(notebook(form, 1), store) == before
    try:
        edited = mapped(notebook(form, 2), store)
    except ScaleError as refused:
        reason = str(refused)
        assert "the graph has changed" in reason
    else:
        # What was edited is in an object, a list or a dict.
        assert edited.values == {"out": 8.0}
    # What was stored of the first computation is of that.
    assert mapped(notebook(form, 1), store) == before


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_an_edited_cell_has_other_results(form: str, tmp_path: Path) -> None:
    store = tmp_path / "r.sqlite"
    before = mapped(cell_of(form, 1), store, None)
    assert mapped(cell_of(form, 1), store, None) == before
    assert mapped(cell_of(form, 2), store, None).values == {"out": 8.0}


@pytest.mark.parametrize("form", FORMS)
def test_a_metric_that_was_edited_has_another_digest(form: str) -> None:
    one, again, other = (function_digest(notebook(form, factor)) for factor in (1, 1, 2))
    assert one == again != other


def test_edited_code_that_no_text_can_be_made_of_is_refused_under_the_same_name(tmp_path: Path) -> None:
    lock = threading.Lock()

    def scaled(factor: int) -> Callable[[Any], float]:
        def scale(image: Any) -> float:
            with lock:
                return float(image.mean()) * factor

        return scale

    options: dict[str, Any] = {"store": tmp_path / "r.sqlite", "name": "n"}
    images = [np.ones((2, 2))]
    (first,) = ep.map(ep.CompGraphRunner(graph_of(scaled(1))), images, **options)
    (again,) = ep.map(ep.CompGraphRunner(graph_of(scaled(1))), images, **options)
    assert again == first
    for another in (graph_of(scaled(2)), graph_of(scaled(1), "other")):
        with pytest.raises(ScaleError, match="the graph has changed"):
            ep.map(ep.CompGraphRunner(another), images, **options)


@pytest.mark.slow
def test_results_that_another_process_has_stored_are_taken_if_nothing_was_edited(tmp_path: Path) -> None:
    script = f"""
        from pathlib import Path
        from tests.batch.test_cache import FORMS, mapped, notebook
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


def test_a_graph_with_an_object_that_has_no_digest_is_run_again_each_time(tmp_path: Path) -> None:
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


GAIN = 1


def test_a_global_counts_where_it_is_looked_up_and_not_as_an_attribute_of_that_name(monkeypatch: Any) -> None:
    functions = lambda image: GAIN, lambda image: image.GAIN
    before = [function_digest(function) for function in functions]
    monkeypatch.setitem(globals(), "GAIN", 2)
    after = [function_digest(function) for function in functions]
    assert [one == other for one, other in zip(before, after, strict=True)] == [False, True]


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


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """Write modules of somebody's own, and load them anew."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def written(**texts):
        for name, text in texts.items():
            file = tmp_path / f"{name}.py"
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
        for name in [name for name in sys.modules if name.startswith("own_")]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return importlib.import_module("own_functions").f

    yield written
    for name in [name for name in sys.modules if name.startswith("own_")]:
        del sys.modules[name]


HELPER = "def h(image):\n    return float(image.mean() * {})\n"
USING = {
    "the module itself": {"own_functions": "def f(image):\n    return float(image.mean() * {})\n"},
    "one that it imports": {
        "own_functions": "import own_h\ndef f(image):\n    return own_h.h(image)\n",
        "own_h": HELPER,
    },
    "one that a function imports": {
        "own_functions": "def f(image):\n    from own_h import h\n    return h(image)\n",
        "own_h": HELPER,
    },
    "one of a package": {
        "own_functions": "from own_p import f\n",
        "own_p/__init__": "from .inner import f\n",
        "own_p/inner": "from . import h\ndef f(image):\n    return h.h(image)\n",
        "own_p/h": HELPER,
    },
}


@pytest.mark.parametrize("texts", USING.values(), ids=USING)
def test_a_module_that_was_edited_is_another_computation(texts, modules, tmp_path):
    for factor in (1, 5):
        f = modules(**{name: text.replace("{}", str(factor)) for name, text in texts.items()})
        for _ in range(2):
            (found,) = ep.map(ep.CompGraphRunner(graph_of(f)), [np.ones((2, 2))], store=tmp_path / "r.sqlite")
            assert found.values == {"out": float(factor)}
    with ep.Store(tmp_path / "r.sqlite") as store:
        assert len(store.names("map")) == 2


def test_another_version_of_an_installed_package_is_another_computation(tmp_path: Path, monkeypatch: Any) -> None:
    runner = ep.CompGraphRunner(graph_of(cv2.mean))
    for _ in range(2):
        ep.map(runner, [np.ones((2, 2))], store=tmp_path / "r.sqlite")
        monkeypatch.setattr(metadata, "version", lambda name: "0.0.1")
        ep.map(runner, [np.ones((2, 2))], store=tmp_path / "r.sqlite")
    with ep.Store(tmp_path / "r.sqlite") as store:
        assert len(store.names("map")) == 2


# -- functions ------------------------------------------------------------------------------------------------------


def made(source: str, **names: Any) -> Any:
    """Return the function that source defines in a notebook where names have these values."""
    notebook = {"__name__": "__main__", **names}
    exec(textwrap.dedent(source), notebook)
    return notebook["metric"]


def within(limit: Any) -> Callable[..., Any]:
    return lambda tokens, case: tokens["y"] < limit


def of_module(text: str) -> types.ModuleType:
    module = types.ModuleType("ours")
    exec(text, vars(module))
    return module


CALLS = "def metric(tokens, case): return helper(tokens)"
READS = "def metric(tokens, case): return tokens['y'] + weights['a'][0].sum()"
ASKS = "def metric(tokens, case): return ours.far(tokens)"
CLASS = """
class Scale:
    factor = {factor}
    def apply(self, y): return y * self.factor{sign}2
def metric(tokens, case): return Scale().apply(tokens["y"])
"""
PAIRS = {
    "kinds of constants": (made("metric = lambda tokens, case: 1"), made("metric = lambda tokens, case: True")),
    "lambdas on one line": (lambda tokens, case: tokens["a"], lambda tokens, case: tokens["b"]),
    "keywords": (functools.partial(max, key=abs), functools.partial(max, key=len)),
    "functions called": (made(CALLS, helper=within(1)), made(CALLS, helper=within(2))),
    "globals": (made(READS, weights={"a": [np.ones(3)]}), made(READS, weights={"a": [np.zeros(3)]})),
    "modules of the user": (
        made(ASKS, ours=of_module("def far(tokens): return 1")),
        made(ASKS, ours=of_module("def far(tokens): return 2")),
    ),
    "classes": (made(CLASS.format(factor=1, sign="+")), made(CLASS.format(factor=1, sign="-"))),
    "installed": (np.mean, np.max),
    "compiled": (cv2.norm, cv2.countNonZero),
    "built in": (max, min),
}


@pytest.mark.parametrize("what", PAIRS)
def test_functions_that_compute_something_else_have_other_digests(what: str) -> None:
    one, other = PAIRS[what]
    assert function_digest(one) == function_digest(one) != function_digest(other)


def test_metrics_that_are_made_anew_are_the_same() -> None:
    assert function_digest(within(np.arange(5))) == function_digest(within(np.arange(5)))
    assert function_digest(made(READS, weights={"a": [1]}, other=1)) == function_digest(
        made("\n\n" + READS, other=2, weights={"a": [1]})
    )


def test_a_function_that_calls_itself_has_a_digest() -> None:
    calls_itself = "def metric(tokens, case): return metric(tokens, case) if case else 1"
    assert function_digest(made(calls_itself)) == function_digest(made(calls_itself))


class Near:
    limit = 1.0

    def __init__(self, held: Any) -> None:
        self.held = held

    def __call__(self, tokens: Any, case: ep.Case) -> float:
        return self.limit


@pytest.mark.parametrize(
    "metric",
    [
        Near(cv2.ORB_create()),
        within(cv2.ORB_create()),
        within(x for x in ()),
        functools.partial(within, x=(n for n in ())),
        made(READS, weights={"a": [threading.local()]}),
        made("def metric(tokens, case): return eval('tokens')"),
        np.frompyfunc(lambda tokens, case: 1, 2, 1),
    ],
)
def test_a_function_with_an_object_that_has_no_digest_is_refused(metric: Any) -> None:
    with pytest.raises(NoDigest):
        function_digest(metric)


def test_objects_are_compared_by_class_and_state() -> None:
    assert function_digest(Near(1)) == function_digest(Near(1)) != function_digest(Near(2))


@pytest.mark.slow
def test_a_metric_is_the_same_in_another_process(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from epypes.batch.cache import function_digest\n"
        "words = {'a', 'b', 'c'}\n"
        "def metric(tokens, case): return case in {'x', 'y', 'z', 'w'} and tokens in words\n"
        "print(function_digest(metric))\n"
    )
    found = {
        subprocess.run(
            [sys.executable, str(script)], env={"PYTHONHASHSEED": seed}, check=True, capture_output=True, text=True
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(found) == 1


# -- values ---------------------------------------------------------------------------------------------------------


class Mode(enum.Enum):
    FINE = 1
    COARSE = 2


class Measured(np.ndarray):
    unit = ""


class Corner(NamedTuple):
    x: int
    y: int


class Size(NamedTuple):
    x: int
    y: int


def image(level: int) -> np.ndarray:
    """One of which a repr shows nothing but zeros."""
    made = np.zeros((100, 100), np.uint8)
    made[40:60, 40:60] = level
    return made


def measured(unit: str) -> np.ndarray:
    made = image(1).view(Measured)
    made.unit = unit
    return made


def objects(level: int) -> np.ndarray:
    made = np.empty(2000, object)
    made[1000] = image(level)
    return made


DIFFERENT = {
    "arrays": (image(1), image(2)),
    "types of arrays": (image(1), image(1).astype(np.int8)),
    "shapes": (image(1), image(1).reshape(-1)),
    "arrays in lists": ([image(1), image(1)], [image(1), image(2)]),
    "arrays in tuples": ((image(1),), (image(2),)),
    "masked arrays": (np.ma.masked_equal(image(1), 1), np.ma.masked_equal(image(1), 0)),
    "masked levels": (np.ma.masked_equal(image(1), 9), np.ma.masked_equal(image(2), 9)),
    "what a class of arrays keeps beside the numbers": (measured("mm"), measured("inch")),
    "arrays of objects": (objects(1), objects(2)),
    "structured arrays": (np.zeros(1, [("x", int)]), np.zeros(1, [("y", int)])),
    "keypoints": ([cv2.KeyPoint(1, 1, 1, 1, 0.5)], [cv2.KeyPoint(1, 1, 1, 1, 0.25)]),
    "members": (Mode.FINE, Mode.COARSE),
    "a member and its value": (Mode.FINE, 1),
    "a number, a float, a truth value": (1, 1.0, True, np.uint8(1), np.int64(1), "1", b"1"),
    "very long numbers": (10**9999, 10**9999 + 1),
    "where a text ends": (["ab", "c"], ["a", "bc"]),
    "what is in what": ([[1], 2], [[1, 2]], (1, 2), {1: 2}, {1, 2}),
    "named tuples": (Corner(1, 2), Size(1, 2), (1, 2)),
    "order of keys": ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "signs of zero": (0.0, -0.0),
}


@pytest.mark.parametrize("values", DIFFERENT.values(), ids=DIFFERENT)
def test_what_differs_has_another_digest_and_another_text(values):
    assert len({value_digest(value) for value in values}) == len(values)
    assert len({value_label(value) for value in values}) == len(values)


@pytest.mark.parametrize("level", [1, 7])
def test_an_array_in_a_file_is_compared_by_content(tmp_path, level):
    found = []
    for number, content in enumerate((image(level), image(level), image(level + 1))):
        mapped = np.memmap(tmp_path / f"{number}.dat", np.uint8, "w+", shape=(100, 100))
        mapped[:] = content
        found.append(value_digest(mapped))
    assert found[0] == found[1] != found[2]


def test_how_an_array_lies_in_memory_says_nothing():
    there = np.arange(24).reshape(4, 6)
    assert value_digest(np.asfortranarray(there)) == value_digest(there) == value_digest(np.repeat(there, 2, 0)[::2])


def test_what_a_person_can_read_stays_readable():
    assert [value_label(value) for value in (70, "fine", (3, 3), None)] == ["70", "'fine'", "(3, 3)", "None"]
    assert value_label(Mode.FINE).startswith("Mode.FINE ")
    assert value_label(image(1)).startswith("uint8 (100, 100) ")


def test_data_whose_content_pickle_does_not_have_has_no_digest() -> None:
    memory = shared_memory.SharedMemory(create=True, size=8)
    try:
        for value in (threading.local(), [cv2.ORB_create()], {"a": (memory,)}, (n for n in ())):
            with pytest.raises(NoDigest):
                value_digest(value)
    finally:
        memory.close()
        memory.unlink()


def test_a_file_of_a_payload_counts_by_its_content_and_how_it_is_read(tmp_path: Path) -> None:
    for name, content in (("a.png", b"1"), ("b.png", b"1"), ("c.png", b"2"), ("a.npy", b"1")):
        (tmp_path / name).write_bytes(content)
    os.mkfifo(tmp_path / "pipe.png")
    a, b, c, npy = (payload_digest({"image": tmp_path / name}) for name in ("a.png", "b.png", "c.png", "a.npy"))
    assert a == b
    assert len({a, c, npy}) == 3
    for name in ("there is none.png", "pipe.png", "."):
        with pytest.raises(NoDigest):
            payload_digest({"image": tmp_path / name})


def test_a_path_that_is_a_value_counts_by_its_name_and_its_file(tmp_path):
    assert value_digest(Path("a.txt")) != value_digest(Path("b.txt"))
    before = value_digest(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("x")
    assert value_digest(tmp_path / "a.txt") != before
