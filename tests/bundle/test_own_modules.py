"""Modules of the user's project go into a bundle as they are, and each bundle imports its own."""

from __future__ import annotations

import importlib
import queue
import re
import sys
import textwrap

import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.requirements import read_pins
from epypes.errors import BundleChanged, PromotionRefused, RemoteFailure, ReplayDiffers, StateChanged
from epypes.service.failures.record import FailedEvent
from epypes.service.failures.reproduce import reproduce
from epypes.service.ops.client import Client
from epypes.wire import Envelope
from tests.bundle.hostile import in_notebook
from tests.service.processes import running

SLOW = pytest.mark.slow  # each proves a bundle in processes of its own


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with a notebook, beside which files are written; what is imported from it is forgotten in the end."""
    folder = tmp_path / "project"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    # A compiled file is taken for that of a module which is written again within a second, if it is as long.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = {*sys.modules}
    yield Project(folder, monkeypatch)
    for name in sys.modules.keys() - before:
        if str(tmp_path) in str(
            getattr(sys.modules[name], "__file__", None) or getattr(sys.modules[name], "__path__", "")
        ):
            del sys.modules[name]


class Project:
    def __init__(self, folder, monkeypatch):
        self.folder, self._monkeypatch = folder, monkeypatch

    def write(self, **files):
        """Write modules, by their paths with ``__`` in place of slashes; ``write(lib__edges="...")``."""
        for name, text in files.items():
            path = self.folder / f"{name.replace('__', '/').replace('/init', '/__init__')}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(textwrap.dedent(text))
        importlib.invalidate_caches()

    def runner(self, *cells, x=None, **functions):
        """Run cells and a graph of functions, each an expression over the cells' names, on one input."""
        names = in_notebook(self._monkeypatch, *map(textwrap.dedent, cells), ep=ep, np=np)
        cg = ep.CompGraph(
            {name: eval(source, names) for name, source in functions.items()},
            {name: ("x", f"{name}_made") for name in functions},
        )
        runner = ep.CompGraphRunner(cg)
        runner.run(x=np.arange(6.0).reshape(2, 3) if x is None else x)
        return runner

    def promote(self, *cells, to="b", **functions):
        runner = self.runner(*cells, **functions)
        bundle = ep.promote(runner, self.folder.parent / to)
        assert identical(ep.load(bundle.path), runner)
        return bundle.path

    def reasons(self, *cells, **functions):
        """Return why a promotion is refused before a replay begins."""
        runner, steps = self.runner(*cells, **functions), []
        with pytest.raises(PromotionRefused) as caught:
            ep.promote(runner, self.folder.parent / "b", on_progress=steps.append)
        assert steps == []
        return "\n".join(caught.value.reasons)


def identical(loaded, runner):
    run = loaded.run(x=runner.last["x"])
    return all(np.array_equal(run[token], runner[token]) for token in runner.cg.sink_tokens)


def own_files(bundle):
    root = bundle / "modules"
    return {file.relative_to(root).as_posix() for file in root.rglob("*") if file.is_file()}


EDGES = """
    import numpy as np
    from .shapes import Shape, SIZE

    def slopes(x):
        return np.diff(x) * SIZE

    def area(x):
        return Shape(x).area
"""
SHAPES = """
    from dataclasses import dataclass

    SIZE = 3

    @dataclass
    class Shape:
        sides: "object"

        @property
        def area(self):
            from lib.helpers import product
            return product(self.sides)
"""
HELPERS = "import cv2\n\ndef product(x):\n    return cv2.sumElems(x.prod(axis=1))[0]\n"


@SLOW
def test_modules_beside_the_notebook_come_along_with_what_they_import(project):
    project.write(lib__init="", lib__edges=EDGES, lib__shapes=SHAPES, lib__helpers=HELPERS, unused="X = 1\n")
    path = project.promote("from lib.edges import slopes, area\nimport lib.edges as e", slopes="slopes", area="e.area")
    assert own_files(path) == {"lib/__init__.py", "lib/edges.py", "lib/shapes.py", "lib/helpers.py"}
    for name in own_files(path):
        assert (path / "modules" / name).read_bytes() == (project.folder / name).read_bytes()
    assert {"opencv-python-headless", "numpy"} <= set(read_pins(path)), "installed packages stay requirements"
    assert not {"lib", "lib.edges"} & set(read_pins(path))
    assert verify(path).identical


