"""A bundle has what the notebook has, however that was made and whatever was rebound since; or it is refused."""

from __future__ import annotations

import functools
import operator

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.proof.compare import first_difference
from epypes.errors import PromotionRefused
from tests.bundle.hostile import in_notebook

KNOWN = {"functools": functools, "operator": operator, "cv2": cv2, "np": np}
ARRAY = np.arange(12.0).reshape(3, 4)

FACTORY = "GAIN = 2\ndef make(k):\n    w = k * GAIN\n    def f(a):\n        return a * w + k\n    return f\nf = make(3)"
MAKES = "GAIN = 2\ndef make(k):\n    {}\n    def f(a):\n        return a * w + k\n    return f\nf = make(3)"
OWN_DEFAULT = "G = 2\ndef make(k):\n    def f(a, g=G):\n        return a * k + g\n    return f\nf = make(3)"
BOX = "class Box(typing.NamedTuple):\n    low: int = 2\n    high: int = 7\n"
BOXED = "def f(a, box: Box = Box(high=5)):\n    return a * box.low + box.high\n"
LATE = "from __future__ import annotations\n"

# By name: the cells. All of them define f, which takes an array.
PROMOTED: dict[str, tuple[str, ...]] = {
    "factory": (FACTORY,),
    "factory that reads what has changed since": (FACTORY, "GAIN = 9"),
    "two closures of one factory with computed arrays": (
        "def make(size):\n    weights = np.ones(size) / size\n    shape = cv2.getStructuringElement(cv2.MORPH_RECT, (size, size))\n"
        "    def f(a):\n        return cv2.erode(cv2.filter2D(a, -1, weights), shape) + size\n    return f\nthree, five = make(3), make(5)\n"
        "def f(a):\n    return three(a) + five(a)",
    ),
    "factory that draws random numbers": (MAKES.format("w = np.random.rand()"),),
    "factory that reads a file": (MAKES.format("w = np.fromfile('/proc/version', 'u1').size"),),
    "factory with a condition": (MAKES.format("w = GAIN if k else 0"), "GAIN = 3"),
    "factory in steps": (MAKES.format("w = 0\n    w = GAIN"), "GAIN = 3"),
    "factory with a comprehension": (MAKES.format("w = [x for x in (GAIN,)][0]"),),
    "factory that fails by now": (MAKES.format("w = GAIN['w']").replace("GAIN = 2", "GAIN = {'w': 2}"), "GAIN = {}"),
    "factory that writes into its argument": (
        "def make(t):\n    t.append(1)\n    def f(a):\n        return a + len(t)\n    return f\nf = make([0])",
    ),
    "factory that chooses what it defines": (
        "FAST = True\ndef make(k):\n    if FAST:\n        def f(a):\n            return a + k\n    else:\n"
        "        def f(a):\n            return a - k\n    return f\nf = make(3)",
        "FAST = False",
    ),
    "factory that copied what has changed since": (
        "def make(t):\n    w = dict(t)\n    def f(a):\n        return a + w['k'] + t['k']\n    return f\nT = {'k': 1}\nf = make(T)",
        "T['k'] = 9",
    ),
    "cache that was filled with another constant": (
        "SIGMA = 1.0\n@functools.lru_cache\ndef weight(n):\n    return SIGMA * n\nweight(5)",
        "SIGMA = 3.0\ndef f(a):\n    return a * weight(5) if a.max() > 100 else a",
    ),
    "partial with a keyword that is no name": (
        "def g(a, **options):\n    return a * options['a b']\nf = functools.partial(g, **{'a b': 3})",
    ),
    "annotated name in a cell and an annotated class": (
        "gain: int = 3\nclass C:\n    k: int = 2\ndef f(a):\n    return a * gain * C.k",
    ),
    "aliases of types": (
        "import typing\nimport numpy.typing as npt\nGray = npt.NDArray[np.uint8]\nSize = int | tuple[int, int]\nOld = typing.Union[int, None]\n"
        "def f(a: Gray, size: Size = 3, old: Old = None) -> Gray:\n    return a * size",
    ),
    "type of a structured array": (
        "Point = np.dtype([('x', 'f4'), ('y', 'f4')])\ndef f(a):\n    return np.zeros(2, Point)['x'].tolist() + a.tolist()",
    ),
    "factory with helpers inside": (
        "def make(k):\n    twice = k * 2\n    def inner(a):\n        return a * twice\n    def f(a):\n        return inner(a) + k\n"
        "    return f\nf = make(3)",
    ),
    "factory that counts": (
        "COUNT = [0]\ndef make(k):\n    COUNT[0] += 1\n    n = COUNT[0]\n    def f(a):\n        return a + k * n\n    return f\nf = make(3)",
    ),
    "factory with the order of a set": (MAKES.format("w = len(list({'red', 'blue', 'green'})[0])"),),
    "factory that takes from an iterator": (f"IT = iter([4, 5, 6])\n{MAKES.format('w = next(IT)')}",),
    "factories of which one makes another thing by now": (
        "GAIN = 2\ndef make(k):\n    w = GAIN\n    def g(a):\n        return a * w + k\n    return g\n"
        "def plain(n):\n    def h(a):\n        return a * n\n    return h\none, two, three = make(1), plain(2), plain(3)\n"
        "def f(a):\n    return one(a) + two(a) * three(a)\nGAIN = 5",
    ),
    "closure that is one of two, with another value by now": (
        "def make():\n    k = 1\n    def f(a):\n        return a * k\n    def put(v):\n        nonlocal k\n        k = v\n"
        "    return f, put\nf, put = make()\nput(5)",
    ),
    "closure with a default": (OWN_DEFAULT,),
    "closure with a default that has another value by now": (OWN_DEFAULT, "G = 5"),
    "default of a name that has another value by now": ("K = 5\ndef f(a, k=K):\n    return a * k\nK = 9",),
    "default by name, and of a class that was defined again": (
        "class C:\n    K = 2\ndef f(a, *, k=C.K, l=len('abc')):\n    return a * k + l\nclass C:\n    K = 3",
    ),
    "default that is an array": ("K = np.array([1.5, 2, 3, 4])\ndef f(a, k=K):\n    return a * k\nK = None",),
    "default that is a function": ("def g(a):\n    return a + 1\ndef f(a, g=g):\n    return g(a)\ndef g(a):\n    return a + 2",),
    "default of a NamedTuple": (f"import typing\n{BOX}{BOXED}",),
    "default of a NamedTuple under a name": (
        f"import typing\n{BOX}BEST = Box(4)\ndef f(a, box=BEST):\n    return a * box.low + (box is BEST)\n",
    ),
    "default of a NamedTuple under a name that has another value by now": (
        f"import typing\n{BOX}BEST = Box(4)\ndef f(a, box=BEST):\n    return a * box.low\nBEST = Box(9)",
    ),
    "default of a frozen dataclass": (
        f"import dataclasses\n@dataclasses.dataclass(frozen=True)\nclass Box:\n    low: int = 2\n    high: int = 7\n{BOXED}",
    ),
    "default of a member of an enumeration": (
        "import enum\nclass Way(enum.Enum):\n    UP = 1\n    DOWN = -1\ndef f(a, way: Way = Way.DOWN):\n    return a * way.value",
    ),
    "decorator that is an object": (
        "import dataclasses\n@dataclasses.dataclass\nclass D:\n    k: int\n    def __call__(self, g):\n        @functools.wraps(g)\n"
        "        def w(a):\n            return g(a) * self.k\n        return w\nd = D(2)\n@d\ndef f(a):\n    return a",
    ),
    "pattern with its flags inside": ("import re\nR = re.compile('(?i)A+')\ndef f(a):\n    return a * len(R.findall('aA b'))",),
    "order of a set of numbers": ("P = {16, 8, 0}\ndef f(a):\n    return a * [*P][0] + [*P][1]",),
    "array in a list of arrays": (
        "K = np.ones(3)\nKS = [np.zeros(3), K]\ndef f(a):\n    return a * sum(known is KS[1] for known in KS)",
    ),
    "annotation that nothing defines": (f"{LATE}def f(a: Picture, k: Missing = 3) -> Picture:\n    return a * k",),
    "annotation inside that nothing defines": (
        f"{LATE}def f(a):\n    def g(b: Missing) -> list[Missing]:\n        return b * 2\n    c: Missing = g(a)\n    return c",
    ),
    "annotation of a class that is defined": (f"{LATE}import typing\n{BOX}{BOXED}",),
    "lock, array function and empty cache in a class": (
        "import threading\nimport weakref\nclass C:\n    LOCK = threading.Lock()\n    ADD = np.vectorize(lambda k: k + 1)\n"
        "    CACHE = weakref.WeakKeyDictionary()\nC.ADD(2)\ndef f(a):\n    with C.LOCK:\n        return C.ADD(a) + len(C.CACHE)",
    ),
    "set of members, logger and pattern in a class": (
        "import enum\nimport logging\nimport re\nclass Way(enum.Enum):\n    UP = 1\n    DOWN = -1\n"
        "class C:\n    WAYS = {Way.UP, Way.DOWN}\n    LOG = logging.getLogger('c')\n    WORD = re.compile('a+')\n"
        "def f(a):\n    C.LOG.debug('f')\n    return a * len(C.WAYS) + len(C.WORD.findall('aab'))",
    ),
}  # fmt: skip

