"""The matrix of functions that people write in notebooks: each is sliced, or refused with its place."""

from __future__ import annotations

import enum
import functools
import linecache
import re
import types
from typing import Annotated

import cv2
import numpy as np
import pytest
import skimage.filters
from skimage.filters import gaussian

import epypes as ep
from epypes.bundle.settings import Settings
from epypes.bundle.source.module import emit_module
from epypes.bundle.source.resolve import Importable, importable
from tests.bundle.slicing import slice_graph
from tests.seeds import printed

_CELLS = 0
SETTINGS = Settings("case", ("x0",), ("y",), {})


def notebook(source: str) -> dict:
    """Run source as a notebook cell is run: compiled under a name of its own, in ``__main__``."""
    global _CELLS
    _CELLS += 1
    name = f"<cell {_CELLS}>"
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    names = {"__name__": "__main__", "np": np, "cv2": cv2, "skimage": skimage, "gaussian": gaussian, "ep": ep,
             "functools": functools, "Annotated": Annotated}  # fmt: skip
    exec(compile(source, name, "exec"), names)
    return names


def promoted(source: str, function: str = "f", arity: int = 1):
    """Slice one function of a cell; return the module's text and its refusals."""
    names = notebook(source)
    inputs = tuple(f"x{index}" for index in range(arity))
    cg = ep.CompGraph({"f": names[function]}, {"f": (inputs, "y")})
    needed, references = slice_graph(cg.functions)
    return emit_module(SETTINGS, cg, needed, references), needed.refusals


def executed(text: str) -> types.SimpleNamespace:
    names: dict = {"__name__": "bundle"}
    exec(compile(text, "bundle", "exec", dont_inherit=True), names)
    return types.SimpleNamespace(**names)


