"""An accepted bundle computes what the notebook computes on inputs and branches that no sample takes."""

from __future__ import annotations

import re
import warnings

import pytest

import epypes as ep
from epypes.errors import PromotionRefused
from tests.bundle.hostile import in_notebook

IMPORTS = "import numpy as np\nimport cv2\n"

# By name: a cell with a function f, and words of the reason why it is refused.
REFUSED = {
    "NaN that two lists share": (
        "N = float('nan')\nL, M = [N, 1.0], [N, 1.0]\ndef f(x):\n    return L == M if x > 100 else 0",
        r"one object in the notebook and several in the module, and NaN .* Use np\.nan\.",
    ),
    "name of a lambda": (
        "g = lambda x: x\ndef f(x):\n    return g.__name__ if x > 100 else 0", r"'<lambda>' in the notebook and 'g' in the module",
    ),
    "name of a lambda, by a text": (
        "g = lambda x: x\ndef f(x):\n    return getattr(g, '__name__') if x > 100 else 0", r"its '__name__', which a function reads",
    ),
    "qualified name of a closure": (
        "def make():\n    def g(x):\n        return x\n    return g\ng = make()\ndef f(x):\n    return g.__qualname__ if x > 100 else ''",
        r"Function 'g' \(cell \[2\], line 2\), which function 'f' needs: its '__qualname__'",
    ),
    "module of a class": ("class C:\n    a = 1\ndef f(x):\n    return type(C()).__module__ if x > 100 else ''", r"its '__module__', which a function reads"),
    "class as text": ("class C:\n    a = 1\ndef f(x):\n    return f'{type(C())}' if x > 100 else ''", r"its '__module__', which a function reads"),
    "subclasses": (
        "class B:\n    a = 1\nclass D(B):\n    a = 2\ndef f(x):\n    return len(B.__subclasses__())", r"'B\.__subclasses__' \(cell \[2\], line 6\)",
    ),
    "file of code": ("def f(x):\n    return f.__code__.co_filename if x > 100 else ''", r"co_filename' \(cell \[2\], line 2\)"),
    "class that is registered": (
        "import abc\nclass S(abc.ABC):\n    a = 1\nS.register(str)\ndef f(x):\n    return isinstance('a' if x > 100 else 1, S)",
        r"registered classes only in the notebook",
    ),
    "class that a call registers": (
        "import abc\nclass S(abc.ABC):\n    a = 1\ndef f(x):\n    if x > 100: S.register(int)\n    return isinstance(x, S)",
        r"'S\.register' \(cell \[2\], line 5\), which sets something for the whole process",
    ),
    "implementation that a call registers": (
        "import functools\n@functools.singledispatch\ndef g(v):\n    return 1\ndef f(x):\n    if x > 100: g.register(int, abs)\n    return g(x)",
        r"'g\.register' \(cell \[2\], line 6\)",
    ),
    "mask of new files": ("from os import umask as mask\ndef f(x):\n    return mask(0) if x > 100 else 0", r"'mask' \(cell \[2\], line 3\)"),
    "logging": ("def f(x):\n    import logging\n    if x > 100: logging.disable(50)\n    return x", r"'logging\.disable' \(cell \[2\], line 3\)"),
    "OpenCL": ("def f(x):\n    if x > 100: cv2.ocl.setUseOpenCL(False)\n    return cv2.ocl.useOpenCL()", r"'cv2\.ocl\.setUseOpenCL'"),
    "mock that is left": (
        "from unittest import mock\nimport math\ndef f(x):\n    if x > 100: mock.patch('math.floor').start()\n    return math.floor(x)",
        r"'mock\.patch' \(cell \[2\], line 4\) outside of a 'with' statement",
    ),
    "text of a traceback": (
        "import traceback\ndef f(x):\n    try:\n        return 1 // (x - 101)\n    except ZeroDivisionError:\n        return traceback.format_exc()",
        r"'traceback\.format_exc' \(cell \[2\], line 6\), whose result depends on lines",
    ),
    "pickle as a key": (
        "import pickle, hashlib\nN = 'red green red'.split()\ndef f(x):\n    return hashlib.md5(pickle.dumps(N)).hexdigest() if x > 100 else ''",
        r"'pickle\.dumps' \(cell \[2\], line 4\), .* where objects are in memory",
    ),
    "size of a list": (
        "from sys import getsizeof as size\nN = []\nfor i in range(50): N.append(i)\ndef f(x):\n    return size(N) if x > 100 else 0", r"'size' \(cell \[2\], line 5\)",
    ),
    "equal numbers by identity": ("A, B = int('1000'), int('1000')\ndef f(x):\n    return A is B if x > 100 else 0", r"'A is B' \(cell \[2\], line 3\) by 'is'.* Write '=='"),
    "text by identity": ("MODE = 'fast'\ndef f(x):\n    return 1 if x > 100 and x is not MODE else 0", r"'x is not MODE' \(cell \[2\], line 3\) by 'is'"),
    "environment that a cell changes": ("import os\nos.environ['EP_A'] = 'a'\ndef f(x):\n    return os.getenv('EP_A') if x > 100 else 0", r"'os\.environ', .* changed \(cell \[2\], line 2\)"),
    "environment by its own name": (
        "from os import environ\nenviron['EP_A'] = 'a'\ndef f(x):\n    return environ.get('EP_A') if x > 100 else 0", r"'os\.environ', .* changed \(cell \[2\], line 2\)",
    ),
    "further value of a member": (
        "import enum\nclass E(enum.Enum):\n    A = 'a'\n    @classmethod\n    def _missing_(cls, v):\n        return cls.A\nE._value2member_map_['b'] = E.A\n"
        "def f(x):\n    return E('b').name if x > 100 else ''", r"Class 'E' .* its further values has \['b'\] only in the notebook",
    ),
    "hits of a cache": (
        "import functools\n@functools.cache\ndef g(x):\n    return x\ndef f(x):\n    return g(x) + (g.cache_info().hits if x > 100 else 0)", r"'g\.cache_info' \(cell \[2\], line 6\)",
    ),
    "cached property that is stale": (
        "import dataclasses, functools\n@dataclasses.dataclass\nclass C:\n    k: int = 2\n    @functools.cached_property\n    def d(self): return self.k * 2\n"
        "c = C()\nc.d\nc.k = 5\ndef f(x):\n    return c.d if x > 100 else 0", r"'c' cached 'd' is 4 in the notebook and 10 in the module",
    ),
    "setter in a table": ("import os\nT = {'a': os.umask}\ndef f(x):\n    return T['a'](0) if x > 100 else 0", r"'posix\.umask', which sets something"),
}  # fmt: skip

