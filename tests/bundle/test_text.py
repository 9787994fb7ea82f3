"""What is written out is what the function computes: not what its file says by now, nor what dedenting made of it."""

from __future__ import annotations

import ast
import linecache
import os
import textwrap
import warnings

import numpy as np
import pytest

import epypes as ep
from epypes.errors import SourceRefused
from tests.bundle.slicing import slice_graph
from tests.bundle.test_slicer import executed as module_of
from tests.bundle.test_slicer import notebook, promoted


def written(function) -> str:
    return ep.to_source(ep.CompGraph({"f": function}, {"f": ("x", "y")}))


def executed(text: str):
    names: dict = {}
    exec(compile(text, "straight", "exec", dont_inherit=True), names)
    return names["run_graph"]


LITERALS = {
    "indented line": 'if True:\n    def f(x):\n        s = """\n        a"""\n        return s * x\n',
    "line at the margin": 'if True:\n    def f(x):\n        s = """\nb\n"""\n        return s * x\n',
    "raw bytes": "if True:\n    def f(x):\n        return rb'''\n    \\d\n  '''[::x]\n",
    "continued": "if True:\n    def f(x):\n        return 'a\\\n        b' * x\n",
    "f-string": 'if True:\n    def f(x):\n        return f"""\n        {x}\n      {f"{x}"} b\n        """\n',
    "blank lines in it": 'if True:\n    def f(x):\n        s = """\n    \n\n        """\n        return s * x\n',
    "docstring": 'if True:\n    def f(x):\n        """Say.\n\n        More.\n        """\n        return f.__doc__ * x\n',
    "as a default": 'if True:\n    def f(x, s="""\n        a"""):\n        return s * x\n',
    "tabs": 'if True:\n\tdef f(x):\n\t\ts = """\n\t\ta"""\n\t\treturn s * x\n',
    "form feed": 'if True:\n    def f(x):\n        return "a\x0cb\u2028c" * x\n',
    "twice": 'if True:\n    def f(x):\n        return ("""\n    a""" + """\n    b""",\n  x, """c""")\n',
}


@pytest.mark.parametrize("source", LITERALS.values(), ids=LITERALS)
def test_string_literals_are_written_out_as_they_are(source):
    function = notebook(source)["f"]
    assert executed(written(function))(2) == function(2)
    text, refusals = promoted(source)
    assert refusals == []
    assert module_of(text).func_dict["f"](2) == function(2)


def test_all_else_is_dedented_with_comments_and_brackets_that_stand_before():
    source = (
        "if True:\n    # Adds.\n    def f(x):\n  # odd\n        y = (x +\n  1)\n\n        # even\n        return y\n"
    )
    text = written(notebook(source)["f"])
    assert text.startswith("# Adds.\ndef f(x):\n# odd\n    y = (x +\n1)\n\n    # even\n    return y\n\n\n")
    assert executed(text)(2) == 3


