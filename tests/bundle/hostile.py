"""Notebooks that are known to work where they are written and to fail where they are served."""

from __future__ import annotations

import linecache
import sys
import types

import pytest

IMPORTS = """\
import functools
import operator
import re
from fractions import Fraction
from math import *
from math import floor as down
from operator import itemgetter as take

import cv2
import numpy as np
import skimage.filters
from cv2 import NORM_L1

import epypes as ep
"""

# By name: a cell, and what of it the graph calls, by its name there. Every function takes an array of 2 x 3 numbers.
PROMOTED: dict[str, tuple[str, dict[str, str]]] = {
    "lambda": ("# Doubles.\ndouble = lambda a: 2 * a", {"lambda_": "double"}),
    "lambda in place": ("", {"in_place": "lambda a, k=3: a * k"}),
    "two lambdas on one line": ("plus, minus = lambda a: a + 1, lambda a: a - 1", {"plus": "plus", "minus": "minus"}),
    "the same lambda twice on one line": ("one, other = lambda a: a + 7, lambda a: a + 7", {"one": "one", "two": "other"}),
    "lambda in a lambda": ("nested = (lambda a: (lambda b: b + 4))(0)", {"nested": "nested"}),
    "lambdas of a loop": (
        "powers = {}\nfor power in (2, 3):\n    powers[power] = lambda a, power=power: a ** power",
        {"squared": "powers[2]", "cubed": "powers[3]"},
    ),
    "lambda over lines": ("longer = lambda a: [  # odd\n    a.sum(),\n    2]", {"longer": "longer"}),
    "lambda that calls itself": ("halve = lambda a: a if a.max() < 1 else halve(a / 2)", {"halve": "halve"}),
    "vectorized": (
        "def halved(v, by):\n    return v // by\nhalve_all = np.vectorize(halved, otypes=[np.int32], excluded={'by'})",
        {"vectorized": "lambda a: halve_all(a, by=2)"},
    ),
    "partial": ("clip = functools.partial(np.clip, a_min=1, a_max=4)", {"clip": "clip"}),
    "partial of a partial": (
        "def scale(by, a, offset=0):\n    return a * by + offset\nthrice = functools.partial(scale, 3)",
        {"nested_partial": "functools.partial(functools.partial(scale, 3), offset=np.float32(0.5))"},
    ),
    "partial that a function calls": ("def use_thrice(a):\n    return thrice(a)", {"use_thrice": "use_thrice"}),
    "closure": (
        "def make_adder(k, *, sign=1):\n    shift = k * sign\n    def add(a):\n        return a + shift + k + sign\n"
        "    return add\nadd_5 = make_adder(5)",
        {"add_5": "add_5", "subtract": "make_adder(2, sign=-1)"},
    ),
    "closure over what was computed": (
        "def make_filter(size):\n    weights = np.ones(size) / size\n    def smooth(a):\n        return np.convolve(a[0], weights)\n"
        "    return smooth\nsmooth = make_filter(3)",
        {"smooth": "smooth"},
    ),
    "closure over functions": (
        "def compose(first, then):\n    return lambda a: then(first(a))",
        {"composed": "compose(double, np.sqrt)"},
    ),
    "closure that calls itself": (
        "def make_sum():\n    def total(rows):\n        return 0 if len(rows) == 0 else rows[0].sum() + total(rows[1:])\n"
        "    return total\ntotal = make_sum()",
        {"total": "total"},
    ),
    "closure whose variable hides a builtin of others": (
        "def make_bounded():\n    max = len('abc')\n    def bounded(a):\n        return a + max\n    return bounded\n"
        "bounded = make_bounded()\ndef with_bounded(a):\n    return bounded(a) + max(1, 2)",
        {"with_bounded": "with_bounded"},
    ),
    "closures that call each other": (
        "def make_parity():\n    def is_even(n):\n        return n == 0 or is_odd(n - 1)\n    def is_odd(n):\n"
        "        return n != 0 and is_even(n - 1)\n    return is_even\neven_size = make_parity()\n"
        "def sized(a):\n    return even_size(a.size)",
        {"sized": "sized"},
    ),
    "closure that finds itself in a table": (
        "def make_factorial():\n    steps = {}\n    def factorial(n):\n        return 1 if n < 1 else n * steps['down'](n - 1)\n"
        "    steps['down'] = factorial\n    return factorial\nfactorial = make_factorial()\ndef factorials(a):\n    return factorial(int(a.max()))",
        {"factorials": "factorials"},
    ),
    "method that calls the one of the class above": (
        "class Plain:\n    def of(self, a):\n        return a\nclass Raised(Plain):\n    def of(self, a):\n        return super().of(a) + 1\n"
        "raised_of = Raised.of\ndef raised(a):\n    return raised_of(Raised(), a)",
        {"raised": "raised"},
    ),
    "closure that a decorator of a library wraps": (
        "def make_cached(k):\n    @functools.lru_cache\n    def times(n):\n        return n * k if n else times(1)\n    return times\n"
        "by_3, by_4 = make_cached(3), make_cached(4)\ndef cached_times(a):\n    return by_3(int(a.max())) + by_4(0)",
        {"cached_times": "cached_times"},
    ),
    "closure over a module, a class and an array": (
        "class Scale:\n    by = 3\ndef make_scaled():\n    import math as m\n    kind, weights = Scale, np.arange(30.0)\n"
        "    def scaled(a):\n        \"\"\"Scale.\n\n        All of it.\n        \"\"\"\n        return a * kind.by + weights[m.floor(2.5)]\n"
        "    return scaled\nscaled_row = make_scaled()",
        {"scaled_row": "scaled_row"},
    ),
    "recursion": ("def depth(a):\n    return 0 if a.size < 2 else 1 + depth(a.ravel()[1:])", {"depth": "depth"}),
    "mutual recursion": (
        "def even(n):\n    return n == 0 or odd(n - 1)\ndef odd(n):\n    return n != 0 and even(n - 1)\n"
        "def parity(a):\n    return even(a.size)",
        {"parity": "parity"},
    ),
    "several names": (
        "def root(a):\n    return np.sqrt(a)\nradix = root\ndef roots(a):\n    return root(a) + radix(a)",
        {"roots": "roots"},
    ),
    "old function kept": (
        "def shade(a):\n    return a / 2\nold_shade = shade\ndef shade(a):\n    return a / 4\n"
        "def shades(a):\n    return shade(a)",
        {"old": "old_shade", "new": "shade", "shades": "shades"},
    ),
    "redefinition by object": ("def again(a):\n    return a\ndef again(a):\n    return a + 10", {"again": "again"}),
    "default of a constant": ("GAIN = 3\ndef gain(a, by=GAIN, *, pi=np.pi):\n    return a * by + pi", {"gain": "gain"}),
    "default of a name that has another value by now": (
        "SIDE = 5\ndef sided(a, k=SIDE):\n    return a * k\nSIDE = 9", {"sided": "sided"},
    ),
    "decorator that hangs a mark on it": (
        "def marked(g):\n    @functools.wraps(g)\n    def w(a):\n        return g(a)\n    w.mark = 0\n    return w\n"
        "@marked\ndef with_mark(a):\n    return a + 1",
        {"with_mark": "with_mark"},
    ),
    "lru_cache": (
        "@functools.lru_cache(maxsize=None)\ndef fib(n):\n    return n if n < 2 else fib(n - 1) + fib(n - 2)\n"
        "def fibs(a):\n    return fib(int(a.max()))",
        {"fibs": "fibs"},
    ),
    "decorator of the notebook": (
        "def repeated(times):\n    def decorate(f):\n        @functools.wraps(f)\n        def repeat(a):\n"
        "            for _ in range(times):\n                a = f(a)\n            return a\n        return repeat\n"
        "    return decorate\n\n# Twice.\n@repeated(2)\n@ep.unguarded\ndef twice(a):\n    return a + SHIFT\nSHIFT = 1.5",
        {"twice": "twice"},
    ),
    "decorator without wraps": (
        "def unwrapped(g):\n    def w(a):\n        return g(a) + 1\n    return w\n@unwrapped\ndef without_wraps(a):\n    return a * 2",
        {"without_wraps": "without_wraps"},
    ),
    "decorator that returns the function": (
        "SEEN = []\ndef noted(g):\n    SEEN.append(g)\n    return g\n@noted\ndef noted_one(a):\n    return a * 2", {"noted_one": "noted_one"},
    ),
    "decorator that was called": (
        "def shifted(g):\n    @functools.wraps(g)\n    def w(a):\n        return g(a) + 1\n    return w\n"
        "def later(a):\n    return a * 2\nlater = shifted(later)",
        {"later": "later"},
    ),
    "decorator that derives": (
        "def limited(low, high=5):\n    width = high - low\n    def decorate(f):\n        name = 3\n        @functools.wraps(f)\n"
        "        def limit(a, k=low):\n            return np.clip(f(a), low, low + width) + k + name\n        return limit\n    return decorate\n"
        "@limited(2)\ndef within(a):\n    return a * 2",
        {"within": "within"},
    ),
    "decorators of libraries": (
        "import contextlib\n@contextlib.contextmanager\ndef opened(a):\n    yield a + 1\n@functools.cache\ndef cached(n):\n    return n + 1\n"
        "def with_opened(a):\n    with opened(a) as b:\n        return b + cached(2)",
        {"with_opened": "with_opened"},
    ),
    "what only looks like writing into constants": (
        "KEPT = [3, 1, 2]\nBASE = {'k': 1}\nPLATE = np.zeros((2, 3))\ndef ordered(rows):\n    rows = list(rows)\n    rows.sort()\n    return rows\n"
        "def harmless(a):\n    some = KEPT[1:]\n    some.append(4)\n    base = BASE\n    base = {**base, 'j': 2}\n    base['i'] = 3\n"
        "    plate = PLATE.copy()\n    np.add(a, 1, out=plate)\n    return ordered(KEPT) + some, base, plate",
        {"harmless": "harmless"},
    ),
    "lazy import": ("def lazy(a):\n    import math\n    from fractions import Fraction as F\n    return math.floor(F(7, 2))", {"lazy": "lazy"}),
    "imports": (
        "def imported(a):\n    return down(sqrt(16)) + NORM_L1 + len(take(0)(a)) + pi", {"imported": "imported"},
    ),
    "submodule": ("def sobel(a):\n    return skimage.filters.sobel(a)", {"sobel": "sobel"}),
    "C functions": ("", {"ufunc": "np.sqrt", "c_function": "cv2.norm", "builtin": "len", "method": "np.ndarray.sum"}),
    "objects of operator": ("first_row = take(0)\ndef rowed(a):\n    return first_row(a)", {"rowed": "rowed", "item": "operator.itemgetter(1)"}),
    "method of a literal": ("", {"looked": '{2: "two", 3: "three"}.get'}),
    "table of functions": (
        "TABLE = {'double': double, 'root': np.sqrt}\ndef chosen(a):\n    return TABLE['double'](TABLE['root'](a))",
        {"chosen": "chosen"},
    ),
    "constants of all kinds": (
        "# found by hand\nLOW = 0x10  # of 255\nSTEPS = 1_000\nNAMES = {'a': (1, 2.5), 'b': {1, 2}}\nEND = float('inf')\n"
        "WORD = re.compile(r'\\w+', re.I)\nHALF = Fraction(1, 2)\nSPAN = range(2, 9)\nROW = slice(1, None)\nKERNEL = np.eye(2) / 3\n"
        "def constants(a):\n    return LOW + STEPS + len(NAMES), END, len(WORD.findall('a b')), float(HALF), list(SPAN), KERNEL @ a[ROW, :1].repeat(2, 0)",
        {"constants": "constants"},
    ),
    "function with others for other types": (
        "@functools.singledispatch\ndef kind(v):\n    return 'any'\n@kind.register\ndef _(v: np.ndarray):\n    return f'array {kind(v.ndim)}'\n"
        "@kind.register(int)\ndef _(v):\n    return f'int {v}'\nkind.register(list, len)\ndef kinds(a):\n    return kind(a), kind(None), kind([1, 2])",
        {"kind": "kind", "kinds": "kinds"},
    ),
    "class that registers those that are derived from it": (
        "class Measure:\n    known = {}\n    def __init_subclass__(cls, name, **more):\n        super().__init_subclass__(**more)\n"
        "        Measure.known[name] = cls\nclass Mean(Measure, name='mean'):\n    def of(self, a):\n        return float(a.mean())\n"
        "class Top(Measure, name='top'):\n    def of(self, a):\n        return float(a.max())\n"
        "def measured(a):\n    return Measure.known['top' if a[0, 0] else 'mean']().of(a)",
        {"measured": "measured"},
    ),
    "object of a class, and its methods": (
        "class Filter:\n    def __init__(self, size, *, gain=1.0):\n        self.kernel, self.gain = np.ones(size) / size, gain\n"
        "    def smooth(self, a):\n        return np.convolve(a[0], self.kernel) * self.gain\n    def __call__(self, a):\n        return self.smooth(a) + 1\n"
        "SIZE = 3\nfilter_3 = Filter(SIZE, gain=2.0)\ndef filtered(a):\n    return filter_3.smooth(a)",
        {"filtered": "filtered", "method_of_own": "filter_3.smooth", "called": "filter_3"},
    ),
    "object with a cached property": (
        "import dataclasses\n@dataclasses.dataclass\nclass Lens:\n    f: float = 50.0\n    @functools.cached_property\n"
        "    def matrix(self):\n        return np.diag([self.f, self.f, 1.0])\nLENS = Lens(60.0)\ndef projected(a):\n    return LENS.matrix[:2, :2] @ a",
        {"projected": "projected"},
    ),
    "objects of SciPy": (
        "from scipy import signal\nfrom scipy.interpolate import CubicSpline\nfrom scipy.spatial import KDTree\n"
        "POINTS = np.random.default_rng(0).random((20, 2))\nTREE, SOS = KDTree(POINTS), signal.butter(4, 0.2, output='sos')\n"
        "CURVE = CubicSpline([0, 5, 20], [0.0, 1, 9])\nNEAR = KDTree(POINTS, leafsize=4)\ndef curved(a):\n    return CURVE(a), int(NEAR.query(a[:, 0])[1])\n"
        "def low_passed(a):\n    return signal.sosfilt(SOS, a)",
        {"curved": "curved", "low_passed": "low_passed"},
    ),
    "values of libraries": (
        "import types\nimport datetime as dt\nimport matplotlib.colors\nfrom pathlib import PurePosixPath, PureWindowsPath\n"
        "POSIX, WINDOWS = PurePosixPath('/a/b'), PureWindowsPath('c/d')\nLEVELS = types.MappingProxyType({'low': [1, 2]})\n"
        "T64, H64, NOT = np.datetime64('2024-02-29T12:30', 'ms'), np.timedelta64(3, 'h'), np.datetime64('NaT')\nUNIT, RAW = np.str_('mm'), np.bytes_(b'cd')\n"
        "DAY, NOON, ZONE = dt.date(2024, 2, 29), dt.time(12), dt.timezone(dt.timedelta(hours=1), 'A')\nSTART = dt.datetime(2024, 3, 31, 1, 30, tzinfo=ZONE)\n"
        "CFG = types.SimpleNamespace(low=30, names=['a'])\nGAINS = np.array([(1, 1.5), (2, 2.5)], [('level', 'i4'), ('gain', 'f8')])\nMARKS = np.array(['ok', 'dent'])\n"
        "DAYS = np.array(['2024-01-01', '2024-02-01'], 'M8[D]')\ndef of_libraries(a):\n    n = int(a.max())\n"
        "    times = str(T64 + H64 * n), T64.dtype.str, str(NOT), str(DAY), str(NOON), (START + dt.timedelta(days=n)).isoformat(), START.tzname(), str(DAYS[n % 2])\n"
        "    return times, str(POSIX / f'{n}'), str(WINDOWS), LEVELS['low'][0] + n, UNIT * 2, RAW, CFG.low + len(CFG.names), float(GAINS['gain'] @ [n, 1]), MARKS.tolist()\n"
        "def coloured(a):\n    return matplotlib.colors.to_rgb(f'C{int(a.max()) % 10}')",
        {"of_libraries": "of_libraries", "coloured": "coloured"},
    ),
    "mock that is undone": (
        "from unittest import mock\ndef mocked(a):\n    with mock.patch.object(np, 'median', np.max):\n        high = np.median(a)\n    return float(high - np.median(a))",
        {"mocked": "mocked"},
    ),
    "function that makes a generator": (
        "def rows(a):\n    yield from a\ndef listed(a):\n    return list(rows(a))", {"listed": "listed"},
    ),
}  # fmt: skip