# By name: a cell with a function f whose last run is promoted, and words of the reason why it is refused.
REFUSED_IN_A_REPLAY = {
    "scipy.special.seterr in a cell": (
        "import scipy.special\nscipy.special.seterr(all='raise')\ndef f(x):\n    try:\n        return scipy.special.gamma(-1.0) if x > 100 else 0\n"
        "    except scipy.special.SpecialFunctionError:\n        return -1.0",
        r"has changed scipy\.special\.seterr \(cell \[2\], line 2",
    ),
    "class that is registered with one of a library": (
        "import numbers\nclass M:\n    a = 1\nnumbers.Number.register(M)\ndef f(x):\n    return isinstance(M(), numbers.Number) if x > 100 else 0",
        r"has changed numbers\.Number\.register",
    ),
    "file that no sample writes": (
        "from pathlib import Path\ndef f(x):\n    if x > 100:\n        Path('/nowhere/a').write_text('a')\n    return x",
        r"f\(\) writes a file by \"Path.*write_text\" \(pipeline\.py, line \d+\), which no sample runs",
    ),
    "hash in a cache": (
        "import functools, hashlib\n@functools.cache\ndef seen():\n    return hashlib.sha256()\ndef f(x):\n    if x > 100: seen().update(b'a')\n    return seen().hexdigest()",
        r"Function 'f' changed 'seen', which outlives the call",
    ),
}  # fmt: skip

