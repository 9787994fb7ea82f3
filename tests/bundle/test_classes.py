"""Classes of the notebook: their text goes into the bundle if it says what they are."""

from __future__ import annotations

import re
import types

import pytest

import epypes as ep
from epypes.bundle.settings import Settings
from epypes.bundle.source.module import emit_module
from tests.bundle.cells import cell
from tests.bundle.slicing import slice_graph


def promoted(source: str) -> tuple[str, list[str], dict]:
    names = cell(source)
    cg = ep.CompGraph({"f": names["f"]}, {"f": ("x", "y")})
    needed, references = slice_graph(cg.functions)
    return emit_module(Settings("case", ("x",), ("y",), {}), cg, needed, references), needed.refusals, names


def executed(text: str) -> types.SimpleNamespace:
    names: dict = {"__name__": "bundle"}
    exec(compile(text, "bundle", "exec", dont_inherit=True), names)
    return types.SimpleNamespace(**names)


PROMOTED = {
    "plain": (
        "class P:\n    K = 3\n    def __init__(self, a):\n        self.a = a\n    def get(self):\n"
        "        return self.a * self.K * G\nG = 2\ndef f(x):\n    return P(x).get()\n"
    ),
    "dataclass": (
        "import dataclasses\n@dataclasses.dataclass(frozen=True, slots=True)\nclass P:\n    a: int\n    b: float = 2.0\n"
        "    c: list = dataclasses.field(default_factory=list)\n    @property\n    def s(self):\n"
        "        return self.a + self.b\ndef f(x):\n    return P(x).s\n"
    ),
    "enumeration": (
        "import enum\n# Two.\nclass M(enum.Enum):\n    A = 1\n    B = enum.auto()\n    @classmethod\n    def one(cls):\n"
        "        return cls.A\ndef f(x):\n    return x + M.one().value + M.B.value\n"
    ),
    "member": "import enum\nclass M(enum.IntEnum):\n    A = 1\n    B = 2\nBEST = M.B\ndef f(x):\n    return x + BEST\n",
    "named tuple": (
        "from typing import NamedTuple\nclass Pt(NamedTuple):\n    x: int\n    y: int = 4\nZERO = Pt(0)\n"
        "def f(x):\n    return ZERO.y + Pt(x).x\n"
    ),
    "named tuple that is made by a call": (
        "from collections import namedtuple\nPair = namedtuple('Pair', 'x y', defaults=[4])\nZERO = Pair(0)\n"
        "def f(x):\n    return ZERO.y + Pair(x).x\n"
    ),
    "base": (
        "class A:\n    def g(self):\n        return 1\nclass B(A):\n    def g(self):\n        return super().g() + 1\n"
        "def f(x):\n    return B().g() + x\n"
    ),
    "record": (
        "from dataclasses import dataclass\n@dataclass\nclass Cfg:\n    k: int = 3\n    t: tuple = (1, 2)\n"
        "CFG = Cfg(k=5)\ndef f(x):\n    return CFG.k + x\n"
    ),
    "record that checks itself": (
        "from dataclasses import dataclass\nimport numpy as np\n@dataclass(frozen=True, slots=True)\nclass Inner:\n    t: tuple\n"
        "@dataclass\nclass Cfg:\n    k: float\n    w: np.ndarray\n    i: Inner\n    def __post_init__(self):\n"
        "        self.k = float(self.k)\n        if self.k < 0:\n            raise ValueError\nCFG = Cfg(5, np.eye(2), Inner((1, float('nan'))))\n"
        "def f(x):\n    return CFG.k + x + float(CFG.w.sum()) + CFG.i.t[0]\n"
    ),
    "abstract": (
        "import abc\nimport functools\nclass A(abc.ABC):\n    @abc.abstractmethod\n    def g(self): ...\nclass B(A):\n"
        "    def g(self):\n        return 5\n    @staticmethod\n    def s(x):\n        return x\n"
        "    @functools.cached_property\n    def c(self):\n        return 8\ndef f(x):\n    return B().g() + B.s(x) + B().c\n"
    ),
    "made by itself": (
        "class A:\n    def twice(self):\n        return type(A()).__name__ * 2\ndef f(x):\n    return A().twice() * x\n"
    ),
    "annotations read late": (
        "from __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\nclass P:\n    a: int = 4\n"
        "    def of(self, other: int) -> float:\n        return self.a + other\ndef f(x):\n    return P().of(x)\n"
    ),
    "values that are computed": (
        "import dataclasses\nimport enum\nimport numpy as np\nGAIN = 3\nROW = np.arange(9.0)\n"
        "class A:\n    K = GAIN * 10\n    T = np.array([1, 2], np.float32) / 3\n    U = K + 1\n    R = ROW\n    D = dict(a=1)\n"
        "    S = [i * GAIN for i in range(3)]\n    a, b = 1, GAIN\n    _low: int = -GAIN\n    N = f'{K} of {GAIN}'\n"
        "    Z = np.zeros((2, 3))\n    def g(self, k=GAIN, *, u=U, dtype=np.uint8):\n        return k + u + self._low\n"
        "    alias = g\n@dataclasses.dataclass\nclass P:\n    k: int = GAIN\n"
        "    m: list = dataclasses.field(default_factory=list)\n    n: int = dataclasses.field(default=GAIN + 1)\n"
        "class E(enum.Enum):\n    A = GAIN\n    B = enum.auto()\n    C = (A, GAIN)\n"
        "def f(x):\n    return A().g() + A().alias(2) + sum(A.S) + float(A.T.sum()) + P().k + P().n + E.B.value + x + len(A.N)\n"
    ),
    "a value that is made in steps": (
        "class A:\n    K = 1\n    for i in range(3):\n        K += i\n    def g(self): return self.K\ndef f(x):\n    return A().g() + x\n"
    ),
    "in an if": "if True:\n    class A:\n        K = 4\ndef f(x):\n    return A.K + x\n",
}