@SLOW
def test_a_module_that_registers_something_with_another_one_is_imported_too(project):
    project.write(
        table="KNOWN = {}\ndef register(f):\n    KNOWN[f.__name__] = f\n    return f\n",
        more="import table\n@table.register\ndef doubled(x):\n    return 2 * x\n",
    )
    path = project.promote("import table, more\ndef f(x):\n    return table.KNOWN['doubled'](x)", f="f")
    assert "\nimport more\n" in (path / "pipeline.py").read_text()


@SLOW
@pytest.mark.usefixtures("fresh_interpreter")  # with another hash seed
def test_functions_of_the_notebook_use_own_modules_by_attribute_constant_class_and_decorator(project):
    project.write(
        lib__init="from lib.tools import *\n",
        lib__tools="""
            import functools
            import numpy as np

            __all__ = ["scaled", "Mode", "WEIGHTS"]
            WEIGHTS = np.arange(1000.0)

            class Mode:
                FAST = 2.5

            def scaled(function):
                @functools.wraps(function)
                def wrapper(x):
                    return function(x) * Mode.FAST
                return wrapper

            @scaled
            def doubled(x):
                return 2 * x

            def make(k):
                def add(x):
                    return x + k
                return add
            """,
        namespace__inner__deep="def half(x):\n    return x / 2\n",
        acme__mine="def f(x):\n    return 2 - x\n",
        flat="def third(x):\n    return x / 3\n",
        pipeline="def tenth(x):\n    return x / 10\n",
    )
    cell = """
        import lib as l
        import lib.tools
        import namespace.inner.deep
        from namespace.inner import deep as d
        from lib import scaled, WEIGHTS
        import acme.mine
        import acme.mine as m
        import flat
        import pipeline

        @scaled
        def mine(x):
            return x + WEIGHTS[5]

        def attributes(x):
            return l.tools.doubled(x) + namespace.inner.deep.half(x) + d.half(x) + l.Mode.FAST

        def by_two_names(x):
            return acme.mine.f(x) + m.f(x)

        def late(x):
            from flat import third
            return third(x) + pipeline.tenth(x)

        adder = l.tools.make(4)
        """
    path = project.promote(
        cell,
        mine="mine",
        attributes="attributes",
        late="late",
        both="by_two_names",
        doubled="lib.tools.doubled",
        adder="adder",
    )
    expected = {"lib/__init__.py", "lib/tools.py", "namespace/inner/deep.py", "acme/mine.py", "flat.py", "pipeline.py"}
    assert own_files(path) == expected


@SLOW
def test_two_versions_of_a_module_live_in_one_process_beside_the_notebooks(project):
    project.write(lib="def f(x):\n    import more\n    return x + more.K\n", more="K = 1\n")
    one = project.promote("import lib", f="lib.f", to="one")
    project.write(lib="def f(x):\n    import more\n    return x - more.K\n", more="K = 20\n")
    for name in ("lib", "more"):
        del sys.modules[name]
    other = project.promote("import lib", f="lib.f", to="other")
    project.write(lib="def f(x):\n    return None\n", more="K = None\n")
    first, second = ep.load(one), ep.load(other)
    x = np.arange(3.0)
    for _ in range(2):
        assert list(first.run(x=x)["f_made"]) == [1, 2, 3]
        assert list(second.run(x=x)["f_made"]) == [-20, -19, -18]
    assert not [name for name in sys.modules if name.startswith("epypes_bundle")]
    lines = [line for path in (one, other) for line in (path / "MANIFEST.sha256").read_text().splitlines()]
    assert len({line for line in lines if line.endswith("  modules/lib.py")}) == 2, "the manifest shows it"


