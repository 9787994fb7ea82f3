"""A notebook that has patched a library, or set it otherwise, is refused by name and line, also if no sample shows it."""

from __future__ import annotations

import calendar
import contextlib
import csv
import decimal
import logging
import warnings

import cv2
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from scipy import special

import epypes as ep
from epypes.bundle.proof.compare import first_difference
from epypes.errors import PromotionRefused
from tests.bundle.hostile import in_notebook

pytestmark = pytest.mark.slow  # each proves a bundle in processes of its own

X = np.arange(4096, dtype=np.uint8).reshape(64, 64)
RUN = "runner = ep.CompGraphRunner(ep.CompGraph({'use': use}, {'use': ('x', 'used')}))\n_ = runner.run(x=x)"


def branch(expression, before=""):
    """Return a cell whose function computes an expression on inputs that are no sample."""
    return f"{before or '# none'}\ndef use(x):\n    return {expression} if x.mean() > 200 else 0"


def refusal(monkeypatch, to, *cells):
    names = in_notebook(monkeypatch, *cells, RUN, ep=ep, np=np, cv2=cv2, x=X)
    with pytest.raises(PromotionRefused) as caught:
        ep.promote(names["runner"], to / "bundle")
    assert not (to / "bundle").exists()
    return "\n".join(caught.value.reasons)


@contextlib.contextmanager
def put_back():
    """Put the attributes of libraries back that a test changes."""
    import colorsys
    import fractions
    import string
    import textwrap

    from skimage.filters import gaussian, thresholding

    attributes = [
        (cv2, "INTER_AREA"), (cv2, "INTER_CUBIC"), (cv2, "INTER_LINEAR"), (np, "median"), (thresholding, "histogram"), (fractions.Fraction, "limit_denominator"),
        (textwrap.indent, "__defaults__"), (colorsys, "ONE_THIRD"), (textwrap, "_whitespace"), (string, "whitespace"), (gaussian, "__code__"), (gaussian, "__kwdefaults__"),
    ]  # fmt: skip
    values = [(owner, name, getattr(owner, name)) for owner, name in attributes]
    try:
        yield
    finally:
        for owner, name, value in values:
            setattr(owner, name, value)
        for name in ("gain_of_here", "n_calls"):
            vars(np).pop(name, None)