@pytest.mark.parametrize("source", PROMOTED.values(), ids=PROMOTED)
def test_a_class_is_sliced_with_what_it_needs(source):
    text, refusals, names = promoted(source)
    assert refusals == []
    assert executed(text).func_dict["f"](3) == names["f"](3)


def test_a_class_stands_before_what_is_made_of_it():
    text, _, _ = promoted(PROMOTED["record"])
    assert text.split('"""\n', 2)[1].startswith("\nfrom dataclasses import dataclass\n\n\n@dataclass\nclass Cfg:\n")
    assert "\n    t: tuple = (1, 2)\n\n\nCFG = Cfg(k=5)\n\n\ndef f(x):\n" in text


USED = "def f(x):\n    return A().g() + x\n"
REFUSED = {
    "another method": (f"class A:\n    def g(self):\n        return 1\nA.g = lambda self: 2\n{USED}", r"line 4\), which function 'f' needs: the notebook has it with another text"),
    "a method more": (f"class A:\n    def g(self):\n        return self.h()\nA.h = lambda self: 2\n{USED}", r"Class 'A' \(.*, line 1\), which function 'f' needs: it has 'h' only in the notebook"),
    "a value changed": (f"class A:\n    K = 1\n    def g(self):\n        return self.K\nA.K = 2\n{USED}", r"Class 'A' \(.*, line 1\), which function 'f' needs: its 'K' is 2 in the notebook and 1"),
    "a value more": (f"class A:\n    def g(self):\n        return self.K\nA.K = 2\n{USED}", r"it has 'K' only in the notebook"),
    "an attribute gone": (f"class A:\n    K = 1\n    def g(self):\n        return 1\ndel A.K\n{USED}", r"it has 'K' only in the module"),
    "another base": (
        f"class B:\n    def g(self):\n        return 1\nclass A(B):\n    pass\nclass B:\n    pass\n{USED}",
        r"Class 'B' .* it has 'g' only in the notebook",
    ),
    "made in a function": (
        f"def make():\n    class A:\n        def g(self):\n            return 1\n    return A\nA = make()\n{USED}",
        r"defined inside 'make\.<locals>'\. Define it at the margin",
    ),
    "a named tuple with more": (
        "import collections\nSingle = collections.namedtuple('Single', 'k')\nSingle.g = lambda self: self.k\ndef f(x):\n    return Single(x).g()\n",
        r"Class 'Single'.* it has 'g' only in the notebook",
    ),
    "made by a call": (f"A = type('A', (), {{'g': lambda self: 1}})\n{USED}", r"was made by a call\. Write a class statement"),
    "writes a global": (
        f"N = 0\nclass A:\n    def g(self):\n        global N\n        N += 1\n        return N\n{USED}", "changes the global 'N'",
    ),
    "a value that was computed": (f"G = 2\nclass A:\n    K = G * 10\n    def g(self): return self.K\nG = 5\n{USED}", r"its 'K' is 20 in the notebook and 50 in the module"),
    "a value that the notebook has filled": (f"class A:\n    K = dict()\n    def g(self): return len(self.K)\nA.K[1] = 2\n{USED}", r"its 'K' has \[1\] only in the notebook"),
    "an array that was written into": (
        f"import numpy as np\nclass A:\n    K = np.array([1, 2])\n    def g(self): return self.K\nA.K[0] = 50\n{USED}", r"its 'K' is array\(\[50,  2\]\) in the notebook and array\(\[1, 2\]\) in",
    ),
    "a default of a method": (f"G = 2\nclass A:\n    def g(self, k=G): return k\nG = 5\n{USED}", r"'g' \(.*, line 3\), which .* its default of 'k' is 2 in the notebook and 5"),
    "a default by name": (f"G = 2\nclass A:\n    @staticmethod\n    def g(*, k=G): return k\nG = 5\n{USED}", r"'g' \(.*, line 3\), which .* its default of 'k' is 2 in the notebook and 5"),
    "a default that was filled": (f"class A:\n    def g(self, k=[1]): return len(k)\nA().g.__func__.__defaults__[0].append(2)\n{USED}", r"'g' \(.*, line 2\), which .* its default of 'k' has \[1\] only in the notebook"),
    "a field": (
        "import dataclasses\nG = 2\n@dataclasses.dataclass\nclass Only:\n    k: int = G\nG = 5\ndef f(x):\n    return Only().k + x\n", r"its 'k' is 2 in the notebook and 5",
    ),
    "a field that is described": (
        "import dataclasses\nG = 2\n@dataclasses.dataclass\nclass Other:\n    k: int = dataclasses.field(default=G)\nG = 5\n"
        "def f(x):\n    return Other().k + x\n", r"its 'k' is 2 in the notebook and 5",
    ),
    "a member": ("import enum\nG = 2\nclass Kinds(enum.Enum):\n    K = G\nG = 5\ndef f(x):\n    return Kinds.K.value + x\n", r"its .*'K'.* value is 2 in the notebook and 5"),
    "a value of a class above": ("G = 2\nclass Above:\n    K = G + 1\nclass A(Above):\n    def g(self): return self.K\nG = 5\n" + USED, r"Class 'Above' .* its 'K' is 3 in the notebook and 6"),
    "a private value more": (f"class A:\n    def g(self): return getattr(self, '_k', 1)\nA._k = 5\n{USED}", r"it has '_k' only in the notebook"),
    "a number of NumPy's more": (f"import numpy as np\nclass A:\n    def g(self): return self.q\nA.q = np.float64(3)\n{USED}", r"it has 'q' only in the notebook"),
    "a record that changes what it is given": (
        "import dataclasses\n@dataclasses.dataclass\nclass Twice:\n    k: float\n    def __post_init__(self):\n        self.k *= 2\n"
        "ONE = Twice(30)\ndef f(x):\n    return ONE.k + x\n", r"its 'ONE' attribute 'k' is 60 in the notebook and 120 in the module",
    ),
    "a record that changes its list": (
        "import dataclasses\n@dataclasses.dataclass\nclass Longer:\n    k: list\n    def __post_init__(self):\n        self.k.append(2)\n"
        "ONE = Longer([1])\ndef f(x):\n    return len(ONE.k) + x\n", r"its 'ONE' attribute 'k' has \[2\] only in the module",
    ),
    "a record with more": (
        "import dataclasses\n@dataclasses.dataclass\nclass More:\n    k: int\nONE = More(3)\nONE.m = 5\ndef f(x):\n    return ONE.m + x\n",
        r"its 'ONE' has attribute 'm' only in the notebook",
    ),
    "object of the notebook": ("class A:\n    pass\nONE = A()\ndef f(x):\n    return ONE\n", "uses 'ONE' .* of type A"),
}  # fmt: skip