@SLOW
def test_a_loaded_bundle_is_promoted_again_and_mapped_in_processes(project):
    from concurrent.futures import ProcessPoolExecutor

    project.write(
        lib__init="",
        lib__edges="""
            from pathlib import Path
            import numpy as np

            def f(x):
                from . import more
                return x + more.K + np.loadtxt(Path(__file__).parent / "samples" / "k.txt")
            """,
        lib__more="K = 1\n",
    )
    (project.folder / "lib" / "samples").mkdir()
    (project.folder / "lib" / "samples" / "k.txt").write_text("0.5\n")
    path = project.promote("from lib.edges import f", f="f")
    assert own_files(path) == {"lib/__init__.py", "lib/edges.py", "lib/more.py", "lib/samples/k.txt"}
    for name in ("lib", "lib.edges", "lib.more"):
        del sys.modules[name]
    for file in (project.folder / "lib").glob("*.py"):
        file.unlink()
    loaded = ep.load(path)
    loaded.run(x=np.arange(3.0))
    again = ep.promote(loaded, project.folder.parent / "again").path
    assert own_files(again) == own_files(path)
    with ProcessPoolExecutor(1) as executor:
        result = ep.map(loaded, [np.arange(3.0)], executor=executor, keep=["f_made"])
    assert list(next(iter(result)).kept["f_made"]) == [1.5, 2.5, 3.5]


@SLOW
def test_files_that_the_text_names_come_along(project):
    project.write(
        lib__init="",
        lib__data="""
            import os
            import pkgutil
            from importlib.resources import files
            from pathlib import Path
            import numpy as np

            HERE = Path(__file__).resolve().parent
            ONE = np.loadtxt(HERE / "one.txt")

            def f(x):
                two = np.loadtxt(os.path.join(os.path.dirname(__file__), "tables", "two.txt"))
                folder = HERE / "tables"
                return x + ONE + two + np.loadtxt(folder / "three.txt") + np.loadtxt(str(HERE.parent) + "/shared/four.txt")

            def g(x):
                text = files(__package__).joinpath("five.txt").read_text()
                other = pkgutil.get_data(__package__, "six.txt")
                return x * float(text) * float(other)

            def unused(name):
                return np.loadtxt(HERE / name)

            if __name__ == "__main__":
                print(np.loadtxt(HERE / "none.txt"), np.loadtxt("one.txt"))
            """,
    )
    names = {"one": "lib", "two": "lib/tables", "three": "lib/tables", "four": "shared", "five": "lib", "six": "lib"}
    for number, (name, folder) in enumerate(names.items()):
        (project.folder / folder).mkdir(exist_ok=True)
        (project.folder / folder / f"{name}.txt").write_text(f"{number + 1}\n")
    path = project.promote("from lib.data import f, g", f="f", g="g")
    assert own_files(path) - {"lib/__init__.py", "lib/data.py"} == {
        f"{place}/{name}.txt" for name, place in names.items()
    }
    assert verify(path).identical


READS = {
    "a name that is computed": ("np.loadtxt(HERE / f'{len(x)}.txt')", r"reads files beside itself \(.*line 8: HERE\)"),
    "all of a folder": (
        "[*HERE.glob('*.txt')] and x",
        r"reads files beside itself \(.*line 8: HERE\).*does not say which",
    ),
    "a file that is not there": ("(HERE / 'gone.txt').exists() or x", r"gone\.txt, which is not there"),
    "a file outside": ("np.loadtxt(HERE.parent.parent / 'out.txt')", r"out\.txt is outside of .*project"),
    "a pickle": ("np.load(HERE / 'model.pkl', allow_pickle=True)", r"model\.pkl is a pickle"),
    "the current folder": ("np.loadtxt('here.txt')", r"names 'here\.txt', a file in the current folder \(.*line 8\)"),
    "a path in the current folder": (
        "np.loadtxt(Path('here.txt'))",
        r"names 'here\.txt', a file in the current folder \(.*line 8\)",
    ),
    "an absolute path": (
        "np.loadtxt(ABSOLUTE)",
        r"names '/.*/project/lib/a\.txt' \(.*line 8\), which a service has not",
    ),
    "a path in a loop": ("[np.loadtxt(q / 'a.txt') for q in [HERE]] and x", r"line 8: HERE\).*does not say which"),
    "an attribute": ("C.ROOT and x", r"line 5: HERE\).*does not say which"),
    "a package by name": (
        "files('lib').joinpath('a.txt') and x",
        r"files\('lib'\) \(.*line 8\), which .*Write files\(__package__\)",
    ),
}