def test_what_python_warned_of_is_not_warned_of_again():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        function = notebook("def f(x):\n    return '\\d' * x\n")["f"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "'\\d'" in written(function)


def test_a_comment_on_the_encoding_of_its_file_stays_there():
    text = written(notebook("#!/usr/bin/python\n# -*- coding: latin-1 -*-\n# Adds.\ndef f(x):\n    return x\n")["f"])
    assert text.startswith("# Adds.\ndef f(x):")


PRIVATE = "class C:\n    def f(x):\n        __hidden = locals()\n        return __hidden\nf = C.f\n"
PRIVATE_FREE = "class C:\n    def f(x):\n        hidden = x + 1\n        return hidden\nf = C.f\n"


def test_a_function_whose_text_means_something_else_elsewhere_is_refused():
    assert executed(written(notebook(PRIVATE_FREE)["f"]))(2) == 3
    with pytest.raises(SourceRefused, match=r"'f' \(.*, line 2\): the notebook has it with another text"):
        written(notebook(PRIVATE)["f"])


@pytest.mark.parametrize("head", ["", "from __future__ import annotations\n"])
def test_classes_and_functions_inside_are_compared_too(head):
    inside = (
        "def f(x):\n    class C:\n        k: int = 3\n        def g(self, y: float) -> int:\n            return y + self.k\n"
        "    return C().g(x), (lambda z: z + 0.0)(x)\n"
    )
    function = notebook(f"{head}def make():\n{textwrap.indent(inside, '    ')}    return f\nf = make()\n")["f"]
    assert executed(written(function))(2) == function(2) == (5, 2.0)


def test_a_class_inside_asks_for_the_names_that_it_has_not_given_itself():
    source = "K = 3\ndef f(x):\n    class C:\n        K = K + 1\n        b = K * x\n    return C.b, C.__name__\n"
    text = written(notebook(source)["f"])
    assert text.startswith("K = 3\n\n\ndef f(x):")
    assert executed(text)(2) == (8, "C")


def run_script(path, text):
    """Write a script and run it as ``python script.py`` does."""
    path.write_text(text, encoding="utf-8")
    names: dict = {"__name__": "__main__"}
    exec(compile(text, str(path), "exec", dont_inherit=True), names)
    return names["f"]


@pytest.mark.parametrize(
    "later",
    ["def f(x):\n    return x + 2\n", "def f(x):\n    return x + 1.0\n", "\ndef f(x):\n    return x + 1\n", "def g(:\n",
     "def f(x):\n    return g(x)\n", "def f(x):\n    return (lambda z: z + 2)(x)\n"],
)  # fmt: skip
def test_a_script_that_was_changed_after_it_was_started_is_refused(tmp_path, later):
    path = tmp_path / "script.py"
    function = run_script(path, "def f(x):\n    return x + 1\n")
    path.write_text(later, encoding="utf-8")
    with pytest.raises(SourceRefused, match=r"script\.py, line 1\): that was changed since .* Run it again"):
        written(function)


def test_a_change_elsewhere_in_a_script_does_no_harm(tmp_path):
    path = tmp_path / "script.py"
    function = run_script(path, "def f(x):\n    return x + 1\n\n\nK = 1\n")
    path.write_text("def f(x):\n    return x + 1  # one\n\n\nK = 222\n", encoding="utf-8")
    assert executed(written(function))(3) == 4


def test_a_script_that_was_changed_and_run_again_is_read_again(tmp_path):
    path = tmp_path / "script.py"
    assert executed(written(run_script(path, "def f(x):\n    return x + 1\n")))(3) == 4
    again = run_script(path, "def f(x):\n    return x + 22\n")
    assert "x + 1" in linecache.getline(str(path), 2), "the lines of the first run are remembered"
    os.utime(path, (0, 0))
    assert executed(written(again))(3) == 25


@pytest.mark.parametrize("value", [2.0, True, 7, "2", None, [2]])
def test_a_default_that_was_changed_since_is_written_as_it_is(value):
    function = notebook("def f(x, k=2):\n    return x, k\n")["f"]
    function.__defaults__ = (value,)
    assert repr(executed(written(function))(1)) == repr((1, value))
    function.__defaults__ = (object(),)
    with pytest.raises(SourceRefused, match=r"default '2' \(.*, line 1\), which no short expression makes again"):
        written(function)


@pytest.mark.parametrize("given", ["def f(x, *, k=K):\n    return x * k", "f = lambda x, k=K: x * k"])
def test_a_default_keeps_its_value_when_its_name_has_another_by_now(given):
    text = written(notebook(f"K = 5\n{given}\nK = 9\n")["f"])
    assert "k=5)" in text
    assert "K = " not in text
    assert executed(text)(2) == 10


def test_a_default_that_was_filled_since_is_written_as_it_is():
    function = notebook("def f(x, k=[]):\n    k.append(x)\n    return k\n")["f"]
    assert executed(written(function))(1) == [1]
    function(1)
    assert executed(written(function))(2) == [1, 2]


@pytest.mark.parametrize("default", [None, 2])
def test_parameters_that_have_a_default_since_or_have_none_by_now_are_refused(default):
    function = notebook(f"def f(x, k={default}, *, m=3):\n    return x, k, m\n")["f"]
    cg = ep.CompGraph({"f": function}, {"f": ("x", "y")})
    assert executed(ep.to_source(cg))(1) == (1, default, 3)
    for by_position, by_name in ((None, {"m": 3}), ((1, 2), {"m": 3}), ((default,), {})):
        function.__defaults__, function.__kwdefaults__ = by_position, by_name
        with pytest.raises(SourceRefused, match="'f' .*: it has default of '.' only in the (notebook|module)"):
            ep.to_source(cg)
    function.__defaults__, function.__kwdefaults__ = (default,), {"m": 4}
    assert executed(ep.to_source(cg))(1) == (1, default, 4)


def test_a_function_with_attributes_is_refused_and_so_is_one_that_it_calls():
    names = notebook("def g(x):\n    return x + g.off\ng.off = 5\ndef f(x):\n    return g(x)\n")
    for name in "gf":
        with pytest.raises(SourceRefused, match="it has attribute 'off' only in the notebook"):
            written(names[name])


@pytest.mark.parametrize("by_statement", [False, True])
def test_a_script_is_compiled_as_a_whole_and_a_cell_by_statement(tmp_path, by_statement):
    source = "import cv2\n\n\ndef f(x):\n    return cv2.norm(x)\n"
    path = tmp_path / "script.py"
    path.write_text(source, encoding="utf-8")
    names: dict = {"__name__": "__main__"}
    tree = ast.parse(source)
    for unit in [ast.Module([statement], []) for statement in tree.body] if by_statement else [tree]:
        exec(compile(unit, str(path), "exec", dont_inherit=True), names)
    assert executed(written(names["f"]))(np.full((1, 1), -3.0)) == 3.0


def test_a_sum_of_a_thousand_is_written():
    function = notebook(f"def f(x):\n    return {' + '.join(['x'] * 900)}\n")["f"]
    assert executed(written(function))(2) == 1800


def test_code_that_was_put_into_a_function_is_refused():
    names = notebook("def g(x):\n    return x\n\n\ndef f(x):\n    return -x\n")
    names["f"].__code__ = names["g"].__code__.replace(co_name="f", co_firstlineno=5)
    needed, _ = slice_graph({"f": names["f"]})
    assert "'f' is not what its source says" in needed.refusals[0]


def test_an_asynchronous_function_is_refused_as_such():
    with pytest.raises(SourceRefused, match="'g', which function 'f' calls, is asynchronous"):
        written(notebook("async def g(x):\n    return x\n\n\ndef f(x):\n    return g(x)\n")["f"])