SLICED = {
    "mark": ("def f(x: Annotated[int, ep.Param(1, 9)]):\n    return x + 1\n", 4),
    "mark as constant": (
        'RGB = ep.Image("uint8", order="rgb")\ndef f(x: Annotated[np.ndarray, RGB]):\n    return x + 1\n',
        4,
    ),
    "annotation as constant": (
        'Rgb = Annotated[np.ndarray, ep.Image("uint8", ("h", None, 3), (0, 9), "rgb")]\ndef f(x: Rgb) -> Rgb:\n    return x + 1\n',
        4,
    ),
    "annotation of a number": (
        'K = Annotated[int, ep.Param(1, 31, odd=True, unit="\'")]\ndef f(x: K):\n    return x + 1\n',
        4,
    ),
    "annotations of all kinds": (
        "from collections.abc import Callable\nfrom typing import Literal, Optional, Union\n"
        "A, B = Callable[[int, str], int], Callable[..., int]\nC, D = Literal['a', 'b'], Optional[list[int]]\n"
        "E, F = Union[int, None], dict[str, tuple[int, ...]] | None\n"
        "def f(x: A, a: B = None, c: C = 'a', d: D = None, e: E = 1, g: F = None):\n    return x + e\n",
        4,
    ),
    "plain": ("def f(x):\n    return x + 1\n", 4),
    "comment above": ("# Adds one.\ndef f(x):\n    return x + 1  # really\n", 4),
    "constant": ("STEP = 2\ndef f(x):\n    return x + STEP\n", 5),
    "tuple constant": ("STEPS = (1, 2.5, 'a', None)\ndef f(x):\n    return x + STEPS[0]\n", 4),
    "helper": ("def g(x):\n    return 2 * x\ndef f(x):\n    return g(x) + 1\n", 7),
    "helper defined later": ("def f(x):\n    return g(x) + 1\ndef g(x):\n    return 2 * x\n", 7),
    "array constant": ("K = np.eye(2, dtype=np.uint8) * 3\ndef f(x):\n    return int((K * x).sum()) - 6\n", 12),
    "float32 constant": (
        "K = np.array([[0.1, 0.7]], np.float32)\ndef f(x):\n    return (K.dtype.itemsize, K.shape)\n",
        (4, (1, 2)),
    ),
    "recursion": ("def f(x):\n    return 1 if x < 1 else x * f(x - 1)\n", 6),
    "mutual recursion": ("def g(x):\n    return f(x - 1)\ndef f(x):\n    return 0 if x < 1 else g(x) + 1\n", 3),
    "module under a name": ("def f(x):\n    return int(np.sum([x, x]))\n", 6),
    "import inside": ("def f(x):\n    import math\n    return math.factorial(x)\n", 6),
    "nested function": ("def f(x):\n    def g(y):\n        return y + x\n    return g(1)\n", 4),
    "comprehension": ("N = 3\ndef f(x):\n    return sum(x for _ in range(N))\n", 9),
    "annotation": ("def f(x: np.ndarray) -> np.ndarray:\n    return x\n", 3),
    "literal default": ("def f(x, k=-1, names=('a',)):\n    return x + k\n", 2),
    "constant of a module as default": (
        "def f(x, k=cv2.NORM_HAMMING, *, pi=np.pi):\n    return x + k, round(pi)\n",
        (9, 3),
    ),
    "computed default": ("def f(x, k=len('ab')):\n    return x + k\n", 5),
    "default that the module has no more": (
        "import types\nm = types.ModuleType('m')\nm.k = 1\ndef f(x, k=m.k):\n    return x + k\nm.k = 2\n",
        4,
    ),
    "list of a module as default": (
        "import keyword\ndef f(x, k=keyword.softkwlist):\n    return x + isinstance(k, list)\n",
        4,
    ),
    "method of a library's class under a name": (
        "total = np.ndarray.sum\ndef f(x):\n    return total(np.ones(x))\n",
        3.0,
    ),
    "table of a module that is too long for text": (
        "from keyword import kwlist\nfrom token import tok_name\ndef f(x):\n    return kwlist[0], tok_name[x]\n",
        ("False", "STRING"),
    ),
    "type as default": ("def f(x, kind=np.uint8):\n    return kind(x).itemsize\n", 1),
    "unguarded": ("@ep.unguarded\ndef f(x):\n    return x\n", 3),
    "redefinition": ("def f(x):\n    return 0\ndef f(x):\n    return x\n", 3),
    "in an if": ("if True:\n    def f(x):\n        return x\n", 3),
    "two lines of comment": ("# One.\n# Two.\ndef f(x): return x\n", 3),
    "async is refused elsewhere, generator is kept": ("def f(x):\n    return list(y for y in range(x))\n", [0, 1, 2]),
}


@pytest.mark.parametrize(("source", "expected"), SLICED.values(), ids=SLICED)
def test_a_plain_function_is_sliced_with_what_it_needs(source, expected):
    text, refusals = promoted(source)
    assert refusals == []
    assert executed(text).func_dict["f"](3) == expected


REFUSED = {
    "reserved name": (
        "func_dict = {1: 2}\ndef f(x):\n    return func_dict[x]\n",
        "uses the name 'func_dict'",
    ),
    "array of objects": ("K = np.array([None])\ndef f(x):\n    return K\n", "uses 'K' from it, of type ndarray"),
    "array with NaN": ("K = np.array([np.nan])\ndef f(x):\n    return K\n", "uses 'K' from it, of type ndarray"),
    "big constant": ("K = list(range(1000))\ndef f(x):\n    return K[x]\n", "uses 'K' from it, of type list"),
}


@pytest.mark.parametrize(("source", "words"), REFUSED.values(), ids=REFUSED)
def test_everything_else_is_refused_by_name_with_a_way_out(source, words):
    _, refusals = promoted(source)
    assert len(refusals) == 1
    assert re.search(words, refusals[0])


def test_a_function_made_by_exec_is_refused():
    names: dict = {"__name__": "__main__"}
    # Python 3.13 keeps the source of "<string>", if that is what it was started with (-c).
    exec(compile("def f(x):\n    return x", "<made here>", "exec"), names)
    needed, _ = slice_graph({"f": names["f"]})
    assert "has no source" in needed.refusals[0]