@pytest.mark.parametrize("case", READS)
def test_other_files_are_refused_by_name(case, project, tmp_path, monkeypatch):
    source, words = READS[case]
    head = "from importlib.resources import files\nfrom pathlib import Path\nimport numpy as np\nHERE = Path(__file__).parent\n"
    head += "class C: ROOT = HERE\n" if case == "an attribute" else "K = 1\n"
    head += f"UNREAD = ABSOLUTE = {str(project.folder / 'lib' / 'a.txt')!r}\n"
    project.write(lib__init="", lib__data=f"{head}def f(x):\n    return {source} if x.any() else x\n")
    for name in ("../out.txt", "lib/2.txt", "lib/model.pkl", "here.txt", "lib/a.txt"):
        (project.folder / name).write_text("1\n")
    np.array([1], dtype=object).dump(project.folder / "lib" / "model.pkl")
    monkeypatch.chdir(project.folder)
    assert len(reasons := project.reasons("from lib.data import f", f="f").splitlines()) == 1
    assert re.search(words, reasons[0])


# By name: the text of ``lib``, a cell that is run after its import, and what the reason says.
HOSTILE = {
    "a global that counts": (
        "N = 0\ndef f(x):\n    global N\n    N += 1\n    return x + N\n",
        "",
        r"Function 'f' of module 'lib' changes the global 'N' \(.*lib\.py, line 4\)",
    ),
    "a memory two calls below": (
        "SEEN = {}\nclass Memory:\n    def note(self, x):\n        SEEN[len(SEEN)] = x\n        return x\n"
        "MEMORY = Memory()\ndef f(x):\n    return MEMORY.note(x)\n",
        "",
        r"Function 'Memory.note' of module 'lib' writes into 'SEEN'.* \(.*lib\.py, line 4\)",
    ),
    "a function that the notebook replaces": (
        "def g(x):\n    return x\ndef f(x):\n    return g(x)\n",
        "lib.g = lambda x: 2 * x",
        r"Function 'f' of module 'lib' uses 'lib.g', which the notebook has changed \(cell \[1\], line 2\)",
    ),
    "a function that the notebook replaces by a text": (
        "def g(x):\n    return x\ndef f(x):\n    return g(x)\n",
        "vars(lib)['g'] = lambda x: 2 * x",
        r"Function 'f' of module 'lib' uses 'lib.g', which the notebook has changed \(.*lib\.py, line 3\)",
    ),
    "a constant that the notebook replaces by its name as text": (
        "K = 3\ndef f(x):\n    return x * K\n",
        "setattr(lib, ''.join('K'), 4)",
        r"its 'K' is 4 in the notebook and 3 in the module",
    ),
    "an array that the notebook writes into": (
        "import numpy as np\nK = np.ones(3)\ndef f(x):\n    return x * K\n",
        "vars(lib)['K'].__setitem__(0, 4)",
        r"its 'K' is array\(\[4\., 1\., 1\.\]\) in the notebook and array\(\[1\., 1\., 1\.\]\) in the module",
    ),
    "a method that the notebook replaces": (
        "class C:\n    def m(self, x):\n        return x\ndef f(x):\n    return C().m(x)\n",
        "type.__setattr__(lib.C, 'm', lambda self, x: x + 1)",
        r"the notebook has it with another text",
    ),
    "a library that the module changes": (
        "import numpy as np\nnp.copysign = lambda a, b: a\ndef f(x):\n    return np.copysign(x, -1)\n",
        "",
        r"'f' of module 'lib' uses 'numpy.copysign', which the notebook has changed \(.*lib\.py, line 2\)",
    ),
    "names by reflection": (
        "import sys\nK = 3\ndef f(x):\n    return x * sys._getframe().f_globals['K']\n",
        "",
        r"'f' of module 'lib' uses 'sys._getframe\(\).f_globals' \(.*lib\.py, line 4\)",
    ),
    "a question to a person": (
        "def f(x):\n    return x if x.any() else input()\n",
        "",
        r"'f' of module 'lib' uses 'input'",
    ),
    "the notebook as a module": ("import __main__\ndef f(x):\n    return x\n", "", r"imports the notebook itself"),
    "code that the notebook replaces": (
        "def g(x):\n    return x\ndef f(x):\n    return g(x)\n",
        "vars(lib)['g'].__code__ = (lambda x: 3 * x).__code__",
        r"the notebook has it with another text",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_own_modules_that_a_bundle_would_not_repeat_are_refused_by_line(case, project, monkeypatch):
    text, cell, words = HOSTILE[case]
    monkeypatch.setattr(np, "copysign", np.copysign)  # it is put back
    project.write(lib=text)
    assert re.search(words, project.reasons(f"import lib\n{cell}", f="lib.f"))


@pytest.mark.parametrize("change", [("return x + 1", "return x + 2"), ("K = 1", "K = 2")])
def test_a_module_that_was_changed_since_its_import_is_refused_with_a_way_out(change, project):
    text = "K = 1\ndef f(x):\n    y = x * K\n    return x + 1\n"
    project.write(lib=text)
    importlib.import_module("lib")
    project.write(lib=text.replace(*change))
    assert re.search(r"lib\.py, line 2\).*[Rr]estart the kernel", project.reasons("import lib", f="lib.f"))


def test_modules_that_are_no_plain_files_are_refused(project, tmp_path, monkeypatch):
    project.write(lib="import made\nimport statistics\nimport compiled\ndef f(x):\n    return x\n")
    project.write(statistics="from math import *\n")
    (project.folder / "compiled.py").write_text("")
    for name in ("made", "compiled", "statistics"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "made", type(sys)("made"))
    importlib.import_module("compiled").__file__ = str(project.folder / "compiled.cpython-311-x86_64-linux-gnu.so")
    (project.folder / "compiled.cpython-311-x86_64-linux-gnu.so").write_bytes(b"\x7fELF\0\xff")
    reasons = project.reasons("import lib", f="lib.f")
    monkeypatch.undo()
    assert "Module 'made' has no file: it was made by a call" in reasons
    assert re.search(
        r"Module 'statistics' \(.*project/statistics\.py\) has the name of a module of Python.*Rename it", reasons
    )
    assert re.search(r"Module 'compiled' is no file of Python text .*install its package", reasons)


@SLOW
def test_state_of_an_own_module_that_no_line_shows_fails_the_event(project):
    """The sample does not reach it, so the bundle is promoted; its event fails, and the object is put back."""
    project.write(
        lib__init="",
        lib__memory="SEEN = [[]]\n\ndef note(where, x):\n    getattr(where[0], 'app' + 'end')(x)\n    return x * len(where[0])\n",
        lib__edges="def f(x):\n    from . import memory as m\n    return m.note(m.SEEN, x) if x[0, 0] else x\n",
    )
    path = project.promote("from lib import edges", f="edges.f")
    runner = ep.load(path)
    for _ in range(2):
        with pytest.raises(StateChanged, match="SEEN"):
            runner.run(x=np.ones((2, 2)))
        assert list(runner.run(x=np.zeros((1, 2)))["f_made"][0]) == [0, 0]


@SLOW
def test_a_module_that_was_tampered_with_is_named_with_its_line(project):
    project.write(lib__init="", lib__edges="K = 1\n\ndef f(x):\n    return x + K\n")
    path = project.promote("from lib.edges import f", f="f")
    file = path / "modules" / "lib" / "edges.py"
    file.write_text(file.read_text().replace("+ K", "- K"))
    with pytest.raises(BundleChanged, match=r"modules/lib/edges\.py was changed at line 4: return x - K"):
        ep.load(path)
    with pytest.raises(ReplayDiffers, match=r"token 'f_made'[^$]*edges\.py was changed at line 4"):
        verify(path, run_anyway=True)
    file.unlink()
    with pytest.raises(BundleChanged, match=r"modules/lib/edges\.py is missing"):
        ep.load(path)


@SLOW
def test_lines_of_own_modules_that_no_sample_runs_are_named(project):
    project.write(lib="def f(x):\n    if x.min() > 9:\n        return -x\n    return x\n")
    notes = []
    ep.promote(project.runner("import lib", f="lib.f"), project.folder.parent / "b", on_progress=notes.append)
    assert any("these lines of modules/lib.py, so no replay proves them: 3." in note for note in notes)


@pytest.mark.notebook
def test_a_notebook_file_takes_modules_beside_it_and_in_a_folder_that_a_cell_puts_on_the_path(tmp_path):
    import nbformat

    from epypes.bundle.promote import promote_notebook

    (tmp_path / "book" / "lib").mkdir(parents=True)
    (tmp_path / "tools").mkdir()
    (tmp_path / "book" / "lib" / "__init__.py").write_text("from .edges import f\n")
    (tmp_path / "book" / "lib" / "edges.py").write_text("import tool\n\ndef f(x):\n    return tool.twice(x) + 1\n")
    (tmp_path / "tools" / "tool.py").write_text("def twice(x):\n    return 2 * x\n")
    cells = (
        "import sys\nsys.path.insert(0, '../tools')",
        "import epypes as ep\nfrom lib import f\nimport lib.edges as e",
        "def g(x):\n    return e.f(x) + 1",
        "runner = ep.CompGraphRunner(ep.CompGraph({'f': f, 'g': g}, {'f': ('x', 'y'), 'g': ('y', 'z')}))\n_ = runner.run(x=1)",
    )
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    nbformat.write(notebook, tmp_path / "book" / "n.ipynb")
    promote_notebook(tmp_path / "book" / "n.ipynb", "runner", tmp_path / "b")
    assert own_files(tmp_path / "b") == {"lib/__init__.py", "lib/edges.py", "tool.py"}
    assert ep.load(tmp_path / "b").run(x=4)["z"] == 20


@SLOW
def test_a_service_runs_own_modules_and_a_failure_in_one_is_named_with_its_line(project):
    fails = "raise ValueError('too bright')"
    project.write(
        lib__init="",
        lib__edges=f"from . import k\n\ndef f(x):\n    if x.max() > 9:\n        {fails}\n    return x + k.K\n",
    )
    project.write(lib__k="K = 2\n")
    path = project.promote("from lib.edges import f", f="f")
    with running(path) as process, Client(path, timeout_s=60) as client:
        assert process.ready.startswith("READY")
        assert list(client.call({"x": np.arange(3.0)}).tokens["f_made"]) == [2, 3, 4]
        with pytest.raises(RemoteFailure, match="too bright"):
            client.call({"x": np.full(3, 10.0)})
    found = reproduce(FailedEvent(), Envelope("x", {"x": np.full(3, 10.0)}), path)
    assert found.place == f"in 'f', modules/lib/edges.py, line 5: {fails}"


@SLOW
def test_the_adapters_pipeline_and_enumerations_of_a_bundle_may_stand_in_own_modules(project):
    project.write(
        lib__init="",
        lib__parts="""
            import enum
            import epypes as ep
            from epypes.wire import Envelope

            class Mode(enum.Enum):
                PLUS = 1
                MINUS = -1

            class Watched(ep.FullPipeline):
                def emit(self, event, run):
                    return super().emit(event, run)

            def f(x, mode):
                return x * mode.value

            def f_in(event):
                return {"x": event.parts["raw"]}

            def f_out(view):
                return Envelope("answer", {"y": view["y"]})
            """,
    )
    parts = importlib.import_module("lib.parts")
    cg = ep.CompGraph({"f": parts.f}, {"f": (("x", "mode"), "y")})
    pipe = parts.Watched("p", cg, None, None, parts.f_in, parts.f_out, {"mode": parts.Mode.MINUS})
    pipe.run(x=np.arange(3.0))
    path = ep.promote(pipe, project.folder.parent / "b").path
    answers = queue.Queue()
    loaded = ep.load_pipeline(path, None, answers)
    loaded.handle(Envelope("event", {"raw": np.arange(3.0)}))
    assert list(answers.get(timeout=60).parts["y"]) == [0, -1, -2]