# By name: a cell, what of it the graph calls, and what the reason says: of which place, and which way out.
REFUSED: dict[str, tuple[str, str, str]] = {
    "bound method": ("class C:\n    def m(self, a):\n        return a\nf = C().m", "f", r"a method of an object of class 'C' \(cell \[1\], line 4\)\. Write a plain function"),
    "method of a library's object": ("f = cv2.ORB_create().detect", "f", r"class 'ORB' \(cell \[1\], line 1\)\. Write a plain"),
    "callable object": ("class C:\n    def __call__(self, a):\n        return a", "C()", r"'C' \(cell \[1\], line 2\)\. Write a plain"),
    "magic": ("def f(a):\n    get_ipython().run_line_magic('time', 'a')\n    return a", "f", r"\(cell \[1\], line 2\), the notebook itself, as magics.* Write it in Python"),
    "display": ("def f(a):\n    display(a)\n    return a", "f", r"'display' \(cell \[1\], line 2\).* Return it as a token"),
    "objects": ("import gc\ndef f(a):\n    return len(gc.get_objects())", "f", r"uses 'gc\.get_objects' \(cell \[1\], line 3\), by which"),
    "input": ("def f(a):\n    return input()", "f", r"\(cell \[1\], line 2\), which asks a person\. Make the answer a token"),
    "file": ("def f(a):\n    return __file__", "f", r"'__file__' \(cell \[1\], line 2\), which is another one"),
    "global write": ("N = 0\ndef f(a):\n    global N\n    N += 1\n    return N", "f", r"changes the global 'N' \(cell \[1\], line 4\)\. Return"),
    "nonlocal": (
        "def make(n):\n    def f(a):\n        nonlocal n\n        n += 1\n        return n\n    return f\nf = make(0)", "f",
        r"changes 'n' of the function around it \(cell \[1\], line 3\).*Return it\. .*cg = ep\.delay\(cg, 'n', 'n_before', initial=0\)",
    ),
    "dict that is written into": ("SEEN = {}\ndef f(a):\n    SEEN[a.size] = 1\n    return a", "f", r"writes into 'SEEN', .*\(cell \[1\], line 3\).* Write into a copy of it.*, initial=\{\}\)\."),
    "list that grows": ("LOG = []\ndef f(a):\n    LOG.append(a)\n    return a", "f", r"writes into 'LOG', .*\(cell \[1\], line 3\)"),
    "attribute of itself": ("def f(a):\n    f.count = 1\n    return a", "f", r"writes into 'f', .*\(cell \[1\], line 2\)"),
    "closure that keeps": (
        "def make():\n    seen = []\n    def f(a):\n        seen.append(a)\n        return a\n    return f\nf = make()", "f",
        r"writes into 'seen', .*\(cell \[1\], line 4\)",
    ),
    "made by exec": ("exec('def f(a):\\n    return a')", "f", r"has no source .*Define it in a cell"),
    "made by eval": ("f = eval('lambda a: a')", "f", r"has no source .*Define it in a cell"),
    "async helper": ("async def g(a):\n    return a\ndef f(a):\n    return g(a)", "f", r"'g', .* is asynchronous \(cell \[1\], line 1\).* Write a plain function"),
    "missing name": ("def f(a):\n    return a + nothing", "f", r"'nothing', which is not defined \(cell \[1\], line 2\)\. Define it"),
    "replaced code": ("def g(a):\n    return -a\ndef f(a):\n    return a\nf.__code__ = g.__code__.replace(co_name='f', co_firstlineno=3)", "f", r"not what its source says \(cell \[1\], line 3\).* Run it again"),
    "replaced function of a module": (
        "import types\nlib = types.ModuleType('lib')\nlib.f = lambda a: a\ndef f(a):\n    return lib.f(a)", "f",
        r"'lib\.f', which the notebook has changed \(cell \[1\], line 3\).* Call yours by a name",
    ),
    "decorator that was defined again": (
        "def d(g):\n    @functools.wraps(g)\n    def w(a):\n        return g(a)\n    return w\n@d\ndef f(a):\n    return a\n"
        "def d(g):\n    @functools.wraps(g)\n    def w(a):\n        return g(g(a))\n    return w", "f",
        r"'f' \(cell \[1\], line 6\): the notebook has it with another text.* Run the cells",
    ),
    "decorator whose argument has changed": (
        "N = 2\ndef d(n):\n    def deco(g):\n        @functools.wraps(g)\n        def w(a):\n            return g(a) * n\n        return w\n"
        "    return deco\n@d(N)\ndef f(a):\n    return a\nN = 3", "f", r"'f' \(cell \[1\], line 9\): its 'n' is 2 in the notebook and 3 in the module",
    ),
    "decorator that counts": (
        "def d(g):\n    n = 0\n    @functools.wraps(g)\n    def w(a):\n        nonlocal n\n        n += 1\n        return g(a) + n\n    return w\n"
        "@d\ndef f(a):\n    return a", "f", r"@d \(cell \[1\], line 9\): 'w' changes 'n' of the function around it",
    ),
    "decorator that derives from what has changed": (
        "LIM = 2\ndef d(g):\n    lim = LIM * 2\n    @functools.wraps(g)\n    def w(a):\n        return g(a) * lim\n    return w\n"
        "@d\ndef f(a):\n    return a\nLIM = 3", "f", r"'f' \(cell \[1\], line 8\): its 'lim' is 4 in the notebook and 6 in the module",
    ),
    "decorator that derives from a changed argument": (
        "N = 2\ndef d(n):\n    lim = n * 2\n    def deco(g):\n        @functools.wraps(g)\n        def w(a):\n            return g(a) * lim\n"
        "        return w\n    return deco\n@d(N)\ndef f(a):\n    return a\nN = 3", "f", r"'f' \(cell \[1\], line 10\): its 'lim' is 4 in the notebook and 6",
    ),
    "decorator that remembers": (
        "def d(g):\n    seen = {}\n    @functools.wraps(g)\n    def w(a):\n        seen.setdefault('first', g(a))\n        return a - seen['first']\n"
        "    return w\n@d\ndef f(a):\n    return a", "f", r"@d \(cell \[1\], line 8\): 'w' writes into 'seen', .*\(cell \[1\], line 5\)",
    ),
    "decorator that registers": (
        "REG = {}\ndef register(g):\n    @functools.wraps(g)\n    def w(a):\n        return g(a)\n    REG[g.__name__] = w\n    return w\n"
        "@register\ndef f(a):\n    return a", "f", r"@register \(cell \[1\], line 8\): 'register' writes into 'REG', .*\(cell \[1\], line 6\)",
    ),
    "decorator with a default that was changed": (
        "N = 2\ndef d(g):\n    @functools.wraps(g)\n    def w(a, n=N):\n        return g(a) * n\n    return w\n@d\ndef f(a):\n    return a\nN = 3", "f",
        r"'f' \(cell \[1\], line 7\): its default of 'n' is 2 in the notebook and 3",
    ),
    "library's decorator with a changed argument": (
        "N = 2\n@functools.lru_cache(N)\ndef f(a):\n    return a\nN = 3", "f", r"'f' \(cell \[1\], line 2\): its parameters\['maxsize'\] is 2 in the notebook and 3",
    ),
    "value of a module that was changed": (
        "import string\nstring.digits = '0123456789'\ndef f(a):\n    return string.digits", "f",
        r"'string\.digits', which the notebook has changed \(cell \[1\], line 2\).* make the value a token",
    ),
    "partial in the place of a module's function": (
        "import textwrap\nkeep = textwrap.dedent\ntextwrap.dedent = functools.partial(keep)\ndef f(a):\n    return textwrap.dedent('a')\ntextwrap.dedent = keep", "f",
        r"'textwrap\.dedent', which the notebook has changed \(cell \[1\], line 6\)",
    ),
    "method that was changed of a library's class": (
        "from fractions import Fraction\nFraction.doubled = lambda self: 2 * self\n"
        "def f(a):\n    return float(Fraction(1, 7).doubled())\ndel Fraction.doubled", "f",
        r"'Fraction\.doubled', which the notebook has changed \(cell \[1\], line \d\)",
    ),
    "builtin that the notebook has added": (
        "import builtins\nbuiltins.doubled_here = lambda a: 2 * a\ndef f(a):\n    return doubled_here(a)\ndel builtins.doubled_here", "f",
        r"'doubled_here', which the notebook has changed \(cell \[1\], line \d\)",
    ),
    "attribute of a module that is set by name": (
        "def f(a):\n    setattr(np, '_counted_here', getattr(np, '_counted_here', 0) + 1)\n    return a * np._counted_here", "f",
        r"writes into 'np', .*\(cell \[1\], line 2\)",
    ),
    "environment that a cell changes": (
        "import os\nos.environ['EPYPES_HOSTILE'] = '2'\ndef f(a):\n    return os.getenv('EPYPES_' + 'HOSTILE')", "f",
        r"'f' reads the environment, which the notebook has changed \(cell \[1\], line 2\).* make the value a token",
    ),
    "environment by a name of its own": (
        "from os import environ, path\nenviron.setdefault('EPYPES_HOSTILE', '2')\ndef f(a):\n    return path.expandvars('$EPYPES_HOSTILE')", "f",
        r"reads the environment, which the notebook has changed \(cell \[1\], line 2\)",
    ),
    "colour map that a cell registers": (
        "import matplotlib\nmatplotlib.colormaps.register(matplotlib.colormaps['gray'], name='epypes_hostile', force=True)\n"
        "def f(a):\n    return matplotlib.colormaps['epypes_hostile'](a)", "f", r"'matplotlib\.colormaps', which the notebook has changed \(cell \[1\], line 2\)",
    ),
    "object that keeps something": (
        "class Mean:\n    def __init__(self):\n        self.seen = []\n    def add(self, a):\n        self.seen.append(a)\n        return len(self.seen)\n"
        "mean = Mean()\ndef f(a):\n    return mean.add(a)", "f", r"uses 'mean' from it, of type Mean.* cg = ep\.delay\(cg, 'mean', 'mean_before'",
    ),
    "object that was changed": (
        "class Level:\n    def __init__(self, k):\n        self.k = k\n    def of(self, a):\n        return a > self.k\nlevel = Level(3)\nlevel.k = 5\nf = level.of", "f",
        r"attribute 'k' is 5 in the notebook and 3 in the module",
    ),
    "changed module that a function imports": (
        "import string\nsetattr(string, 'digits', '0123456789')\ndef f(a):\n    from string import digits\n    return digits", "f",
        r"string\.digits', which the notebook has changed \(cell \[1\], line 2\)",
    ),
    "all names of the notebook": ("K = 1\ndef f(a):\n    return globals()['K']", "f", r"'globals' \(cell \[1\], line 3\), all names.* by name"),
    "evaluated text": ("K = 1\ndef f(a):\n    return eval('K')", "f", r"'eval' \(cell \[1\], line 3\), which may use any name\. Write what"),
    "array that a function writes its result into": (
        "K = np.zeros((2, 3))\ndef f(a):\n    return np.maximum(K, a, out=K).copy()", "f", r"writes into 'K', .*\(cell \[1\], line 3\)",
    ),
    "set of a class": (
        "class M:\n    seen = set()\ndef f(a):\n    M.seen.add(a.size)\n    return a", "f", r"writes into 'M', .*\(cell \[1\], line 4\)",
    ),
    "partial of an object": ("f = functools.partial(np.add, object())", "f", r"has a value of type object inside.* Make it inside the function"),
    "attributes": ("def f(a):\n    return a\nf.seen = 3", "f", r"'f' \(cell \[1\], line 1\): it has attribute 'seen' only in the notebook.* make it a token"),
}  # fmt: skip


