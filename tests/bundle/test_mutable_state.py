"""No answer of a bundle depends on an earlier event, whatever its functions keep that no sample has touched."""

from __future__ import annotations

import os
import queue
import sys
import textwrap
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor, wait

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.errors import PromotionRefused, StateChanged
from tests.bundle.cells import cell

SETTINGS = '[bundle]\nformat = 1\nname = "b"\n[ports]\ninputs = ["x"]\noutputs = ["y"]\n'
HEAD = (
    "import functools\nimport itertools\nimport operator\nimport collections\nimport random\n\nimport numpy as np\n\n"
)
FOOT = '\nfunc_dict, func_io = {"f": f}, {"f": ("x", "y")}\n'


def bundle(folder, source, settings=SETTINGS):
    """Write a bundle by hand, as if the function's samples had all been small numbers."""
    folder.mkdir(parents=True)
    (folder / "pipeline.toml").write_text(settings)
    (folder / "pipeline.py").write_text(HEAD + textwrap.dedent(source) + FOOT * ("func_dict" not in source))
    write_manifest(folder)
    return folder


def answer(runner, x):
    try:
        return repr(runner.run(x=x)["y"])
    except Exception as error:
        return type(error).__name__


# By name: a module, and what the failure names. Each function answers with what it has kept; above 100 it keeps more.
KEPT = {
    "mutable default": ("def f(x, acc=[]):\n    if x > 100: acc.append(x)\n    return len(acc)", "acc"),
    "keyword default": ("def f(x, *, acc={}):\n    if x > 100: acc[x] = 1\n    return len(acc)", "acc"),
    "global": ("acc = []\ndef f(x):\n    if x > 100: acc.append(x)\n    return len(acc)", "acc"),
    "global that is bound": ("n = 0\ndef f(x):\n    global n\n    if x > 100: n += 1\n    return n", "n"),
    "globals()": ("n = 0\ndef f(x):\n    if x > 100: globals()['n'] = x\n    return n", "n"),
    "alias": ("A, B = [], []\ndef f(x):\n    a, b = A, B\n    if x > 100: b.append(x)\n    return len(b)", "B"),
    "helper that returns a global": (
        "L = []\ndef kept():\n    return L\ndef f(x):\n    if x > 100: kept().append(x)\n    return len(L)", "L",
    ),
    "bound append": ("L = []\npush = L.append\ndef f(x):\n    if x > 100: push(x)\n    return push.__self__.count(x)", "push"),
    "getattr": ("L = []\ndef f(x):\n    if x > 100: getattr(L, 'app' + 'end')(x)\n    return len(L)", "L"),
    "array that compiled code takes only unlocked": (
        "from scipy.signal import sosfilt\nS = np.array([[1.0, 0, 0, 1, 0, 0]])\n"
        "def f(x):\n    found = sosfilt(S, [1.0])\n    if x > 100: S[0, 0] += 1\n    return found.tolist()", "S",
    ),
    "both numbers of a pair that are drawn": (
        "R = np.random.RandomState(0)\ndef f(x):\n    return round(R.normal() if x > 100 else 0.0, 6)", "R",
    ),
    "background model in a cache": (
        "import cv2\n@functools.cache\ndef model():\n    return cv2.createBackgroundSubtractorMOG2()\n"
        "def f(x):\n    return int(model().apply(np.full((9, 9), x, np.uint8)).sum()) if x > 100 else 0", "model",
    ),
    "map": ("L = []\ndef f(x):\n    if x > 100: list(map(L.append, [x]))\n    return len(L)", "L"),
    "walrus": ("L = []\ndef f(x):\n    if x > 100: (l := L).append(x)\n    return len(L)", "L"),
    "with ... as": (
        "import contextlib\nL = []\ndef f(x):\n    with contextlib.nullcontext(L) as l:\n        if x > 100: l.append(x)\n    return len(L)",
        "L",
    ),
    "keywords": ("L = []\ndef keep(**kw):\n    kw['l'].append(1)\ndef f(x):\n    if x > 100: keep(**{'l': L})\n    return len(L)", "L"),
    "comprehension": ("L = []\ndef f(x):\n    [L.append(n) for n in [x] if n > 100]\n    return len(L)", "L"),
    "inner function": ("L = []\ndef f(x):\n    def keep():\n        L.append(x)\n    if x > 100: keep()\n    return len(L)", "L"),
    "lambda": ("L = []\nkeep = lambda x: L.append(x)\ndef f(x):\n    if x > 100: keep(x)\n    return len(L)", "L"),
    "loop variable": ("L = [[]]\ndef f(x):\n    for part in L:\n        if x > 100: part.append(x)\n    return len(L[0])", "L"),
    "defaultdict that is read": ("D = collections.defaultdict(list)\ndef f(x):\n    if x > 100: D[x]\n    return len(D)", "D"),
    "setdefault": ("D = {}\ndef f(x):\n    if x > 100: D.setdefault(x, 1)\n    return len(D)", "D"),
    "order of a dict": ("D = {'a': 1, 'b': 2}\ndef f(x):\n    if x > 100: D['a'] = D.pop('a')\n    return list(D)", "D"),
    "operator": ("L = [1]\ndef f(x):\n    if x > 100: operator.iadd(L, [x])\n    return len(L)", "L"),
    "deque": ("Q = collections.deque(maxlen=3)\ndef f(x):\n    if x > 100: Q.append(x)\n    return len(Q)", "Q"),
    "bytearray": ("B = bytearray(b'a')\ndef f(x):\n    if x > 100: B[0] += 1\n    return bytes(B)", "B"),
    "class attribute": ("class C:\n    n = 0\ndef f(x):\n    if x > 100: C.n += 1\n    return C.n", "C.n"),
    "list of a class": ("class C:\n    items = []\ndef f(x):\n    if x > 100: C().items.append(x)\n    return len(C.items)", "C.items"),
    "setattr": ("class C:\n    n = 0\ndef f(x):\n    if x > 100: setattr(C, 'n', x)\n    return C.n", "C.n"),
    "instance": (
        "class C:\n    def __init__(self): self.n = 0\n    def count(self): self.n += 1\nc = C()\n"
        "def f(x):\n    if x > 100: c.count()\n    return c.n", "c",
    ),
    "instance with slots": (
        "class C:\n    __slots__ = ('n',)\n    def __init__(self): self.n = 0\nc = C()\ndef f(x):\n    if x > 100: c.n += 1\n    return c.n", "c",
    ),
    "callable instance": (
        "class C:\n    def __init__(self): self.n = 0\n    def __call__(self, x):\n        if x > 100: self.n += 1\n        return self.n\nf = C()",
        "f",
    ),
    "bound method": (
        "class C:\n    def __init__(self): self.n = 0\n    def m(self, x):\n        if x > 100: self.n += 1\n        return self.n\nf = C().m", "f",
    ),
    "function attribute": ("def f(x):\n    if x > 100: f.n = getattr(f, 'n', 0) + 1\n    return getattr(f, 'n', 0)", "f.n"),
    "default that is replaced": ("def f(x, n=0):\n    if x > 100: f.__defaults__ = (x,)\n    return n", "f.__defaults__"),
    "nonlocal": (
        "def make():\n    n = 0\n    def f(x):\n        nonlocal n\n        if x > 100: n += 1\n        return n\n    return f\nf = make()", "n",
    ),
    "closure": ("def make():\n    acc = []\n    def f(x):\n        if x > 100: acc.append(x)\n        return len(acc)\n    return f\nf = make()", "acc"),
    "decorator": (
        "def counted(g):\n    calls = []\n    @functools.wraps(g)\n    def call(x):\n        if x > 100: calls.append(x)\n        return len(calls)\n    return call\n"
        "@counted\ndef f(x):\n    return x", "calls",
    ),
    "partial": ("def g(acc, x):\n    if x > 100: acc.append(x)\n    return len(acc)\nf = functools.partial(g, [])", "f"),
    "list of an lru_cached helper's argument": (
        "L = []\n@functools.cache\ndef keep(x):\n    if x > 100: L.append(x)\n    return x\ndef f(x):\n    keep(x)\n    return len(L)", "L",
    ),
    "list of an lru_cached helper": (
        "@functools.lru_cache\ndef items(n): return [n]\ndef f(x):\n    found = items(3)\n    if x > 100: found.append(x)\n    return len(found)", "items",
    ),
    "dict in a tuple of a method's cache": (
        "class C:\n    @functools.cache\n    def table(self, n): return n, {}\nc = C()\n"
        "def f(x):\n    found = c.table(3)[1]\n    if x > 100: found[x] = 1\n    return len(found)", "C.table",
    ),
    "list in the cache of an object": (
        "class C:\n    def __init__(self): self.items = functools.cache(self.made)\n    def made(self, n): return [n]\nc = C()\n"
        "def f(x):\n    found = c.items(3)\n    if x > 100: found.append(x)\n    return len(found)", "c",
    ),
    "value of a cache that the call computes": (
        "@functools.cache\ndef items(n): return [n]\ndef f(x):\n    if x > 100: items(3).append(x)\n    return len(items(3))", "items",
    ),
    "SimpleNamespace": ("import types\ns = types.SimpleNamespace(n=0)\ndef f(x):\n    if x > 100: s.n += 1\n    return s.n", "s"),
    "random generator": ("rng = random.Random(0)\ndef f(x):\n    return rng.random() if x > 100 else rng.getstate()[1][:2]", "rng"),
    "NumPy generator": ("rng = np.random.default_rng(0)\ndef f(x):\n    return rng.random() if x > 100 else str(rng.bit_generator.state)", "rng"),
    "array in an unguarded function": (
        "import epypes as ep\nW = np.zeros(2)\n@ep.unguarded\ndef f(x):\n    if x > 100: W[0] += 1\n    return W.tolist()", "W",
    ),
    "array that is unlocked": (
        "W = np.zeros(2)\ndef f(x):\n    if x > 100:\n        W.setflags(write=True)\n        W[0] += 1\n    return W.tolist()", "W",
    ),
    "shape of an array": (
        "import warnings\nW = np.zeros((2, 3))\ndef f(x):\n    with warnings.catch_warnings():\n        warnings.simplefilter('ignore')  # of NumPy 2.5\n"
        "        if x > 100: W.shape = (6,)\n    return W.shape", "W",
    ),
    "while it raises something else": (
        "L = []\ndef f(x):\n    if x > 100:\n        L.append(x)\n        raise ValueError(x)\n    return len(L)", "",
    ),
}  # fmt: skip