def test_all_refusals_are_given_at_once():
    cell = "class C:\n    def m(self, x):\n        return x\na, b = C().m, C()\ndef c(x):\n    return p + q\n"
    names = notebook(cell.replace("class C", "class C(list)") + "def d(x):\n    d.n = x\n")
    needed, _ = slice_graph({name: names[name] for name in "acd"})
    assert len(needed.refusals) == 4


def test_an_old_function_kept_under_a_new_name_keeps_its_own_source():
    names = notebook("def f(x):\n    return 'old'\nkept = f\ndef f(x):\n    return 'new'\n")
    cg = ep.CompGraph({"k": names["kept"]}, {"k": ("x", "y")})
    needed, references = slice_graph(cg.functions)
    assert executed(emit_module(SETTINGS, cg, needed, references)).func_dict["k"](0) == "old"


def test_two_functions_of_one_name_get_two_names():
    names = notebook(
        "def f(x):\n    return 'old'\nkept = [f]\ndef f(x):\n    return 'new'\ndef g(x):\n    return f(x)\n"
    )
    cg = ep.CompGraph(
        {"before": names["kept"][0], "now": names["f"], "g": names["g"]},
        {"before": ("x", "a"), "now": ("x", "b"), "g": ("x", "c")},
    )
    needed, references = slice_graph(cg.functions)
    assert references == {"before": "before", "now": "f", "g": "g"}
    functions = executed(emit_module(SETTINGS, cg, needed, references)).func_dict
    assert [function(0) for function in functions.values()] == ["old", "new", "new"]


def test_one_function_may_serve_twice():
    names = notebook("def f(x):\n    return x + 1\n")
    cg = ep.CompGraph({"a": names["f"], "b": names["f"]}, {"a": ("x", "y"), "b": ("y", "z")})
    needed, references = slice_graph(cg.functions)
    text = emit_module(SETTINGS, cg, needed, references)
    assert text.count("def f(") == 1
    assert references == {"a": "f", "b": "f"}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (cv2.Canny, Importable("cv2", "Canny")),
        (np.sqrt, Importable("numpy", "sqrt")),
        (np.uint8, Importable("numpy", "uint8")),
        (gaussian, Importable("skimage.filters", "gaussian")),
        (functools.reduce, Importable("functools", "reduce")),
        (len, Importable("builtins", "len")),
        (lambda x: x, None),
    ],
)
def test_library_functions_have_a_public_name(value, expected):
    assert importable(value) == expected


@pytest.mark.slow
def test_a_set_has_the_same_source_under_any_hash_seed():
    code = "from epypes.bundle.source.expressions import literal; print(literal({'a': ({'x', 'y', 'z', 'w'}, [1], (2,), ())}))"
    texts = printed(code, "0123")
    assert texts == {'{"a": ({"w", "x", "y", "z"}, [1], (2,), ())}\n'}


def test_a_module_is_imported_once_under_the_notebooks_name():
    names = notebook("def f(x):\n    return np.add(x, skimage.filters.gaussian(x))\n")
    functions = {"root": np.sqrt, "f": names["f"], "smooth": gaussian, "canny": cv2.Canny}
    io = {"root": ("x", "a"), "f": ("a", "b"), "smooth": ("b", "c"), "canny": (("c", "lo", "hi"), "d")}
    cg = ep.CompGraph(functions, io)
    needed, references = slice_graph(cg.functions)
    text = emit_module(SETTINGS, cg, needed, references)
    assert text.split('"""\n\n')[1].splitlines()[:3] == ["import cv2", "import numpy as np", "import skimage.filters"]
    assert references["root"] == "np.sqrt"
    assert references["smooth"] == "skimage.filters.gaussian"
    assert list(executed(text).func_dict) == ["root", "f", "smooth", "canny"]
    assert executed(text).func_io == {name: tuple(pair) for name, pair in io.items()}


