"""Promotion replays under other conditions: what depends on one is refused with its token and the condition."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.errors import PromotionRefused
from tests.bundle.cells import cell

pytestmark = pytest.mark.slow
# What an interpreter takes from its environment when it starts.
fresh = pytest.mark.usefixtures("fresh_interpreter")

X = np.random.default_rng(5).random(10_000, dtype=np.float32)
# By what it depends on: a cell that defines `use`, and what the reason names.
DEPENDS = {
    "the order of a set of strings": (
        "def use(x):\n    return ' '.join({'canny', 'sobel', 'scharr', 'prewitt', 'laplace', 'roberts'})",
        "the hash seed (PYTHONHASHSEED)",
    ),
    "a hash": ("def use(x):\n    return hash('canny') % 1000", "the hash seed (PYTHONHASHSEED)"),
    "the working folder": ("import os\ndef use(x):\n    return os.getcwd()", "the working folder"),
    "a relative path": ("import os\ndef use(x):\n    return os.path.abspath('calibration')", "the working folder"),
    "the local time": (
        "import time\ndef use(x):\n    return time.strftime('%H:%M', time.localtime(0))",
        "the time zone (TZ)",
    ),
    "the locale": (
        "import locale\ndef use(x):\n    before = locale.setlocale(locale.LC_ALL)\n    locale.setlocale(locale.LC_ALL, '')\n"
        "    found = str(locale.getlocale()) + locale.format_string('%.2f', x[0], grouping=True)\n"
        "    locale.setlocale(locale.LC_ALL, before)\n    return found",
        "the locale (LC_ALL)",
    ),
    "the parts of a sum": (
        "import cv2, numpy as np\ndef use(x):\n    parts = np.array_split(x, cv2.getNumThreads() + 1)\n"
        "    return int(1e6 * sum(np.cumsum(part)[-1] for part in parts))",
        "the number of threads (OMP_NUM_THREADS, cv2.setNumThreads)",
    ),
    "two of them": (
        "import os, time\ndef use(x):\n    return os.getcwd() + time.strftime('%H:%M', time.localtime(0))",
        "the working folder and the time zone (TZ)",
    ),
    "a variable of the environment": (
        "import os\ndef use(x):\n    return int(os.environ.get('GAIN', '2'))",
        "the variables of the environment",
    ),
    "the process": ("import os\ndef use(x):\n    return os.getpid()", "the process that computes it"),
}
# By what an import makes: a cell that defines `use`, and what the reason names.
IMPORTED = {
    "a class with the order of a set": (
        "class C:\n    K = [*map(len, {'red', 'green', 'blue'})]\ndef use(x):\n    return C.K[0] * 0",
        "the hash seed (PYTHONHASHSEED)",
    ),
    "a class with an address": (
        "class D:\n    K = id(1)\ndef use(x):\n    return D.K * 0",
        "the process that computes it",
    ),
    "a default of a method that was read": (
        "import os\nclass E:\n    def g(self, k=os.getpid()): return k\ndef use(x):\n    return E().g() * 0",
        "the process that computes it",
    ),
    "an argument of a decorator that was read": (
        "import functools, os\ndef d(k):\n    def deco(g):\n        @functools.wraps(g)\n        def w(x):\n            return g(x) * k * 0\n"
        "        return w\n    return deco\n@d(os.getpid())\ndef use(x):\n    return x.sum()",
        "the process that computes it",
    ),
    "a decorator that reads the environment": (
        "import functools, os\ndef e(g):\n    k = int(os.environ.get('GAIN', '2'))\n    @functools.wraps(g)\n    def w(x):\n        return g(x) * k * 0\n"
        "    return w\n@e\ndef use(x):\n    return x.sum()",
        "the variables of the environment",
    ),
    "a class that reads the environment": (
        "class F:\n    from os import environ as env\n    K = len(env.get('HOME', ''))\ndef use(x):\n    return F.K * 0",
        "the variables of the environment",
    ),
}  # fmt: skip


def reasons_against(sources, to):
    """Run the cells that each define ``use`` as often as a notebook does, and return why they are not promoted.

    Their functions are ``use_0``, ``use_1`` ..., which make the tokens ``used_0``, ``used_1`` ...
    """
    functions = {f"use_{number}": cell(source)["use"] for number, source in enumerate(sources)}
    tokens = {name: ("x", name.replace("use", "used")) for name in functions}
    cg = ep.CompGraph({**functions, "length": np.size}, {**tokens, "length": ("x", "size")})
    runner = ep.CompGraphRunner(cg, {})
    for _ in range(3):
        runner.run(x=X)
    with pytest.raises(PromotionRefused) as caught:
        ep.promote(runner, to)
    assert not to.exists()
    assert not [*to.parent.iterdir()]
    return caught.value.reasons


def refusal(source, to):
    return "\n".join(reasons_against([source], to))


@fresh
def test_what_depends_on_a_condition_is_refused_with_token_and_condition(tmp_path):
    reasons = reasons_against([source for source, _ in DEPENDS.values()], tmp_path / "bundle")
    assert len(reasons) == len(DEPENDS)  # none of 'size'
    for number, (reason, (_, condition)) in enumerate(zip(reasons, DEPENDS.values(), strict=True)):
        assert f"token 'used_{number}': " in reason
        assert f"It depends on {condition}, something that is not a token." in reason


@fresh
def test_what_an_import_makes_under_a_condition_is_refused_also_where_no_sample_shows_it(tmp_path):
    reasons = reasons_against([source for source, _ in IMPORTED.values()], tmp_path / "bundle")
    for number, (reason, (_, condition)) in enumerate(zip(reasons, IMPORTED.values(), strict=True)):
        assert reason.startswith(
            f"What function 'use_{number}' refers to is another one in another process. It depends on {condition}"
        )


def test_a_function_that_keeps_something_from_call_to_call_is_refused(tmp_path):
    # Neither the text nor the snapshot of mutable objects shows it, and in the notebook it is constant by now.
    sources = (
        "import threading\ndef use(x):\n    return threading.stack_size(1 << 24)",
        "import gc\ndef use(x):\n    before = gc.get_threshold()[0]\n    gc.set_threshold(1500)\n    return before",
    )
    reasons = reasons_against(sources, tmp_path / "bundle")
    assert len(reasons) == len(sources)
    for number, reason in enumerate(reasons):
        assert f"token 'used_{number}': " in reason
        assert f"It depends on when, how often and in which order function 'use_{number}' is called" in reason


def test_a_function_that_reads_a_setting_which_it_has_left_is_refused(tmp_path):
    # A bundle puts these back after each call, so that they are what they were before the notebook's first run.
    sources = (
        "import numpy as np\ndef use(x):\n    return np.seterr(all='ignore')['over']",
        "import sys\ndef use(x):\n    before = sys.getrecursionlimit()\n    sys.setrecursionlimit(1500)\n    return before",
    )
    reasons = reasons_against(sources, tmp_path / "bundle")
    assert len(reasons) == len(sources)
    for number, reason in enumerate(reasons):
        assert f"token 'used_{number}': " in reason


@fresh
def test_a_function_that_fails_under_a_condition_is_refused_with_it(tmp_path):
    source = "import time\ndef use(x):\n    assert time.localtime(0).tm_min != 37, 'late'\n    return x"
    text = refusal(source, tmp_path / "bundle")
    assert "AssertionError: late" in text
    assert "It depends on the time zone (TZ), something that is not a token. Use UTC" in text


@pytest.mark.parametrize(
    ("change", "undo", "name"),
    [
        (
            "np.seterr(all='raise')",
            "np.seterr(divide='warn', over='warn', under='ignore', invalid='warn')",
            "numpy.seterr",
        ),
        ("decimal.getcontext().prec = 5", "decimal.getcontext().prec = 28", "decimal.getcontext"),
        ("cv2.setUseOptimized(False)", "cv2.setUseOptimized(True)", "cv2.setUseOptimized"),
    ],
)
def test_a_library_that_the_notebook_has_set_otherwise_is_named(change, undo, name, tmp_path):
    names = cell(
        f"import cv2, decimal\nimport numpy as np\n{change}\ndef use(x):\n    import cv2, decimal\n    return x + 1"
    )
    try:
        runner = ep.CompGraphRunner(ep.CompGraph({"use": names["use"]}, {"use": ("x", "used")}))
        runner.run(x=X)
        with pytest.raises(
            PromotionRefused, match=rf"The notebook has changed {name} .*a service has it as it is by default"
        ):
            ep.promote(runner, tmp_path / "bundle")
    finally:
        exec(undo, names)


def test_changed_print_options_of_numpy_are_noted(tmp_path):
    names = cell("import numpy as np\ndef use(x):\n    return str(x) if x.max() > 1e6 else 'small'")
    runner = ep.CompGraphRunner(ep.CompGraph({"use": names["use"]}, {"use": ("x", "used")}))
    runner.run(x=X)
    notes = []
    with np.printoptions(precision=2):
        ep.promote(runner, tmp_path / "bundle", on_progress=notes.append)
    assert any("The notebook has changed numpy.set_printoptions" in note for note in notes)


def test_changed_print_options_of_numpy_are_refused_where_a_function_writes_an_array_as_text(tmp_path):
    names = cell("import numpy as np\ndef use(x):\n    return np.array2string(x) if x.max() > 1e6 else 'small'")
    runner = ep.CompGraphRunner(ep.CompGraph({"use": names["use"]}, {"use": ("x", "used")}))
    runner.run(x=X)
    with np.printoptions(precision=2), pytest.raises(PromotionRefused, match="has changed numpy.set_printoptions"):
        ep.promote(runner, tmp_path / "bundle")


@fresh
def test_each_number_of_threads_is_varied_from_what_it_is_set_to(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENCV_FOR_THREADS_NUM", "1")
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        text = refusal("import cv2\ndef use(x):\n    return cv2.getNumThreads()", tmp_path / "bundle")
    finally:
        cv2.setNumThreads(before)
    assert "It depends on the number of threads (OMP_NUM_THREADS, cv2.setNumThreads)" in text


def test_lines_that_no_sample_runs_are_named(tmp_path):
    source = "def use(x):\n    if x.max() > 2:\n        x = x / 2\n        x = x + 1\n    return x"
    runner = ep.CompGraphRunner(ep.CompGraph({"use": cell(source)["use"]}, {"use": ("x", "used")}))
    runner.run(x=X)
    steps = []
    bundle = ep.promote(runner, tmp_path / "bundle", on_progress=steps.append)
    lines = (bundle.path / "pipeline.py").read_text().splitlines()
    first = lines.index("        x = x / 2") + 1
    assert f"No sample runs these lines of pipeline.py, so no replay proves them: {first}-{first + 1}. " in steps[-1]
    assert verify(bundle.path).notes == (steps[-1],)
    ep.promote(runner, tmp_path / "bundle", samples=[X * 9], on_progress=steps.append)
    assert verify(bundle.path).notes == ()


def test_a_function_that_counts_is_refused(tmp_path):
    text = refusal("import itertools\nN = itertools.count()\ndef use(x):\n    return next(N)", tmp_path / "bundle")
    assert "'use_0'" in text


@fresh
def test_noise_that_the_number_of_threads_makes_is_tolerated_as_such(tmp_path):
    source = (
        "import cv2, numpy as np\ndef use(x):\n    parts = np.array_split(x, cv2.getNumThreads() + 1)\n"
        "    return np.array([sum(np.cumsum(part)[-1] for part in parts)], np.float32)"
    )
    runner = ep.CompGraphRunner(ep.CompGraph({"use": cell(source)["use"]}, {"use": ("x", "used")}), {})
    runner.run(x=X)
    bundle = ep.promote(runner, tmp_path / "bundle")
    assert 0 < bundle.settings.tolerances["used"].relative < 1e-4
    text = (bundle.path / "pipeline.toml").read_text()
    assert "[tolerance.used]\n# Replays of the samples gave other last digits: a replay may" in text
    assert verify(bundle.path).identical