# By name: what a function does above 100, and what of the process it answers with. Each must fail by the name.
SETTINGS_OF_THE_PROCESS = {
    "numpy.seterr": ("np.seterr(all='raise')", "np.geterr()"),
    "numpy.seterr ": ("getattr(np, 'set' + 'err')(divide='raise')", "np.geterr()"),
    "numpy.set_printoptions": ("np.set_printoptions(precision=2)", "np.get_printoptions()['precision']"),
    "sys.set_int_max_str_digits": ("sys.set_int_max_str_digits(5432)", "sys.get_int_max_str_digits()"),
    "cv2.setUseOptimized": ("cv2.setUseOptimized(not cv2.useOptimized())", "cv2.useOptimized()"),
    "locale.setlocale": ("locale.setlocale(locale.LC_CTYPE, 'C')", "locale.setlocale(locale.LC_CTYPE)"),
    "warnings.simplefilter": ("warnings.simplefilter('error')", "[*warnings.filters]"),
    "warnings.simplefilter ": ("warnings.filters.insert(0, ('error', None, OSError, None, 0))", "[*warnings.filters]"),
    "decimal.getcontext": ("decimal.getcontext().prec = 3", "decimal.Decimal(1) / 3"),
    "decimal.getcontext ": ("decimal.getcontext().traps[decimal.Inexact] = True", "dict(decimal.getcontext().traps)"),
    "os.environ": ("os.environ['EPYPES_TEST'] = '1'", "os.environ.get('EPYPES_TEST')"),
    "os.environ ": ("os.environ.pop('HOME', None)", "os.environ.get('HOME')"),
    "os.environ  ": ("os.environ.update(TZ='XYZ-9'); time.tzset()", "time.localtime(0).tm_hour"),
    "scipy.special.seterr": ("special.seterr(all='raise')", "special.geterr()"),
    "calendar.setfirstweekday": ("calendar.setfirstweekday(5)", "calendar.firstweekday()"),
    "csv.field_size_limit": ("csv.field_size_limit(77)", "csv.field_size_limit()"),
    "csv.register_dialect": ("csv.register_dialect('plc', delimiter=';')", "csv.list_dialects()"),
    "os.chdir": ("os.chdir('/')", "os.getcwd()"),
    "os.chdir ": ("go('/')", "os.getcwd()"),
    "ContextVar gain": ("GAIN.set(2)", "GAIN.get()"),
    "ContextVar kernel": ("KERNEL.set(np.ones(3))", "KERNEL.get()"),
    "pandas.set_option": ("pd.set_option('display.precision', 2)", "pd.get_option('display.precision')"),
    "matplotlib.rcParams": ("matplotlib.rcParams['image.cmap'] = 'gray'", "matplotlib.rcParams['image.cmap']"),
}  # fmt: skip
# What no function computes anything else with: it is put back without a failure.
QUIET_SETTINGS = {
    "numpy.seterr": ("np.seterr(all='ignore')", "np.geterr()"),
    "sys.setrecursionlimit": ("sys.setrecursionlimit(5432)", "sys.getrecursionlimit()"),
    "cv2.setNumThreads": ("cv2.setNumThreads(cv2.getNumThreads() + 1)", "cv2.getNumThreads()"),
    "warnings.simplefilter": ("warnings.simplefilter('ignore')", "[*warnings.filters]"),
}
IMPORTS_OF_SETTINGS = (
    "import calendar, contextvars, csv, decimal, locale, os, sys, time, warnings\nimport cv2, matplotlib\nimport pandas as pd\n"
    "from os import chdir as go\nfrom scipy import special\n"
    "GAIN, KERNEL = contextvars.ContextVar('gain', default=1), contextvars.ContextVar('kernel')\nKERNEL.set(np.zeros(3))\n"
)