def test_the_module_reads_like_one_that_a_colleague_wrote():
    text, _ = promoted(
        "# Weighs the channels.\ndef weigh(im):\n    return im * GAIN\nGAIN = 1.5\ndef f(im):\n    return weigh(im)\n"
    )
    assert text == (
        '"""The computational graph case: x0 -> y.\n\nIt was promoted from a notebook. In Python, with FOLDER the one in '
        "which this file is:\n\n    runner = epypes.load(FOLDER)\n    runner.run(x0=...)\n\n`epypes verify FOLDER` proves "
        "that it computes what the notebook did; `epypes serve`\nlets it answer events. The values of its "
        'hyperparameters stand in pipeline.toml.\n"""\n\nGAIN = 1.5\n\n\n# Weighs the channels.\n'
        "def weigh(im):\n    return im * GAIN\n\n\ndef f(im):\n    return weigh(im)\n\n\n"
        'func_dict = {\n    "f": f,\n}\n\nfunc_io = {\n    "f": (("x0",), "y"),\n}\n'
    )


def test_constants_and_functions_stand_as_in_the_notebook_with_their_comments():
    cell = """\
# Thresholds, found by hand.
LOW, HIGH = 0.5, 2
SIZE = 0x10  # of the window
LIMIT = sum([1, 2])
STEP = 7
STEP = 3  # the second

def blurred(im):
    return smooth(im) + offset(im)

WEIGHTS = (1, 2,
           3)

# Makes filters.
def make_smooth(k, sigma=0):
    def smooth(im):
        return im * k + sigma
    return smooth

smooth = make_smooth(5)
offset = functools.partial(max, LIMIT, key=abs)
by_name = {"smooth": smooth}

def f(im):
    return by_name["smooth"](im) + blurred(im) + LOW + SIZE + LIMIT + STEP + WEIGHTS[2]
"""
    text, refusals = promoted(cell)
    assert refusals == []
    body = text.split('"""')[2].partition("func_dict")[0]
    assert body.split("\n\n\n") == [
        "\n\nimport functools\n\nLOW = 0.5\nSIZE = 0x10  # of the window\nLIMIT = 3  # sum([1, 2]) in the notebook\n"
        "STEP = 3  # the second\nWEIGHTS = (1, 2,\n           3)\noffset = functools.partial(max, 3, key=abs)",
        "def blurred(im):\n    return smooth(im) + offset(im)",
        "# Makes filters.\ndef make_smooth(k, sigma):\n    def smooth(im):\n        return im * k + sigma\n\n    return smooth",
        "smooth = make_smooth(k=5, sigma=0)",
        'by_name = {"smooth": smooth}',
        'def f(im):\n    return by_name["smooth"](im) + blurred(im) + LOW + SIZE + LIMIT + STEP + WEIGHTS[2]',
        "",
    ]
    assert executed(text).func_dict["f"](3) == notebook(cell)["f"](3)


def test_a_factory_keeps_its_docstring_and_the_comment_above_it():
    factory = '''
# One for each line.
def scaling(k):
    """Return a function that scales.

    By how much is decided here: é.
    """
    # Whole numbers alone.
    k = int(k)
    return lambda x: x * k

'''
    text, refusals = promoted(f"{factory}f = scaling(2.5)\ng = scaling(3)\nh = f\ndef f(x):\n    return h(x) + g(x)\n")
    assert refusals == []
    assert (
        f"""{factory.partition("    # Whole")[0]}
    def function(x):
        return x * k

    return function
"""
        in text
    ), text
    assert text.count("def scaling(k):") == 1
    assert executed(text).func_dict["f"](2) == 10