@pytest.mark.parametrize(("source", "words"), REFUSED.values(), ids=REFUSED)
def test_a_class_that_is_not_what_its_text_says_is_refused(source, words):
    _, refusals, _ = promoted(source)
    assert len(refusals) == 1
    assert re.search(words, refusals[0])


def test_a_class_that_was_defined_again_is_taken_as_it_is_now():
    names = cell("class A:\n    K = 1\ndef f(x):\n    return A.K + x\n")
    cell("class A:\n    K = 7\n", names)
    needed, references = slice_graph({"f": names["f"]})
    cg = ep.CompGraph({"f": names["f"]}, {"f": ("x", "y")})
    text = emit_module(Settings("case", ("x",), ("y",), {}), cg, needed, references)
    assert executed(text).func_dict["f"](1) == names["f"](1) == 8


def test_a_class_whose_cell_was_run_again_is_refused_with_its_line_where_something_is_of_the_old_one():
    source = "\nimport enum\nclass Mode(enum.Enum):\n    FAST = 1\n"
    names = cell(f"{source}CHOSEN = Mode.FAST\ndef f(x):\n    return x + (CHOSEN is Mode.FAST)\n")
    cell(source, names)
    needed, _ = slice_graph({"f": names["f"]})
    (reason,) = needed.refusals
    assert re.search(r"Class 'Mode', which function 'f' uses \(<test cell \d+>, line 3\) uses the name 'Mode'", reason)
    assert "run again what was made of it" in reason