# By name: a module whose function, which is not a plain one, changes a setting above 100.
SETTERS = {
    "partial": "def g(k, x):\n    if x > 100: np.seterr(all='raise')\n    return np.geterr()\nf = functools.partial(g, 3)",
    "cache": "@functools.cache\ndef f(x):\n    if x > 100: np.seterr(all='raise')\n    return np.geterr()",
    "vectorized": "f = np.vectorize(lambda x: np.seterr(all='raise' if x > 100 else None)['over'])",
    "object": "class C:\n    def __call__(self, x):\n        if x > 100: np.seterr(all='raise')\n        return np.geterr()\nf = C()",
    "node": (
        "import epypes as ep\ndef g(x):\n    if x > 100: np.seterr(all='raise')\n    return np.geterr()\nf = ep.Node('f', g)"
    ),
    "function of a library": (
        "def g(x): return 'raise' if x > 100 else None\n"
        "func_dict, func_io = {'g': g, 'f': np.seterr}, {'g': ('x', 'z'), 'f': ('z', 'y')}"
    ),
}  # fmt: skip

# By name: a module whose function changes something of a library, of an Enum or a logger above 100, through a helper.
PATCHES_IN_A_BRANCH = {
    "cv2.INTER_AREA": ("import cv2\ndef f(x):\n    if x > 100: cv2.__dict__.update(INTER_AREA=x)\n    return cv2.INTER_AREA"),
    "colorsys.ONE_SIXTH": (
        "import colorsys\ndef keep(owner, **values):\n    vars(owner).update(values)\n"
        "def f(x):\n    if x > 100: keep(colorsys, ONE_SIXTH=x)\n    return colorsys.hls_to_rgb(0.1, 0.2, 0.3), colorsys.ONE_SIXTH"
    ),
    "textwrap._whitespace": (
        "import textwrap\ndef keep(owner):\n    owner._whitespace = 'a'\ndef f(x):\n    if x > 100: keep(textwrap)\n    return textwrap._whitespace"
    ),
    "numpy.n_calls": (
        "def keep(owner):\n    owner.n_calls = 1 + getattr(owner, 'n_calls', 0)\n"
        "def f(x):\n    if x > 100: keep(np)\n    return getattr(np, 'n_calls', 0)"
    ),
    "numpy.linalg.norm": (
        "def keep(owner, value):\n    owner.norm = value\ndef f(x):\n    if x > 100: keep(np.linalg, len)\n    return np.linalg.norm([3, 4])"
    ),
    "Fraction.limit_denominator": (
        "from fractions import Fraction\ndef keep(owner, name, value):\n    setattr(owner, name, value)\n"
        "def f(x):\n    if x > 100: keep(Fraction, 'limit_denominator', lambda self: 0)\n    return Fraction(1, 3).limit_denominator()"
    ),
    "indent.__defaults__": (
        "from textwrap import indent\ndef keep(g, value):\n    g.__defaults__ = value\n"
        "def f(x):\n    if x > 100: keep(indent, (bool,))\n    return indent('a\\n\\n', '> ')"
    ),
    "Colour.RED.seen": (
        "import enum\nclass Colour(enum.Enum):\n    RED = 1\ndef keep(member):\n    member.seen = True\n"
        "def f(x):\n    if x > 100: keep(Colour.RED)\n    return hasattr(Colour.RED, 'seen')"
    ),
    "LOG.seen": (
        "import logging\nLOG = logging.getLogger('b')\ndef keep(log):\n    log.seen = 1\n"
        "def f(x):\n    if x > 100: keep(LOG)\n    return hasattr(LOG, 'seen')"
    ),
}  # fmt: skip