# All in one bundle: a cell, and what of it the graph calls.
PROMOTED = {
    "nan": ("L = [np.nan, 1.0]\ndef nan(x):\n    return np.nan in L, L.index(np.nan), L == [np.nan, 1.0]"),
    "other_nan": ("import math\nM = (math.nan, 1.0)\ndef other_nan(x):\n    return math.nan in M, np.nan in M"),
    "dispatched": (
        "import functools\n@functools.singledispatch\ndef kind(v):\n    return 'any'\n@kind.register\ndef _(v: str):\n    return 'text ' + kind(1.5)\n"
        "@kind.register(float)\ndef _(v):\n    return 'number'\nkind.register(list, len)\ndef dispatched(x):\n    return kind('a'), kind(x), kind(2.0), kind([1, 2])"
    ),
    "path": ("from pathlib import PurePosixPath, PureWindowsPath\nP, W = PurePosixPath('/a/b'), PureWindowsPath('c/d')\ndef path(x):\n    return str(P / str(x)), str(W / 'e')"),
    "proxy": ("import types\nT = types.MappingProxyType({'a': [1, 2]})\ndef proxy(x):\n    return T['a'][0] + x"),
    "when": ("D, H = np.datetime64('2024-02-29T12:30', 'ms'), np.timedelta64(3, 'h')\ndef when(x):\n    return str(D + H * x), D.dtype.str"),
    "texts": ("S, B = np.str_('ab'), np.bytes_(b'cd')\ndef texts(x):\n    return S * x, B, str(type(S))"),
    "mocked": (
        "from unittest import mock\ndef mocked(x):\n    with mock.patch('math.floor', return_value=7), mock.patch.object(math, 'ceil', lambda v: 8):\n"
        "        found = math.floor(2.5), math.ceil(2.5)\n    return found, math.floor(x)"
    ),
    "colours": ("import matplotlib.colors\ndef colours(x):\n    return matplotlib.colors.to_rgb(f'C{x % 10}')"),
    "named": ("double = lambda v: 2 * v\ndef named(x):\n    try:\n        return double(1) // (x - x)\n    except Exception as error:\n        return type(error).__name__, error.__class__.__name__"),
    "dated": (
        "import datetime as dt\nT0, D0 = dt.datetime(2024, 3, 31, 1, 30, tzinfo=dt.timezone.utc), dt.date(2024, 2, 29)\nZ = dt.timezone(dt.timedelta(hours=1), 'A')\n"
        "def dated(x):\n    return str(T0 + dt.timedelta(days=x)), str(D0), T0.astimezone(Z).tzname()"
    ),
    "table": ("from collections import namedtuple\ndef table(x):\n    return [*map(str, np.random.default_rng(x).integers(0, 9, 3))]"),
}  # fmt: skip


def runner_of(monkeypatch, cell, *names):
    made = in_notebook(monkeypatch, IMPORTS, *([cell] if isinstance(cell, str) else cell))
    cg = ep.CompGraph({name: made[name] for name in names}, {name: ("x", f"{name}_y") for name in names}, types=False)
    return ep.CompGraphRunner(cg)


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_bundle_would_compute_otherwise_is_refused_with_its_line(case, monkeypatch, tmp_path):
    cell, words = REFUSED[case]
    runner = runner_of(monkeypatch, cell, "f")
    runner.run(x=1)
    with pytest.raises(PromotionRefused) as error:
        ep.promote(runner, tmp_path / "b")
    assert re.search(words, str(error.value))


@pytest.mark.slow
@pytest.mark.parametrize("case", REFUSED_IN_A_REPLAY)
def test_what_another_process_would_compute_otherwise_is_refused(case, monkeypatch, tmp_path):
    cell, words = REFUSED_IN_A_REPLAY[case]
    runner = runner_of(monkeypatch, cell, "f")
    runner.run(x=1)
    try:
        with pytest.raises(PromotionRefused) as error:
            ep.promote(runner, tmp_path / "b")
        assert re.search(words, str(error.value))
    finally:
        import scipy.special

        scipy.special.seterr(all="ignore")


@pytest.mark.slow
def test_a_draw_after_the_seed_of_another_function_is_refused(monkeypatch, tmp_path):
    cell = "def s(x):\n    np.random.seed(x)\n    return x\ndef f(y):\n    return np.random.rand() if y > 100 else 0.0"
    names = in_notebook(monkeypatch, IMPORTS, cell)
    runner = ep.CompGraphRunner(ep.CompGraph({"s": names["s"], "f": names["f"]}, {"s": ("x", "y"), "f": ("y", "z")}))
    runner.run(x=1)
    with pytest.raises(PromotionRefused, match=r"'f' draws by 'rand' .* which function 's' seeds: .* Seed it in 'f'"):
        ep.promote(runner, tmp_path / "b")


@pytest.mark.slow
def test_what_depends_on_no_place_or_process_is_promoted_and_computes_the_same_on_other_inputs(monkeypatch, tmp_path):
    runner = runner_of(monkeypatch, PROMOTED.values(), *PROMOTED)
    runner.run(x=1)
    with warnings.catch_warnings():
        warnings.resetwarnings()  # a test has errors in their place
        loaded = ep.load(ep.promote(runner, tmp_path / "b").path)
    for x in (1, 7, 3):
        run, expected = loaded.run(x=x), runner.run(x=x)
        assert {name: repr(run[f"{name}_y"]) for name in PROMOTED} == {
            name: repr(expected[f"{name}_y"]) for name in PROMOTED
        }