# By name: a cell that defines f, and what the reason says.
REFUSED: dict[str, tuple[str, str]] = {
    "one object in the notebook, two in the module": (
        "import dataclasses\n@dataclasses.dataclass(frozen=True)\nclass Box:\n    low: int = 2\nBEST = Box()\n"
        "def f(a, box=BEST):\n    return a * (box is OTHER)\nOTHER, BEST = BEST, None",
        "is one object in the notebook and several in the module",
    ),
    "array that is also in a list": (
        "K = np.ones(3)\nKS = [K, np.zeros(3)]\ndef f(a):\n    return a * (K in KS)",
        "is one object in the notebook and several in the module, and a function compares by 'is' or 'in'",
    ),
    "NaN that is also in a list": (
        "N = float('nan')\nNS = [N]\ndef f(a):\n    return a * (N in NS)", "is one object in the notebook and several in the module",
    ),
    "two tuples in the notebook, one in the module": (
        "A = (1, 2)\nB = tuple([1, 2])\ndef f(a):\n    return a * (A is B)", "is one object in the module and several in the notebook",
    ),
    "set with an order that no text of it gives": (
        "P = set(range(100))\nP -= set(range(100)) - {1, 8}\ndef f(a):\n    return a * [*P][0]", "Make P a token",
    ),
    "function with another docstring by now": (
        "def g(a):\n    'One.'\n    return a\ng.__doc__ = 'Other.'\ndef f(a):\n    return g(a) + len(g.__doc__)",
        "its attribute '__doc__' is 'Other.' in the notebook and 'One.' in the module",
    ),
    "function with another name by now": (
        "def g(a):\n    return a\ng.__name__ = 'other'\ndef f(a):\n    return g(a) + len(g.__name__)", "has attribute '__name__' only in the notebook",
    ),
    "name that was added to a module and is read by getattr": (
        "import math\nmath.gain = 3\ndef f(a):\n    return a * getattr(math, 'gain', 1)", "uses 'math.gain', which the notebook has changed",
    ),
    "function that was put into a module by a name that no text says": (
        "import math\nsetattr(math, 'ha' + 'lf', lambda a: a / 2)\ndef f(a):\n    return math.half(a)",
        r"uses 'math.half', which the notebook has changed \(cell \[1\], line 3\)",
    ),
    "function that was put into the names of a module": (
        "import math\nvars(math)['third'] = lambda a: a / 3\ndef f(a):\n    return math.third(a)", "uses 'math.third', which the notebook has changed",
    ),
    "mock in a module": (
        "import math\nfrom unittest import mock\nmock.patch.object(math, 'quarter', create=True).start()\n"
        "def f(a):\n    return math.quarter(a) if a is None else a",
        "uses 'math.quarter', which the notebook has changed",
    ),
    "notebook as a module": (
        "K = 3\ndef f(a):\n    import __main__\n    return a * __main__.K", r"imports the notebook itself, as '__main__' \(cell \[1\], line 3\)",
    ),
    "patched name of a module that is imported inside": (
        "import math\nmath.gains = 4\ndef f(a):\n    import math as m\n    return a * m.gains", "uses 'math.gains', which the notebook has changed",
    ),
    "module that is patched and used as an object": (
        "import math\nmath.gained = 5\ndef g(m):\n    return m.gained\ndef f(a):\n    return a * g(math)",
        "uses 'math.ga[a-z]*', which the notebook has changed",
    ),
    "function that took the place of one of a library": (
        "import math\n_before = math.hypot\n@functools.wraps(_before)\ndef hypot(*xs):\n    return 7\nmath.hypot = hypot\n"
        "f = lambda a: a * math.hypot(3, 4)\ng = math.hypot",
        "uses 'math.*', which the notebook has changed",
    ),
    "rows that are one list in the notebook": (
        "import copy\nROWS = [[0] * 3] * 3\ndef f(a):\n    rows = copy.deepcopy(ROWS)\n    rows[0][0] = 5\n    return a, rows",
        "is one object in the notebook and several in the module",
    ),
    "list that holds itself": (
        "X = [1]\nX.append(X)\ndef f(a):\n    return a * X[0]", r"uses 'X' from it, of type list\. Make X a token",
    ),
    "class with an object that can't be seen through": (
        "class C:\n    ROWS = (i for i in range(3))\ndef f(a):\n    return a, C.ROWS", r"Class .C. .*ROWS.* can.t be compared. Make it inside the function",
    ),
    "default of a dataclass that was set later": (
        "import dataclasses\n@dataclasses.dataclass\nclass C:\n    k: int = 2\nC.__init__.__defaults__ = (7,)\ndef f(a):\n    return a * C().k",
        r"Class 'C' \(cell \[1\], line 3\), which function 'f' needs: its '__init__' default of 'k' is 7 in the notebook and 2",
    ),
    "iterator of a class that was read from": (
        "class C:\n    ROWS = iter([1, 2])\nnext(C.ROWS)\ndef f(a):\n    return a, C.ROWS.__length_hint__()",
        r"Class 'C' .* its 'ROWS' state is 1 in the notebook and 0 in the module",
    ),
    "member of an enumeration that was changed": (
        "import enum\nclass Way(enum.Enum):\n    UP = 1\nWay.UP._value_ = 7\ndef f(a):\n    return a * Way.UP.value",
        r"Class 'Way' .*'UP'.* value is 7 in the notebook and 1",
    ),
    "order of an ordered dict of an own class": (
        "import collections\nclass D(collections.OrderedDict):\n    pass\nclass C:\n    T = D(a=1, b=2)\nC.T.move_to_end('a')\n"
        "def f(a):\n    return a * [*C.T.values()][0]",
        r"Class 'C' .* its 'T' .* is 'b' in the notebook and 'a'",
    ),
    "factory of a dict of an own class": (
        "import collections\nclass D(collections.defaultdict):\n    pass\nclass C:\n    T = D(int)\nC.T.default_factory = list\n"
        "def f(a):\n    return a * len(C.T.default_factory())",
        r"Class .C. .* its .T. attribute .default_factory. is something else by now",
    ),
    "entry of a weak dict": (
        "import weakref\nclass K:\n    pass\nclass C:\n    K = K()\n    W = weakref.WeakKeyDictionary()\nC.W[C.K] = 7\n"
        "def f(a):\n    return a * C.W.get(C.K, 1)",
        r"Class 'C' .* its 'W' has .* only in the notebook",
    ),
    "one of two entries under NaN": (
        "class C:\n    T = {float('nan'): 1, float('nan'): 2}\nC.T[[*C.T][0]] = 5\ndef f(a):\n    return a * [*C.T.values()][0]",
        r"Class 'C' .* its 'T' values\[0\] is 5 in the notebook and 1",
    ),
    "NaN as a key": (
        "N = float('nan')\nD = {N: 2}\ndef f(a):\n    return a * (D[N] if a.max() > 100 else 1)", "its 'D' has a key that is NaN, which is found by its identity",
    ),
    "NaN with a sign": (
        "import math\nN = -float('nan')\ndef f(a):\n    return a * (math.copysign(1, N) if a.max() > 100 else 1)", "its 'N' is nan in the notebook and nan in the module|its 'N' is something else",
    ),
    "docstring of a class that is read as data": (
        "class C:\n    'One.'\nC.__doc__ = 'Other.'\ndef f(a):\n    return a * (len(C.__doc__) if a.max() > 100 else 1)",
        "its docstring is 'Other.' in the notebook and 'One.' in the module",
    ),
    "annotation that is read as data": (
        "K = 2\ndef g(a: K):\n    return a\nK = 5\ndef f(a):\n    return g(a) * (g.__annotations__['a'] if a.max() > 100 else 1)",
        "its annotation of 'a' is .* in the notebook and 5 in the module",
    ),
    "runner of a class": (
        "import epypes as ep\nclass C:\n    R = ep.CompGraphRunner(ep.CompGraph({'g': abs}, {'g': ('x', 'y')}))\nC.R.run(x=3)\n"
        "def f(a):\n    return a * C.R.rerun()['y']",
        r"Class 'C' .* its 'R' is a 'CompGraphRunner', made anew in the module, which can't be compared",
    ),
    "attribute of a metaclass that was changed": (
        "class M(type):\n    K = 1\nclass C(metaclass=M):\n    pass\nM.K = 7\ndef f(a):\n    return a * C.K",
        r"Class 'M' \(cell \[1\], line 1\), .* its 'K' is 7 in the notebook and 1",
    ),
    "property that was replaced": (
        "class C:\n    @property\n    def p(self):\n        return 2\nC.p = property(lambda self: 5)\ndef f(a):\n    return a * C().p",
        r"\(cell \[1\], line 5\), .* another text",
    ),
    "function that was given other names": (
        "class C:\n    def m(self, a):\n        return a * K\nK, L = 2, 3\nC.m = type(f0 := lambda: 0)(C.m.__code__, {'K': 9})\n"
        "def f(a):\n    return C().m(a) * K", "uses the name 'K', which means something else in another function",
    ),
}  # fmt: skip