# Arrays are locked: NumPy itself refuses, at the line.
LOCKED = {
    "array": "W = np.zeros(2)\ndef f(x):\n    if x > 100: W[0] += 1\n    return W.tolist()",
    "positional out": "W = np.zeros(2)\ndef f(x):\n    if x > 100: np.multiply(x, 2, W)\n    return W.tolist()",
    "view": "W = np.zeros((2, 2))\nV = W[0]\ndef f(x):\n    if x > 100: V[0] += 1\n    return V.tolist()",
    "base of a view": "W = np.zeros((2, 2))\nV = W[0]\ndef f(x):\n    if x > 100: V.base[0] += 1\n    return V.tolist()",
    "mask": "W = np.ma.masked_array([1, 2], [False, True])\ndef f(x):\n    if x > 100: W.mask[0] = True\n    return W.sum()",
    "in a dict": "D = {'w': np.zeros(2)}\ndef f(x):\n    if x > 100: D['w'][0] += 1\n    return D['w'].tolist()",
    "of an lru_cached helper": (
        "@functools.lru_cache\ndef kernel(n):\n    return np.zeros(n)\ndef f(x):\n    k = kernel(3)\n    if x > 100: k += 1\n    return k.tolist()"
    ),
    "of a method's cache": (
        "class C:\n    @functools.lru_cache\n    def kernel(self, n):\n        return np.zeros(n)\nc = C()\n"
        "def f(x):\n    k = c.kernel(3)\n    if x > 100: k += 1\n    return k.tolist()"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", KEPT)
def test_a_call_that_changes_what_outlives_it_fails_and_is_undone(case, tmp_path):
    source, changed = KEPT[case]
    runner = ep.load(bundle(tmp_path / "b", source))
    first = answer(runner, 1)
    for _ in range(5):  # the fourth run is compiled
        with pytest.raises((StateChanged, ValueError)) as error:
            runner.run(x=200)
        if changed:
            assert str(error.value).startswith(f"Function 'f' changed {changed!r}, which outlives the call.")
            assert (error.value.function, error.value.changed) == ("f", changed)
            assert runner.last.failure.function == "f"
        assert answer(runner, 1) == first


def fails_and_is_undone(runner, changed):
    first = answer(runner, 1)
    for _ in range(5):
        with pytest.raises(StateChanged) as error:
            runner.run(x=200)
        assert (error.value.function, error.value.changed, error.value.is_restored) == ("f", changed, True)
        has_set = tuple(map(str.strip, SETTINGS_OF_THE_PROCESS))
        assert ("set it back before it returns" in str(error.value)) == changed.startswith(has_set)
        assert answer(runner, 1) == first


@pytest.mark.parametrize("setting", SETTINGS_OF_THE_PROCESS)
def test_a_call_that_changes_a_setting_of_the_process_fails_by_its_name_and_is_undone(setting, tmp_path):
    change, read = SETTINGS_OF_THE_PROCESS[setting]
    source = f"{IMPORTS_OF_SETTINGS}def f(x):\n    if x > 100: {change}\n    return {read}"
    fails_and_is_undone(ep.load(bundle(tmp_path / "b", source)), setting.strip())


@pytest.mark.parametrize("setting", QUIET_SETTINGS)
def test_a_setting_that_changes_no_value_is_put_back_without_a_failure(setting, tmp_path):
    change, read = QUIET_SETTINGS[setting]
    source = f"{IMPORTS_OF_SETTINGS}def f(x):\n    if x > 100: {change}\n    return {read}"
    with warnings.catch_warnings():
        warnings.resetwarnings()
        runner = ep.load(bundle(tmp_path / "b", source))
        first = answer(runner, 1)
        for _ in range(5):
            assert answer(runner, 200) not in (first, "StateChanged")
            assert answer(runner, 1) == first


@pytest.mark.parametrize("kind", SETTERS)
def test_settings_are_compared_whatever_kind_of_function_changes_them(kind, tmp_path):
    fails_and_is_undone(ep.load(bundle(tmp_path / "b", SETTERS[kind])), "numpy.seterr")


@pytest.mark.parametrize("name", PATCHES_IN_A_BRANCH)
def test_a_call_that_patches_a_library_an_enumeration_or_a_logger_fails_and_is_undone(name, tmp_path):
    fails_and_is_undone(ep.load(bundle(tmp_path / "b", PATCHES_IN_A_BRANCH[name])), name)


@pytest.mark.parametrize(
    ("seed", "draw"),
    [
        ("random.seed(x)", "random.random()"),
        ("np.random.seed(x)", "np.random.rand()"),
        ("np.random.seed(x)", "np.random.default_rng(1).integers(9) + np.random.rand()"),
        ("np.random.seed(x)", "np.random.default_rng(1).integers(9) + stats.norm(0, 1).rvs()"),
        ("np.random.seed(x)", "[*np.random.default_rng(1).permutation(3), *pd.Series(range(99)).sample(5)]"),
        ("cv2.setRNGSeed(x)", "cv2.randu(np.zeros(3), 0, 9).tolist()"),
        (
            "cv2.setRNGSeed(x)",
            "[m.trainIdx for m in cv2.FlannBasedMatcher({'algorithm': 1}, {'checks': 2}).match(P[:99], P[99:])]",
        ),
        ("np.random.seed(x)", "vq.kmeans2(P, 4)[0].tolist()"),
        ("seed(x)", "draw()"),
    ],
)
def test_what_an_event_draws_depends_on_no_earlier_one_also_if_it_has_no_seed(seed, draw, tmp_path):
    source = f"""
from random import random as draw, seed
from scipy import stats
from scipy.cluster import vq
import cv2
import pandas as pd
P = np.random.default_rng(1).random((300, 16), np.float32)
def g(x):
    if x < 100: {seed}
    return x
def f(x, z):
    return {draw}
func_dict, func_io = {{"g": g, "f": f}}, {{"g": ("x", "z"), "f": (("x", "z"), "y")}}
"""
    runner = ep.load(bundle(tmp_path / "b", source))
    unseeded, seeded = answer(runner, 200), answer(runner, 1)
    assert "Error" not in unseeded + seeded
    assert unseeded != seeded
    assert [answer(runner, x) for x in (2, 200, 200, 1, 3, 200, 1)][1:4] == [unseeded, unseeded, seeded]


SETTING_AND_BACK = """
import contextvars, decimal, os, warnings
import cv2
GAIN = contextvars.ContextVar('gain', default=1)
def f(x):
    n, token = cv2.getNumThreads(), GAIN.set(x)
    cv2.setNumThreads(n + 1)
    with warnings.catch_warnings(), np.errstate(all='raise'), np.printoptions(precision=2), decimal.localcontext(prec=3):
        warnings.simplefilter('error')
        found = str(decimal.Decimal(1) / 3), os.path.join('a', 'b'), GAIN.get()
    GAIN.reset(token)
    cv2.setNumThreads(n)
    return found
"""


def test_settings_that_a_call_changes_and_puts_back_are_no_change_also_in_threads(tmp_path):
    runner = ep.load(bundle(tmp_path / "b", SETTING_AND_BACK))
    with ThreadPoolExecutor(8) as pool:
        found = [*pool.map(lambda x: answer(runner, x), range(200))]
    assert found == [f"('0.333', 'a/b', {x})" for x in range(200)]


IN_ANOTHER_FOLDER = """
import contextlib, os, threading
inside, ended = threading.Event(), threading.Event()
def f(x):
    with contextlib.chdir("/"):
        inside.set()
        ended.wait(60)
    return x
def g(x):
    return os.getcwd()
func_dict, func_io = {"f": f, "g": g}, {"f": ("x", "y"), "g": ("x", "z")}
"""


def test_no_other_call_sees_the_folder_that_a_call_has_changed_for_a_while(tmp_path):
    runner = ep.load(bundle(tmp_path / "b", IN_ANOTHER_FOLDER))
    names = runner.cg.functions["f"].__globals__
    with ThreadPoolExecutor(2) as pool:
        changing = pool.submit(runner.run, "y", x=1)
        assert names["inside"].wait(60)
        reading = pool.submit(runner.run, "z", x=1)
        done, _ = wait([reading], timeout=0.5)
        names["ended"].set()
        assert reading.result(60)["z"] == os.getcwd()
    assert not done
    assert changing.result()["y"] == 1


CATCHING = """
import threading, warnings
caught, ended = threading.Barrier(2), threading.Event()
def f(x):
    if x > 100:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            caught.wait(60)
            ended.wait(60)
    return x
def g(x):
    caught.wait(60)
    return x
func_dict, func_io = {"f": f, "g": g}, {"f": ("x", "y"), "g": ("x", "z")}
"""


def test_a_call_that_catches_warnings_has_no_other_one_called_again(tmp_path):
    runner = ep.load(bundle(tmp_path / "b", CATCHING))
    ended = runner.cg.functions["f"].__globals__["ended"]
    with ThreadPoolExecutor(1) as pool:
        catching = pool.submit(lambda: runner.run("y", x=200)["y"])
        assert runner.run("z", x=1)["z"] == 1, "it ends before the other one, and is called once"
        ended.set()
        assert catching.result(60) == 200


def test_settings_that_are_changed_between_events_are_no_change_and_stay(tmp_path):
    runner = ep.load(
        bundle(tmp_path / "b", "import cv2\ndef f(x):\n    return np.geterr()['over'], cv2.getNumThreads()")
    )
    threads = cv2.getNumThreads()
    try:
        for number in (threads + 1, threads):
            cv2.setNumThreads(number)
            with np.errstate(over="raise"):
                assert answer(runner, 1) == f"('raise', {number})"
            assert cv2.getNumThreads() == number
    finally:
        cv2.setNumThreads(threads)


def test_what_a_module_sets_when_it_is_imported_is_no_change(tmp_path, monkeypatch):
    (tmp_path / "setting_module.py").write_text(
        "import warnings, sys\nwarnings.simplefilter('error')\nsys.setrecursionlimit(4321)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    source = (
        "import sys\ndef f(x):\n    if x > 100: import setting_module\n    return x, sys.getrecursionlimit() == 4321"
    )
    runner = ep.load(bundle(tmp_path / "b", source))
    assert [answer(runner, x) for x in (1, 200, 1, 200)] == ["(1, False)", "(200, True)", "(1, False)", "(200, False)"]
    sys.modules.pop("setting_module", None)


@pytest.mark.parametrize("case", LOCKED)
def test_arrays_are_locked_so_that_the_line_that_writes_fails(case, tmp_path):
    runner = ep.load(bundle(tmp_path / "b", LOCKED[case]))
    first = answer(runner, 1)
    for _ in range(3):
        with pytest.raises(ValueError, match="read-only"):
            runner.run(x=200)
        assert answer(runner, 1) == first


@pytest.mark.parametrize(
    "source",
    [
        "counter = itertools.count()\ndef f(x):\n    return next(counter) if x > 100 else 0",
        "numbers = iter([1, 2, 3])\ndef f(x):\n    return next(numbers) if x > 100 else 0",
        "following = itertools.count().__next__\ndef f(x):\n    return following() if x > 100 else 0",
        "def counting():\n    n = 0\n    while True:\n        yield (n := n + 1)\nnumbers = counting()\n"
        "def f(x):\n    return next(numbers) if x > 100 else 0",
    ],
)
def test_an_iterator_can_not_be_put_back_so_every_later_event_fails_and_says_so(source, tmp_path):
    folder = bundle(tmp_path / "b", source)
    runner = ep.load(folder)
    assert runner.run(x=1)["y"] == 0
    for x in (200, 1, 200):
        with pytest.raises(StateChanged, match="can't be put back"):
            runner.run(x=x)
    assert ep.load(folder).run(x=1)["y"] == 0


CONSTANT = {
    "nothing": "def f(x):\n    return x",
    "constants": "KEPT = [3, 1, 2]\nTABLE = {'a': 1}\nW = np.eye(2)\ndef f(x):\n    return sorted(KEPT), {**TABLE, 'b': x}, (W + x).tolist()",
    "array that compiled code takes only unlocked": "from scipy.signal import sosfilt\nS = np.array([[1.0, 0, 0, 1, 0, 0]])\n"
    "def f(x):\n    return sosfilt(S, [x, x]).tolist()",
    "C objects": "import cv2\norb = cv2.ORB_create(5)\nclahe = cv2.createCLAHE()\ndef f(x):\n    return clahe.apply(np.full((9, 9), x % 255, np.uint8)).tolist()",
    "functions of libraries": "from numpy import multiply, concatenate\nfrom random import random as draw\nfrom numpy.random import rand\n"
    "def f(x):\n    draw(), rand()\n    return concatenate([multiply([x], 2)]).tolist()",
    "lazy import": "_json = None\ndef f(x):\n    global _json\n    if _json is None: import json as _json\n    return _json.dumps(x)",
    "lazy caches": "import pathlib, re, logging\nP, R, L = pathlib.PurePath('a/b'), re.compile('a'), logging.getLogger('l')\n"
    "many = np.vectorize(lambda n: n + 1)\ndef f(x):\n    L.debug('%s', x)\n    return str(P), hash(P) and 1, R.findall('aa'), int(many(x))",
    "cached property": "class C:\n    @functools.cached_property\n    def items(self): return []\nc = C()\n"
    "def f(x):\n    c.items.append(x)\n    return len(c.items)",
    "cache of a partial": "g = functools.cache(functools.partial(max, 3))\ndef f(x):\n    return g(x)",
    "more mutable values than a cache may have": "@functools.cache\ndef items(n): return [n]\ndef f(x):\n    return sum(len(items(n)) for n in range(1500))",
    "objects of the call": "class C:\n    def __init__(self): self.n = 0\n    def add(self, x): self.n += x\ndef f(x):\n    c = C()\n    c.add(x)\n    return c.n",
    "a change that is undone": "L = [1]\ndef f(x):\n    L.append(x)\n    return L.pop()",
    "the same again": "D = {'n': 1000}\ndef f(x):\n    D['n'] = int('1000')\n    return x",
    "seeded global generators": "def f(x):\n    random.seed(3)\n    np.random.seed(3)\n    return random.random(), float(np.random.rand())",
    "cache that is held in a tuple": "CACHES = (functools.cache(lambda n: [n]),)\n"
    "def f(x):\n    CACHES[0](3).append(x)\n    return len(CACHES[0](3))",
    "dispatch": "@functools.singledispatch\ndef g(x): return x\n@g.register\ndef _(x: int): return x + 1\ndef f(x):\n    return g(x)",
    "logger": "import logging\nLOG = logging.getLogger('b')\ndef f(x):\n    LOG.setLevel(x)\n    LOG.warning('x')\n    return x",
    "enumeration": "import enum\nclass E(enum.Flag):\n    A = 1\n    B = 2\ndef f(x):\n    return (E.A | E.B).value, E(x % 4).value",
    "warning": "import warnings\nn = 0\ndef f(x):\n    global n\n    with warnings.catch_warnings(record=True):\n        warnings.warn('a')\n    return x + n",
}  # fmt: skip


@pytest.mark.parametrize("case", CONSTANT)
def test_constants_caches_and_what_a_call_makes_itself_are_no_state(case, tmp_path):
    folder = bundle(tmp_path / "b", CONSTANT[case])
    runner = ep.load(folder)
    expected = {x: answer(runner, x) for x in (1, 200)}
    assert not any("Changed" in text or "Error" in text for text in expected.values())
    for x in (200, 1, 1, 200, 200):
        assert answer(runner, x) == expected[x]


def test_a_memo_keeps_its_arrays_and_its_numbers_warm(tmp_path):
    source = """
    calls = []
    @functools.lru_cache
    def kernel(n):
        return np.ones(n), n
    @functools.lru_cache(maxsize=None)
    def fib(n):
        return n if n < 2 else fib(n - 1) + fib(n - 2)
    def f(x):
        return kernel(3)[0].sum() + fib(30)
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    for x in range(9):
        assert runner.run(x=x)["y"] == 832043
    names = runner.cg.functions["f"].__globals__
    assert names["kernel"].cache_info()[:2] == (8, 1)
    assert names["fib"].cache_info().misses == 31


CACHES = {
    "of the module": """
import functools

@functools.cache
def table(n):
    return {"calls": 0}

def use(x):
    table(3)["calls"] += 1
    return x
""",
    "of a factory": """
import functools

def make():
    @functools.lru_cache
    def table(n):
        return [n]

    def use(x):
        table(3).append(x)
        return x

    return use

use = make()
""",
}


@pytest.mark.parametrize("source", CACHES.values(), ids=CACHES)
def test_a_function_that_changes_what_a_cache_holds_is_not_promoted(source, tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"use": cell(source)["use"]}, {"use": ("x", "y")}))
    runner.run(x=1)
    with pytest.raises(PromotionRefused, match="Function 'use' change.* 'table'.* which outlives the call"):
        ep.promote(runner, tmp_path / "b")
    assert not (tmp_path / "b").exists()


@pytest.mark.slow
def test_a_cache_that_the_promotion_alone_fills_and_changes_is_found_by_the_replay(tmp_path):
    source = CACHES["of the module"].replace("    return x\n", "    table.cache_clear()\n    return x\n")
    runner = ep.CompGraphRunner(ep.CompGraph({"use": cell(source)["use"]}, {"use": ("x", "y")}))
    runner.run(x=1)
    with pytest.raises(PromotionRefused, match="Function 'use' changed 'table', which outlives the call"):
        ep.promote(runner, tmp_path / "b")


def test_a_memo_that_no_name_of_the_module_has_keeps_its_numbers_warm(tmp_path):
    source = """
    class C:
        @staticmethod
        @functools.cache
        def squared(n):
            return n * n, n
    def f(x):
        return C.squared(3)[0]
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    assert [runner.run(x=x)["y"] for x in range(5)] == [9] * 5
    assert runner.cg.functions["f"].__globals__["C"].squared.cache_info()[:2] == (4, 1)


def test_a_memo_of_an_object_keeps_its_arrays_warm(tmp_path):
    source = """
    class Camera:
        def __init__(self):
            self.maps = functools.lru_cache(maxsize=2)(self._maps)
        def _maps(self, n):
            return np.ones(n), np.zeros(n)
    camera = Camera()
    def f(x):
        return float(camera.maps(3)[0].sum())
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    assert [runner.run(x=x)["y"] for x in range(5)] == [3.0] * 5
    assert runner.cg.functions["f"].__globals__["camera"].maps.cache_info()[:2] == (4, 1)


def test_functions_that_reach_nothing_that_can_change_are_called_as_they_are(tmp_path):
    source = "func_dict, func_io = {'f': np.multiply, 'g': np.sum}, {'f': (('x', 'x'), 'z'), 'g': ('z', 'y')}"
    runner = ep.load(bundle(tmp_path / "b", source))
    assert runner.run(x=np.arange(3))["y"] == 5
    assert dict(runner.cg.functions) == {"f": np.multiply, "g": np.sum}


def test_what_is_inside_of_a_hyperparameter_is_compared_too(tmp_path):
    source = "def f(x, cfg):\n    if x > 100: cfg['seen'].append(x)\n    return len(cfg['seen'])\n"
    graph = 'func_dict, func_io = {"f": f}, {"f": (("x", "cfg"), "y")}\n'
    settings = f"{SETTINGS}[hyperparameters.cfg]\nvalue = {{seen = []}}\n"
    runner = ep.load(bundle(tmp_path / "b", source + graph, settings))
    with pytest.raises(StateChanged, match="Function 'f' changed 'hyperparameter cfg', which outlives the call"):
        runner.run(x=200)
    assert runner.run(x=1)["y"] == 0


def test_reruns_and_trials_are_compared_too(tmp_path):
    settings = f"{SETTINGS}\n[hyperparameters.k]\nvalue = 1\n"
    source = """
    L = []
    def f(x, k):
        if k > 100: L.append(k)
        return len(L) + k
    func_dict, func_io = {"f": f}, {"f": (("x", "k"), "y")}
    """
    runner = ep.load(bundle(tmp_path / "b", source, settings))
    runner.run(x=1)
    for _ in range(6):
        with pytest.raises(StateChanged):
            runner.rerun(k=200)
        assert runner.rerun(k=2)["y"] == 2
        assert isinstance(runner.trial({"k": 200}).failure.exception, StateChanged)
        assert runner.trial({"k": 3})["y"] == 3


NESTED = """
import epypes as ep
L = []
def inner(x):
    if x > 100: L.append(x)
    return len(L)
class Counting(ep.Node):
    def compute(self, x):
        if x > 100: self.n = getattr(self, "n", 0) + 1
        return x + getattr(self, "n", 0)
pipe = ep.Pipeline("pipe", ep.CompGraph({"inner": inner}, {"inner": ("x", "z")}))
func_dict = {"pipe": pipe, "node": Counting("node", abs), "plain": ep.Node("plain", inner)}
func_io = {"pipe": ("x", "z"), "node": ("z", "y"), "plain": ("x", "w")}
"""


def test_nested_pipelines_and_nodes_are_compared_too(tmp_path):
    runner = ep.load(bundle(tmp_path / "b", NESTED))
    for _ in range(5):
        assert (runner.run(x=1)["y"], runner["w"]) == (0, 0)
        with pytest.raises(StateChanged, match="Function 'inner' changed 'L'"):
            runner.run(x=200)
        with pytest.raises(StateChanged, match="Function 'plain' changed 'L'"):
            runner.run("w", x=200)
    node = runner.cg.functions["node"]
    assert [node(x) for x in (0, 200, 0)] == [0, 201, 0], "what a component counts reaches no later event"


def test_events_of_a_pipeline_fail_and_the_next_ones_do_not_depend_on_them(tmp_path):
    source = """
    seen = []
    def f(x):
        return x
    def f_in(event):
        if event > 100: seen.append(event)
        return {"x": event + len(seen)}
    def f_out(view):
        if view["y"] == 50: seen.append(50)
        return view["y"] + len(seen)
    """
    settings = SETTINGS + 'own = ["f_in", "f_out"]\n'
    q_in, q_out, failures = queue.Queue(), queue.Queue(), queue.Queue()
    pipeline = ep.load_pipeline(bundle(tmp_path / "b", source, settings), q_in, q_out)
    pipeline.on_error = failures.put
    with pipeline:
        for event in (1, 200, 2, 50, 3):
            q_in.put(event)
        assert [q_out.get(timeout=60) for _ in range(3)] == [1, 2, 3]
        found = [failures.get(timeout=60) for _ in range(2)]
    assert [failure.function for failure in found] == ["f_in", "f_out"]
    assert all(isinstance(failure.exception, StateChanged) for failure in found)


@pytest.mark.parametrize(
    "items",
    [
        "L = []\ndef items(): return L",
        "@functools.cache\ndef items(): return []",
        "class C:\n    @staticmethod\n    @functools.cache\n    def items(): return []\nitems = lambda: C.items()",
        "CACHES = (functools.cache(lambda: []),)\nitems = lambda: CACHES[0]()",
        "class C:\n    @functools.cached_property\n    def items(self): return []\nc = C()\nitems = lambda: c.items",
    ],
    ids=["a list", "a cache", "a cache that no name of the module has", "a cache in a tuple", "a cached property"],
)
def test_runs_in_threads_do_not_see_each_others_changes(items, tmp_path):
    source = f"""
import time
{items}
def f(x):
    found = items()
    if x > 100: found.append(x)
    time.sleep(0.0005)
    return len(found)
"""
    runner = ep.load(bundle(tmp_path / "b", source))
    with ThreadPoolExecutor(8) as pool:
        answers = [*pool.map(lambda x: answer(runner, x), [1, 200] * 40)]
    assert answers[::2] == ["0"] * 40
    # What can't be compared is forgotten instead.
    assert {*answers[1::2]} == {"1" if "CACHES" in items or "property" in items else "StateChanged"}


MIXED = """
L = []
@functools.cache
def total(): return len(L)
@functools.cache
def items(): return []
class C:
    @functools.cached_property
    def items(self): return []
c = C()
def f(x):
    if x == 1: L.append(x)
    if x == 2: items().append(x)
    return len(L) + len(items()) + total()
def g(x):
    if x == 3: L.append(x)
    if x == 4: c.items.append(x)
    return len(L) + len(c.items)
func_dict, func_io = {"f": f, "g": g}, {"f": ("x", "y"), "g": ("x", "z")}
"""


def test_events_beside_those_that_change_something_neither_fail_nor_see_it(tmp_path):
    runner = ep.load(bundle(tmp_path / "b", MIXED))

    def answers(x):
        try:
            return (*runner.run(x=x).values(),)[1:]
        except StateChanged as error:
            return error.function, error.changed

    events = [*range(9)] * 150
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        with ThreadPoolExecutor(12) as pool:
            found = [*pool.map(answers, events)]
    finally:
        sys.setswitchinterval(before)
    expected = {1: ("f", "L"), 2: ("f", "items"), 3: ("g", "L"), 4: (0, 1)}
    assert found == [expected.get(x, (0, 0)) for x in events]


def test_calls_that_change_nothing_run_at_the_same_time(tmp_path):
    source = """
    import threading
    TABLE = {"a": 1}
    both = threading.Barrier(2)
    def f(x):
        both.wait(60)
        return TABLE["a"] + x
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(lambda x: answer(runner, x), [1, 2])] == ["2", "3"]


def test_a_call_that_saw_the_change_of_another_is_made_again(tmp_path):
    source = """
    import threading
    L = []
    grown, seen = threading.Event(), threading.Event()
    def f(x):
        if x > 100:
            L.append(x)
            grown.set()
            seen.wait(60)
            return 0
        grown.wait(60)
        found = len(L)
        seen.set()
        return found
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(lambda x: answer(runner, x), [1, 200])] == ["0", "StateChanged"]


def test_a_guarded_function_may_run_a_pipeline_of_the_bundle_in_threads(tmp_path):
    source = """
    import epypes as ep
    L = [1]
    def a(x): return x + len(L)
    def b(x): return x + len(L)
    def c(y, z): return y + z
    cg = ep.CompGraph({"a": a, "b": b, "c": c}, {"a": ("x", "y"), "b": ("x", "z"), "c": (("y", "z"), "w")})
    pipe = ep.Pipeline("pipe", cg, workers=2)
    def f(x): return pipe(x) + len(L)
    func_dict, func_io = {"f": f, "pipe": pipe}, {"f": ("x", "y"), "pipe": ("x", "w")}
    """
    runner = ep.load(bundle(tmp_path / "b", source))
    done = threading.Event()

    def work():
        for x in range(20):
            assert (runner.run(x=x)["y"], runner["w"]) == (2 * x + 3, 2 * x + 2)
        done.set()

    threading.Thread(target=work, daemon=True).start()
    assert done.wait(60)


@pytest.mark.parametrize("workers", ["ThreadPoolExecutor(2)", "POOL"], ids=["a pool per call", "one pool"])
def test_a_guarded_function_may_run_nodes_and_pipelines_of_the_bundle_in_its_own_thread_pool(workers, tmp_path):
    source = f"""
import contextlib
import epypes as ep
from concurrent.futures import ThreadPoolExecutor
POOL = contextlib.nullcontext(ThreadPoolExecutor(2))
L = [1]
class Counting(ep.Node):
    def compute(self, x):
        self.n = getattr(self, "n", 0) + 1
        return x + len(L)
node = Counting("node", abs)
pipe = ep.Pipeline("pipe", ep.CompGraph({{"inner": lambda x: x + len(L)}}, {{"inner": ("x", "y")}}))
def f(x):
    with {workers} as pool:
        found = [*pool.map(node, [x] * 4), *pool.map(pipe, [x] * 4)]
    if x > 100: L.append(x)
    return sum(found)
func_dict = {{"f": f, "node": node, "pipe": pipe}}
func_io = {{"f": ("x", "y"), "node": ("x", "z"), "pipe": ("x", "w")}}
"""
    runner = ep.load(bundle(tmp_path / "b", source))
    answers = queue.Queue()

    def work(x):
        answers.put((x, answer(runner, x)))

    for x in [*range(8), 200, 201] * 2:
        threading.Thread(target=work, args=(x,), daemon=True).start()
    for _ in range(20):
        x, found = answers.get(timeout=60)
        assert found == ("StateChanged" if x > 100 else str(8 * (x + 1))), x


REPROMOTED = """
import epypes as ep
LEVELS = [3, 1, 2]


def levelled(g):
    @functools.wraps(g)
    def call(x):
        return g(x) + len(LEVELS)
    return call


@levelled
def decorated(x):
    return x + LEVELS[0]


@functools.lru_cache
def kernel(n):
    return np.ones(n)


def plain(x):
    return x + sum(LEVELS) + int(kernel(2).sum())


def scaled(k, x):
    return k * x + LEVELS[0]


class Adding(ep.Node):
    def compute(self, x):
        return self.func(x) + LEVELS[0]


pipe = ep.Pipeline("pipe", ep.CompGraph({"inner": plain}, {"inner": ("x", "z")}))
functions = {
    "decorated": decorated, "plain": plain, "partial": functools.partial(scaled, 3), "pipe": pipe,
    "adding": Adding("adding", plain), "node": ep.Node("node", plain),
}
func_dict, func_io = functions, {name: ("x", f"y_{name}") for name in functions}
"""


@pytest.mark.slow
def test_a_bundle_of_watched_functions_is_promoted_again(tmp_path):
    outputs = [f"y_{name}" for name in ("decorated", "plain", "partial", "pipe", "adding", "node")]
    settings = SETTINGS.replace('["y"]', str(outputs).replace("'", '"'))
    loaded = ep.load(bundle(tmp_path / "first", REPROMOTED, settings))
    loaded.run(x=2)
    second = ep.promote(loaded, tmp_path / "second")
    again = ep.load(second.path)
    assert dict(again.run(x=5)) == dict(ep.load(tmp_path / "first").run(x=5))
    third = ep.promote(again, tmp_path / "third")
    assert (third.path / "pipeline.py").read_text().replace("third", "second") == (
        second.path / "pipeline.py"
    ).read_text()
    namespace: dict = {}
    written = [token for token in loaded.cg.sink_tokens if token != "y_adding"]
    exec(ep.to_source(ep.subgraph(loaded.cg, written)), namespace)
    assert namespace["run_graph"](2) == tuple(loaded.last[token] for token in written)


OWN_MODULE = """
count, items = 0, []


def add(x):
    global count
    if x > 100:
        count += 1
    return count
"""


@pytest.mark.parametrize(
    ("source", "changed"),
    [
        ("import own_helper\ndef f(x):\n    return own_helper.add(x)", "count"),
        ("import own_helper\ndef f(x):\n    if x > 100: own_helper.count += 1\n    return own_helper.count", "count"),
        ("from own_helper import items\ndef f(x):\n    if x > 100: items.append(x)\n    return len(items)", "items"),
        (
            "import own_helper\ndef f(x):\n    import own_helper as o\n    if x > 100: o.items.append(x)\n    return len(o.items)",
            "items",
        ),
    ],
)
def test_the_state_of_an_own_module_is_compared_too(source, changed, tmp_path, monkeypatch):
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "own_helper.py").write_text(OWN_MODULE)
    monkeypatch.syspath_prepend(tmp_path / "lib")
    monkeypatch.delitem(sys.modules, "own_helper", raising=False)
    runner = ep.load(bundle(tmp_path / "b", source))
    for _ in range(4):
        with pytest.raises(StateChanged) as error:
            runner.run(x=200)
        assert error.value.changed.endswith(changed)
        assert runner.run(x=1)["y"] == 0
    del sys.modules["own_helper"]


@pytest.mark.parametrize("spoil", ["R.write(b'x'); return np.frombuffer(R.getbuffer(), np.uint8)", "R.close()"])
def test_what_cannot_be_put_back_fails_by_name_until_it_can(tmp_path, spoil):
    source = f"""
        import io
        class K:
            R = io.BytesIO(b'abc')
        def f(x):
            R = K.R
            if x > 100:
                {spoil}
            return x
        """
    runner = ep.load(bundle(tmp_path / "b", source))
    assert answer(runner, 1) == "1"
    assert answer(runner, 200) == "StateChanged"
    assert {answer(runner, 1), answer(runner, 1)} <= {"StateChanged", "1"}
