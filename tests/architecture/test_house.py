"""The rules that hold for all modules."""

from __future__ import annotations

import ast
import io
import json
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import epypes
from epypes.optional import EXTRAS

ROOT = Path(__file__).parents[2]
MODULES = sorted([*(ROOT / "epypes").rglob("*.py"), *(ROOT / "widgets").rglob("*.py")])
HEAVY = {"numpy", "cv2", "networkx", "zmq", "google", "ipywidgets", "anywidget", "traitlets", "matplotlib", "pandas",
         "IPython", "PIL", "graphviz", "pygraphviz", "click", "rich", "tomlkit", "logging", "skimage"}  # fmt: skip


def test_importing_epypes_imports_no_other_package():
    code = "import sys; before = set(sys.modules); import epypes; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert not loaded & HEAVY
    assert loaded <= set(sys.stdlib_module_names) | {"epypes"}


def test_graphs_and_runners_need_the_standard_library_only():
    code = (
        "import sys; import epypes as ep\n"
        "r = ep.CompGraphRunner(ep.CompGraph({'f': lambda x: x + 1}, {'f': ('x', 'y')}))\n"
        "assert r.run(x=1)['y'] == 2; print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert not {name.partition(".")[0] for name in done.stdout.split()} & (HEAVY - {"logging"})


def test_display_is_loaded_when_something_is_shown_first():
    code = (
        "import sys; import epypes as ep\n"
        "r = ep.CompGraphRunner(ep.CompGraph({'f': lambda x: x + 1}, {'f': ('x', 'y')}))\n"
        "r.run(x=1), repr(r); assert 'epypes.display' not in sys.modules\n"
        "assert 'image/svg+xml' in r._repr_mimebundle_() and 'ran' in str(r.last.report)"
    )
    subprocess.run([sys.executable, "-I", "-c", code], check=True)


def test_every_public_name_can_be_had_and_all_is_sorted():
    assert epypes.__all__ == sorted(epypes.__all__)
    for name in epypes.__all__:
        assert getattr(epypes, name) is not None
        assert name in dir(epypes)
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        _ = epypes.unknown
    with pytest.raises(AttributeError, match="from epypes_widgets import tune"):
        _ = epypes.tune


def test_a_module_has_at_most_500_lines_of_code():
    # That each begins with a summary, and that nothing prints, ruff sees to (D, T20).
    long = [path for path in MODULES if path.read_text().count("\n") > 500]
    lengths = {path.relative_to(ROOT).as_posix(): len(lines_of_code(path)) for path in long}
    assert {module: length for module, length in lengths.items() if length > 500} == {}


def test_a_folder_has_at_most_20_modules():
    counts = Counter(path.parent.relative_to(ROOT).as_posix() for path in MODULES)
    assert {folder: count for folder, count in counts.items() if count > 20} == {}


def lines_of_code(path):
    """Return the numbers of the lines that are neither blank nor comments nor a docstring."""
    text = path.read_text()
    skipped = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    found = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skipped:
            found.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            found.difference_update(range(node.lineno, node.end_lineno + 1))
    return found


def test_a_tutorial_asks_one_question_in_at_most_20_cells_and_holds_no_widgets_whose_script_would_be_an_older_one():
    notebooks = {path.name: json.loads(path.read_text()) for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert notebooks
    for name, notebook in notebooks.items():
        sources = ["".join(cell["source"]) for cell in notebook["cells"]]
        assert len(sources) <= 20, name
        assert sources[0].partition("\n")[0].endswith("?"), name
        assert not any("# NBVAL" in source for source in sources), name  # cells have tags
        assert "widgets" not in notebook["metadata"], name


def test_errors_are_drawn_as_a_tree_that_is_true():
    from epypes import errors

    docstring = errors.__doc__
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.EpypesError)]
    for kind in kinds:
        assert kind.__name__ in docstring or kind.__name__.startswith("_"), "every error is in the picture"
        assert kind.__doc__


def test_architecture_names_every_room_and_stays_short():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    assert len(text.splitlines()) <= 150
    for room in (ROOT / "epypes").iterdir():
        if room.is_dir() and room.name != "__pycache__":
            assert f"`{room.name}/`" in text


def imported(path):
    """Return the packages that a module imports when it runs, at the top or later, without those for types alone."""
    waiting: list[ast.AST] = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]
        waiting += ast.iter_child_nodes(node)


def required(extra):
    """Return the packages that an extra requires, those of the extras in it too."""
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"][extra]
    found = set()
    for one in map(Requirement, wanted):
        found |= set().union(*map(required, one.extras)) if one.name == "epypes" else {one.name}
    return found


@pytest.mark.slow
def test_every_package_that_is_imported_is_brought_by_an_extra_that_an_error_names():
    own = {*sys.stdlib_module_names, "epypes", "epypes_widgets", "packaging", "rich", "click"}
    assert {name for path in MODULES for name in imported(path)} - own <= EXTRAS.keys()
    # What these bring by themselves: nothing asks for them by name.
    within = {"ipython": "ipykernel", "traitlets": "ipywidgets", "jupyter-client": "nbclient", "jupyter-server": "jupyterlab",
              "pydantic": "fastapi", "pydantic-core": "fastapi", "starlette": "fastapi"}  # fmt: skip
    for package, extra in EXTRAS.values():
        assert within.get(package, package) in required(extra)


def test_opencv_is_brought_by_the_extra_of_its_own_alone():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for extra in extras if any("opencv" in name for name in required(extra))} == {"vision", "all"}


def test_tools_of_development_are_no_extras():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert {"test", "bench"} <= project["dependency-groups"].keys()
    assert not {"test", "bench"} & project["project"]["optional-dependencies"].keys()
    assert not required("all") & {"pytest", "ruff", "mypy", "loman"}
