"""The documentation site is complete, is built without warnings, and is readable in both themes."""

from __future__ import annotations

import inspect
import json
import re
import subprocess

import click
import pytest

import epypes as ep
import epypes_widgets
from epypes import errors, wire
from epypes.cli.app import app
from tests.browser.contrast import schemes, unreadable
from tests.docs.pages import DOCS, ROOT

pytestmark = pytest.mark.slow
PUBLIC = {"epypes": ep, "epypes.wire": wire, "epypes_widgets": epypes_widgets}


@pytest.fixture(scope="module")
def site():
    """The folder of the site, built by ``make docs``; what the tests run in is not installed again."""
    done = subprocess.run(
        ["make", "-o", ".venv/.test", "docs"], cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return DOCS / "_build/html"


@pytest.fixture(scope="module")
def inventory(site):
    """By kind of object, the names of all objects in the site and the addresses of their entries."""
    from sphinx.util.inventory import InventoryFile

    with (site / "objects.inv").open("rb") as file:
        return InventoryFile.load(file, "", lambda base, path: path)


def documented(inventory, *kinds):
    return {name for kind in kinds for name in inventory[kind]}


def test_every_public_name_is_in_the_reference(inventory):
    found = documented(inventory, "py:class", "py:function", "py:data", "py:exception", "py:attribute")
    public = {f"{module}.{name}" for module, room in PUBLIC.items() for name in room.__all__} - {"epypes.errors"}
    assert public - found == set()


def test_every_error_is_in_the_reference(inventory):
    kinds = [
        kind for kind in vars(errors).values() if inspect.isclass(kind) and issubclass(kind, ep.errors.EpypesError)
    ]
    public = {f"epypes.errors.{kind.__name__}" for kind in kinds if not kind.__name__.startswith("_")}
    assert public - documented(inventory, "py:exception") == set()


def commands(group, path):
    for name, command in group.commands.items():
        yield [*path, name], command
        if isinstance(command, click.Group):
            yield from commands(command, [*path, name])


def test_every_command_and_option_is_in_the_reference(site, inventory):
    page = (site / "reference/commands.html").read_text(encoding="utf-8")
    options = documented(inventory, "std:cmdoption")
    for path, command in commands(app, ["epypes"]):
        assert f'id="{"-".join(path)}"' in page
        own = [option for option in command.params if isinstance(option, click.Option)]
        named = {f"{'-'.join(path)}.{option.opts[-1]}" for option in own}
        assert named - options == set()


def test_every_term_of_the_glossary_occurs_in_the_code(inventory):
    modules = [*(ROOT / "epypes").rglob("*.py"), *(ROOT / "widgets").rglob("*.py")]
    code = " ".join(" ".join(path.read_text(encoding="utf-8").split()) for path in modules).casefold()
    terms = documented(inventory, "std:term")
    assert len(terms) > 40
    assert {term for term in terms if not re.search(rf"\b{re.escape(term.casefold())}s?\b", code)} == set()


def test_the_search_index_has_the_runner(site):
    text = (site / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
    assert "CompGraphRunner" in {entry[-1] for entry in index["objects"]["epypes"]}
    assert "CompGraphRunner" in index["titles"]


def test_no_page_loads_anything_from_another_machine(site):
    loading = re.compile(
        r"<(?:script|img|iframe|source)[^>]+src=\"(?:https?:)?//[^\"]+|<link[^>]+href=\"https?://[^\"]+"
    )
    pages = [*site.rglob("*.html")]
    assert len(pages) > 100
    assert [found for page in pages for found in loading.findall(page.read_text(encoding="utf-8"))] == []


@pytest.mark.browser
def test_a_tutorial_is_readable_in_both_themes_and_the_search_finds_the_runner(site, browser):
    page = browser.new_page()
    page.goto((site / "tutorials/01_edge_detection.html").as_uri())
    for scheme in schemes(page):
        page.wait_for_selector(f'html[data-theme="{scheme}"]', timeout=60_000)
        assert unreadable(page, ".bd-article") == []
    page.goto((site / "search.html").as_uri() + "?q=CompGraphRunner")
    page.wait_for_selector('#search-results a[href*="epypes.CompGraphRunner.html"]', timeout=60_000)
    page.close()