def in_notebook(monkeypatch: pytest.MonkeyPatch, *cells: str, **known: object) -> dict:
    """Run cells as a notebook does: one after another in ``__main__``, which keeps their text; return its names."""
    main = types.ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    names = vars(main)
    names.update(known, In=[""])
    for number, source in enumerate(cells, 1):
        names["In"].append(source)
        name = f"<hostile cell {id(main)} {number}>"
        linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
        exec(compile(source, name, "exec"), names)
    return names


def graph_cell(functions: dict[str, str]) -> str:
    """Return a cell that makes a runner of functions which all take the same array, and runs it."""
    listed = "".join(f"    {name!r}: {source},\n" for name, source in functions.items())
    return (
        f"functions = {{\n{listed}}}\n"
        "io = {name: ('a', f'{name}_made') for name in functions}\n"
        "io |= {'method': ('a', 'method_made'), 'looked': ('k', 'looked_made')} if 'method' in io else {}\n"
        "runner = ep.CompGraphRunner(ep.CompGraph(functions, io, types=False), {'k': 3} if 'looked' in io else {})\n"
        "_ = runner.run(a=np.arange(6.0).reshape(2, 3))"
    )


# A notebook as people leave it: magics and shell escapes everywhere between its functions.
MAGIC = (
    "%matplotlib inline\n%config InlineBackend.figure_format = 'png'\n!echo hello",
    "files = !ls /\n%env EPYPES_HOSTILE=1\npwd = %pwd",
    "%%time\ntotal_time = sum(range(9))",
    "%%capture shown\nprint('caught')\n# In a cell that is captured.\ndef captured(a):\n    return a + total_time",
    "%%bash\necho from a shell",
    "import os\nassert os.environ['EPYPES_HOSTILE'] == '1' and files and pwd",
    "captured?",
)
# What a notebook's own syntax makes of these is no Python that a service has.
MAGIC_INSIDE = (
    "def shell(a):\n    !echo hello\n    return a",
    "def magic(a):\n    %time None\n    return a",
    "%%time\ndef timed(a):\n    return a",
)