# By what patches it: a cell, what is computed on a branch, and what the reason says.
PATCHES = {
    "a helper": (
        "def patch(module, name, value):\n    setattr(module, name, value)\npatch(cv2, 'INTER_AREA', 0)",
        "cv2.INTER_AREA",
        "The notebook has changed cv2.INTER_AREA (cell [N], line 3, 0); a service has it as it was installed (3).",
    ),
    "the namespace": (
        "cv2.__dict__.update(INTER_CUBIC=0)",
        "cv2.resize(x, (9, 9), interpolation=cv2.INTER_CUBIC)",
        "cv2.INTER_CUBIC (cell [N], line 1, 0)",
    ),
    "the namespace in a loop": (
        "for name, value in {'INTER_LINEAR': 0}.items():\n    vars(cv2)[name] = value",
        "cv2.INTER_LINEAR",
        "cv2.INTER_LINEAR (cell [N], line 1, 0)",
    ),
    "another name of the module": (
        "def patch(module):\n    module.median = np.max\npatch(np)",
        "float(np.median(x))",
        "numpy.median (cell [N], line 2, ",
    ),
    "a mock of a constant": (
        "from unittest import mock\n_ = mock.patch('colorsys.ONE_THIRD', 9.0).start()",
        "colorsys.ONE_THIRD",
        "colorsys.ONE_THIRD (cell [N], line 2, 9.0)",
    ),
    "a change deep in a library": (
        "import skimage.filters.thresholding as th\nth.histogram = lambda *a, **k: (np.array([1, 5]), np.array([10, 20]))",
        "float(skimage.filters.threshold_isodata(x))",
        "skimage.filters.thresholding.histogram (cell [N], line 2, ",
    ),
    "a method of a class": (
        "import fractions\ntype.__setattr__(fractions.Fraction, 'limit_denominator', lambda self, n=9: 5)",
        "float(fractions.Fraction(1, 3).limit_denominator())",
        "fractions.Fraction.limit_denominator (cell [N], line 2, ",
    ),
    "defaults": (
        "import textwrap\ndef change(f, *values):\n    f.__defaults__ = values\nchange(textwrap.indent, bool)",
        "textwrap.indent('a', '> ')",
        "The notebook has changed textwrap.indent (in its code or defaults); ",
    ),
    "code": (
        "from skimage.filters import gaussian\ndef change(f, g):\n    f.__code__, f.__kwdefaults__ = g.__code__, None\n"
        "change(gaussian, lambda *a, **k: 0)",
        "gaussian(x)",
        "gaussian (",
    ),
    "a private constant": (
        "def hide(module, **values):\n    vars(module).update(values)\nhide(textwrap, _whitespace='a')",
        "textwrap.wrap('a b')",
        "The notebook has changed textwrap._whitespace (cell [N], line 3, 'a');",
    ),
    "a constant in lower case that the bundle does not name": (
        "import string\nsetattr(string, 'whitespace', '_')",
        "string.capwords('a b')",
        "string.whitespace (cell [N], line 2, '_')",
    ),
    "a new attribute": (
        "def add(module, **values):\n    vars(module).update(values)\nadd(np, gain_of_here=3)",
        "getattr(np, 'gain_of_here', 1)",
        "numpy.gain_of_here (cell [N], line 3, 3); a service has it as it was installed (it is not there).",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def reasons_against_patches(tmp_path_factory):
    """All patches in one notebook, since each promotion starts processes."""
    imports = "import colorsys, fractions, textwrap, skimage.filters\nfrom skimage.filters import gaussian"
    used = ", ".join(used for _, used, _ in PATCHES.values())
    with pytest.MonkeyPatch.context() as monkeypatch, put_back():
        cells = [imports, *(cell for cell, _, _ in PATCHES.values()), branch(f"({used})")]
        return refusal(monkeypatch, tmp_path_factory.mktemp("patches"), *cells)


@pytest.mark.parametrize("how", PATCHES)
def test_a_library_that_the_notebook_has_patched_is_named_with_its_line(how, reasons_against_patches):
    number = [*PATCHES].index(how) + 2
    assert PATCHES[how][2].replace("cell [N]", f"cell [{number}]") in reasons_against_patches


def test_an_entry_that_a_cell_registers_in_python_s_library_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(logging, "_levelToName", {**logging._levelToName})
    monkeypatch.setattr(logging, "_nameToLevel", {**logging._nameToLevel})
    cell = "import logging\nlogging.addLevelName(30, 'W')"
    text = refusal(monkeypatch, tmp_path, cell, branch("logging.getLevelName(30)"))
    assert "logging._levelToName[30] (cell [1], line 2, 'W'); a service has it as it was installed ('WARNING')" in text


def test_a_function_that_keeps_something_in_a_library_is_refused(monkeypatch, tmp_path):
    source = (
        "def bump(owner):\n    owner.n_calls = getattr(owner, 'n_calls', 0) + 1\n    return owner.n_calls\n"
        "def use(x):\n    return bump(np) * 0"
    )
    with put_back():
        text = refusal(monkeypatch, tmp_path, source)
    assert "Function 'use' changed 'numpy.n_calls', which outlives the call" in text


# By name: a cell that changes a setting, and what is computed on a branch.
SETTINGS = {
    "decimal.getcontext": ("import decimal\ndecimal.getcontext().Emax = 99", "str(decimal.Decimal(1) / 3)"),
    "pandas.set_option compute.use_bottleneck": (
        "import pandas as pd\npd.set_option('compute.use_bottleneck', False)",
        "pd.Series([1.0]).sum()",
    ),
    "matplotlib.rcParams image.cmap": (
        "import matplotlib.style\nmatplotlib.style.use({'image.cmap': 'gray'})",
        "str(matplotlib.rcParams['image.cmap'])",
    ),
    "scipy.special.seterr": ("from scipy import special\nspecial.seterr(all='raise')", "special.gamma(-1.0)"),
    "calendar.setfirstweekday": ("import calendar\ncalendar.setfirstweekday(6)", "calendar.monthcalendar(2024, 5)[0]"),
    "csv.register_dialect": (
        "import csv\ncsv.register_dialect('plc', delimiter=';')",
        "csv.get_dialect('plc').delimiter",
    ),
    "warnings.simplefilter": ("import warnings\nwarnings.simplefilter('error', RuntimeWarning)", "caught(x)"),
}


@contextlib.contextmanager
def settings_put_back():
    with warnings.catch_warnings(), mpl.rc_context(), decimal.localcontext():
        warnings.resetwarnings()
        errors = special.geterr()
        try:
            yield
        finally:
            pd.reset_option("compute.use_bottleneck")
            special.seterr(**errors)
            calendar.setfirstweekday(0)
            csv.unregister_dialect("plc")


@pytest.fixture(scope="module")
def reasons_against_settings(tmp_path_factory):
    before = (
        "import calendar, csv, decimal, matplotlib\nimport pandas as pd\nfrom scipy import special\n"
        "def caught(x):\n    try:\n        return float(np.float64(1) / x.min())\n    except RuntimeWarning:\n        return -1.0"
    )
    used = ", ".join(used for _, used in SETTINGS.values())
    with pytest.MonkeyPatch.context() as monkeypatch, settings_put_back():
        cells = [*(cell for cell, _ in SETTINGS.values()), branch(f"({used})", before)]
        return refusal(monkeypatch, tmp_path_factory.mktemp("settings"), *cells)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_setting_that_the_notebook_has_changed_is_named_with_its_line(name, reasons_against_settings):
    number = [*SETTINGS].index(name) + 1
    assert f"The notebook has changed {name} (cell [{number}], line 2, " in reasons_against_settings
    assert "Change it inside the function that needs it, or set it back." in reasons_against_settings


def test_a_locale_that_the_notebook_has_set_is_named(monkeypatch, tmp_path):
    # The machine may have no other one than C.
    monkeypatch.setattr("locale.setlocale", lambda category, name=None: "de_DE.UTF-8")
    refused = refusal(monkeypatch, tmp_path, branch("locale.str(1.5)", "import locale"))
    assert "The notebook has changed locale.setlocale" in refused
    assert "LC_NUMERIC=de_DE.UTF-8" in refused


def test_options_that_change_how_tables_are_shown_are_noted(monkeypatch, tmp_path):
    names = in_notebook(monkeypatch, "import pandas as pd", branch("str(pd.Series([1 / 3]))"), RUN, ep=ep, np=np, x=X)
    notes = []
    with pd.option_context("display.precision", 2):
        ep.promote(names["runner"], tmp_path / "bundle", on_progress=notes.append)
    assert any("The notebook has changed pandas.set_option display.precision (2)" in note for note in notes)


def test_a_notebook_that_has_used_libraries_a_lot_is_promoted(monkeypatch, tmp_path):
    """Libraries load parts, fill caches, and remember what they were asked for."""
    import random
    import tempfile

    import matplotlib.pyplot as plt
    import networkx
    import scipy.ndimage
    import scipy.stats
    from skimage import exposure, feature, filters, measure, segmentation

    random.seed(3)
    tempfile.TemporaryFile().close()
    cv2.setNumThreads(cv2.getNumThreads())
    table = pd.DataFrame(measure.regionprops_table(measure.label(X > 100), X, properties=("area", "mean_intensity")))
    figure, axes = plt.subplots()
    axes.imshow(feature.canny(filters.gaussian(X, 2)))
    axes.hist(table["area"])
    figure.savefig(tmp_path / "seen.png")
    plt.close(figure)
    segmentation.slic(X, 5, channel_axis=None)
    exposure.equalize_adapthist(X)
    scipy.stats.norm.fit(X.ravel())
    networkx.ancestors(networkx.DiGraph([(1, 2)]), 2)  # these get their code at their first call
    networkx.path_graph(3)
    source = (
        "import networkx, random, tempfile\nimport pandas as pd\nimport matplotlib.pyplot as plt\nimport scipy.ndimage, scipy.stats\n"
        "from skimage import filters, measure\n"
        "def use(x):\n    if x.mean() > 200:\n        return plt.figure(), tempfile.mkdtemp(), random.random(), networkx.path_graph(3)\n"
        "    labels = measure.label(x > filters.threshold_otsu(x))\n"
        "    found = pd.DataFrame(measure.regionprops_table(labels, x, properties=('area',)))\n"
        "    return float(found['area'].sum() + scipy.ndimage.sobel(x).max() + scipy.stats.norm(0, 1).cdf(x[0, 0]))"
    )
    names = in_notebook(monkeypatch, source, RUN, ep=ep, np=np, x=X)
    bundle = ep.promote(names["runner"], tmp_path / "bundle")
    run = ep.load(bundle.path).run(x=X)
    assert first_difference(names["runner"]["used"], run["used"]) is None


# What reaches the notebook otherwise than by a name: a cell and what is computed.
REFLECTIONS = {
    "sys.modules": ("import sys", "getattr(sys.modules['__main__'], 'K', 1)"),
    "modules": ("from sys import modules", "len(modules)"),
    "use.__globals__": ("", "use.__globals__.get('K', 1)"),
    "sys._getframe": ("import sys", "sys._getframe(0).f_lineno"),
    "inspect.currentframe().f_globals": ("import inspect", "inspect.currentframe().f_globals.get('K', 1)"),
    "builtins.eval": ("import builtins", "builtins.eval('K')"),
    "run": ("run = exec", "run('1')"),
    "'__main__'": ("import importlib", "importlib.import_module('__main__').K"),
    "__import__": ("", "__import__('sys').version"),
}


@pytest.mark.parametrize("name", REFLECTIONS)
def test_a_function_that_reaches_what_no_name_says_is_refused_with_its_line(name, monkeypatch, tmp_path):
    before, used = REFLECTIONS[name]
    text = refusal(monkeypatch, tmp_path, "K = 3", branch(used, before))
    assert f"Function 'use' uses {name!r} (cell [2], line {branch(used, before).count(chr(10)) + 1})" in text


def test_what_a_loop_over_a_set_has_left_in_a_library_is_no_change_whatever_words_the_notebook_has(
    monkeypatch, tmp_path
):
    import scipy.sparse

    # In which order it goes through the set depends on the process.
    monkeypatch.setattr(scipy.sparse._data, "name", "another one")
    cells = ("import scipy.sparse\ndef use(x):\n    return scipy.sparse.csr_array(x).nnz", "columns = ['name']")
    names = in_notebook(monkeypatch, *cells, RUN, ep=ep, np=np, cv2=cv2, x=X)
    ep.promote(names["runner"], tmp_path / "bundle")