def runner_of(monkeypatch: pytest.MonkeyPatch, *cells: str) -> ep.CompGraphRunner:
    names = in_notebook(monkeypatch, *cells, **KNOWN)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": names["f"]}, {"f": ("a", "b")}, types=False))
    runner.run(a=ARRAY)
    return runner


@pytest.mark.slow
@pytest.mark.parametrize("cells", PROMOTED.values(), ids=PROMOTED)
def test_a_bundle_computes_the_same_on_another_input(monkeypatch, tmp_path, cells):
    runner = runner_of(monkeypatch, *cells)
    again = ep.load(ep.promote(runner, tmp_path / "b").path)
    for other in (ARRAY, 3 - 2 * ARRAY, ARRAY[:1] * 1e6):
        assert first_difference(runner.run(a=other)["b"], again.run(a=other)["b"]) is None
    names: dict = {}
    exec(compile(ep.to_source(runner), "straight", "exec", dont_inherit=True), names)
    assert first_difference(runner.run(a=-ARRAY)["b"], names["run_graph"](-ARRAY)) is None


@pytest.mark.parametrize(("cell", "words"), REFUSED.values(), ids=REFUSED)
def test_what_the_module_would_not_have_is_refused(monkeypatch, tmp_path, cell, words):
    with pytest.raises(PromotionRefused, match=words):
        ep.promote(runner_of(monkeypatch, cell), tmp_path / "b")