def test_a_decorator_stands_before_what_it_decorates_wherever_the_notebook_has_it():
    cell = (
        "def plain(x):\n    return scaled(x)\n"
        "def scaled(x):\n    return x * 2\n"
        "def shifted(g):\n    base()\n    by = 40\n    @functools.wraps(g)\n    def w(x):\n        return g(x) + by\n    return w\n"
        "def base():\n    return 40\n"
        "@shifted\ndef f(x):\n    return plain(x)\n"
        "def base():\n    return 39 + 1\n"
    )
    text, refusals = promoted(cell)
    assert refusals == []
    places = [text.index(f"def {name}(") for name in ("plain", "scaled", "shifted", "base", "f")]
    assert places == sorted(places), "base, which shifted calls when f is defined, stands before f"
    assert executed(text).func_dict["f"](1) == 42


def test_what_is_named_freely_gives_way_to_what_functions_read_by_name():
    names = notebook("blur = 3\nedges = 4\ndef g(x):\n    return x + blur\n")
    functions = {"blur": eval_in_cell("lambda x: x * 10"), "edges": eval_in_cell("lambda x: x * 100"), "g": names["g"]}
    cg = ep.CompGraph(functions, {name: ("x", f"{name}_made") for name in functions})
    needed, references = slice_graph(cg.functions)
    assert references == {"blur": "blur_", "edges": "edges", "g": "g"}, "nobody reads edges"
    module = executed(emit_module(SETTINGS, cg, needed, references))
    assert [function(1) for function in module.func_dict.values()] == [10, 100, 4]


def eval_in_cell(source: str):
    return notebook(f"made = [{source}]\n")["made"][0]


def test_closures_over_different_values_of_one_name_share_the_function_that_makes_them():
    cell = "def make(k):\n    k = 2 * k\n    def f(x):\n        return x + k\n    return f\na, b = make(3), make(5)\n"
    names = notebook(cell)
    cg = ep.CompGraph({"a": names["a"], "b": names["b"]}, {"a": ("x", "y"), "b": ("x", "z")})
    needed, references = slice_graph(cg.functions)
    assert needed.refusals == []
    text = emit_module(SETTINGS, cg, needed, references)
    assert text.count("def make(k):") == 1
    assert [function(1) for function in executed(text).func_dict.values()] == [7, 11]


def test_lambdas_on_a_line_that_python_can_not_tell_apart_are_refused():
    function = notebook("f, g = lambda x: x, lambda x: -x\n")["g"]
    bare = function.__code__.replace(co_linetable=b"")
    function.__code__ = bare
    needed, _ = slice_graph({"g": function})
    assert re.search("is not what its source says|look alike to Python", needed.refusals[0])


def test_what_the_notebook_put_into_a_dict_of_functions_that_reads_it_comes_back():
    cell = "def down(x):\n    return x if x < 1 else STEPS['down'](x - 1)\nSTEPS = {'down': down}\ndef f(x):\n    return STEPS['down'](x)\n"
    text, refusals = promoted(cell)
    assert refusals == []
    assert executed(text).func_dict["f"](3) == 0


@pytest.mark.parametrize("made", ["np.asfortranarray(M)", "M.T", "M"])
def test_an_array_keeps_its_layout(made):
    source = f"M = np.arange(6.0).reshape(2, 3)\nK = {made}\ndef f(x):\n    return K\n"
    text, refusals = promoted(source)
    ours, theirs = executed(text).func_dict["f"](0), notebook(source)["K"]
    assert refusals == []
    assert (ours.tolist(), ours.strides) == (theirs.tolist(), theirs.strides)


@pytest.mark.parametrize("made", ["M[:, ::2]", "M[::-1]", "np.broadcast_to(M[0], (2, 3))"])
def test_an_array_that_is_part_of_another_is_refused_with_the_way_out(made):
    _, refusals = promoted(f"M = np.arange(6.0).reshape(2, 3)\nK = {made}\ndef f(x):\n    return K\n")
    assert "Make it a whole one in the notebook: np.ascontiguousarray(" in refusals[0]