def test_a_closure_is_written_with_what_it_has_captured_whatever_its_factory_makes_by_now(monkeypatch):
    text = ep.to_source(runner_of(monkeypatch, FACTORY))
    assert text.startswith(
        "def make(k, w):\n    def f(a):\n        return a * w + k\n\n    return f\n\n\nf = make(k=3, w=6)\n"
    )
    assert ep.to_source(runner_of(monkeypatch, FACTORY, "GAIN = 9")) == text


@pytest.mark.parametrize(
    ("cell", "known"),
    [
        ("K = [0]\ndef g(k):\n    operator.iadd(k, [1])\ndef f(a):\n    g(K)\n    return a", "K"),
        ("K = np.zeros(3)\ndef f(a):\n    np.ndarray.__iadd__(K, 1)\n    return a", "K"),
        (
            "def make(k):\n    def f(a):\n        operator.iadd(k, [1])\n        return a\n    return f\nf = make([1])",
            "k",
        ),
        ("K = {}\ndef f(a):\n    known = K\n    known[len(K)] = 1\n    return a", "K"),
        ("K = []\ndef keep(k, v):\n    k.append(v)\ndef f(a):\n    keep(K, 1)\n    return a", "K"),
        ("K = np.zeros((3, 4))\ndef f(a):\n    cv2.accumulate(a, K)\n    return a", "K"),
    ],
)
def test_what_a_function_changes_out_of_sight_is_seen_by_the_replay(monkeypatch, tmp_path, cell, known):
    with pytest.raises(
        PromotionRefused, match=f"'f' changed '{known}', which outlives the call.* cg = ep.delay|{known}.*read-?only"
    ):
        ep.promote(runner_of(monkeypatch, cell), tmp_path / "b")