CONSTANTS = {
    "several lines with comments": ("K = (1,  # low\n     'two')  # in mm\n", "K = (1,  # low\n     'two')  # in mm\n"),
    "a text over lines": ('K = """a\n    b"""\n', 'K = """a\n    b"""\n'),
    "inside of a block": ("if True:\n    # why\n    K = [1,\n         2]\n", "# why\nK = [1,\n         2]\n"),
    "two on one line": ("K = 1.50; L = 2  # both\n", "K = 1.50\n"),
    "with an annotation": ("K: int = 0x10  # bits\n", "K = 16  # bits\n"),
    "in brackets over lines": ("K = (1 +\n     2)\n", "K = 3  # 1 + 2 in the notebook\n"),
    "computed from another": ("L = 2\nK = L * 3\n", "K = 6  # L * 3 in the notebook\n"),
    "changed since": ("K = [1]  # one\nK.append(2)\n", "K = [1, 2]\n"),
    "given by a call": ("K = dict(a='x')\n", 'K = {"a": "x"}  # dict(a=\'x\') in the notebook\n'),
    "too long for a line": (
        "K = tuple(f'number {i}' for i in range(8))\n",
        '# tuple((f\'number {i}\' for i in range(8))) in the notebook\nK = (\n    "number 0",\n    "number 1",\n',
    ),
    "a call too long for a line": (
        "K = np.arange(16.0).reshape(2, 8) / 3 + 100\n",
        "# np.arange(16.0).reshape(2, 8) / 3 + 100 in the notebook\nK = np.array(\n    [\n        [\n            100.0,\n",
    ),
}


@pytest.mark.parametrize(("source", "written"), CONSTANTS.values(), ids=CONSTANTS)
def test_a_constant_stands_as_the_notebook_has_it_or_with_how_it_was_computed(source, written):
    source += "def f(x):\n    return repr(K)\n"
    text, refusals = promoted(source)
    assert refusals == []
    assert f"\n{written}" in text
    assert executed(text).func_dict["f"](0) == notebook(source)["f"](0)


class Token(enum.StrEnum):
    INPUT = "the image"
    MASK = "mask"


def test_members_of_an_enumeration_as_names_are_written_as_their_text():
    names = notebook("def f(*numbers):\n    return sum(numbers)\n")
    cg = ep.CompGraph({Token.MASK: names["f"]}, {Token.MASK: ([Token.INPUT, Token.MASK], "sum")})
    cg = ep.group(cg, Token.INPUT, [Token.MASK])
    needed, references = slice_graph(cg.functions)
    module = executed(emit_module(SETTINGS, cg, needed, references))
    assert repr(module.func_io) == "{'mask': (('the image', 'mask'), 'sum')}"
    assert repr(module.func_groups) == "{'the image': ['mask']}"


RECORD = "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Cfg:\n    k: int = 3\n"
ORDERED = {
    "a class that reads records": f"def f(x):\n    return D.z + x\n{RECORD}A, B = Cfg(1), Cfg(2)\nclass D:\n    z = A.k + B.k\n",
    "a decorator that reads a record when it decorates": (
        f"{RECORD}def deco(g):\n    by = CFG.k\n    @functools.wraps(g)\n    def w(x):\n        return g(x) + by\n    return w\n"
        "CFG = Cfg(5)\n@deco\ndef f(x):\n    return x\n"
    ),
    "a factory that reads a table at once": (
        "def make():\n    by = T['a']\n    def inner(x):\n        return x + by(x)\n    return inner\n"
        "def twice(x):\n    return 2 * x\nT = {'a': twice}\nf = make()\n"
    ),
    "classes that make each other": (
        "class A:\n    n = 1\n    def other(self):\n        return B()\nclass B(A):\n    n = 2\n    def back(self):\n        return A().n\n"
        "def f(x):\n    return A().other().n + B().back() + x\n"
    ),
}


@pytest.mark.parametrize("source", ORDERED.values(), ids=ORDERED)
def test_what_importing_a_definition_reads_stands_before_it(source):
    text, refusals = promoted(source)
    assert refusals == []
    assert executed(text).func_dict["f"](3) == notebook(source)["f"](3)
