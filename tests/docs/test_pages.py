"""Every block of code and every command of the quickstart and the guides runs, in the order of its page."""

from __future__ import annotations

import re
import shutil
import tomllib

import cv2
import nbformat
import numpy as np
import pytest

import epypes as ep
from tests.brokers.nats import is_installed
from tests.docs.pages import BROKER, DOCS, ROOT, Reader, blocks
from tests.service.processes import run_cli

QUICKSTART = DOCS / "quickstart.md"
GUIDES = {path.stem: path for path in sorted((DOCS / "guides").glob("*.md")) if any(blocks(path))}
BUNDLE = "services/edges"


@pytest.fixture
def reader(epypes, tmp_path, monkeypatch, own_folders, photograph):
    """A reader of the quickstart, in a folder with an image of their own."""
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("photo.jpg", photograph)
    with Reader(epypes) as reader:
        reader.read(QUICKSTART)
        yield reader


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, photograph):
    """The bundle that the guide on promotion writes."""
    folder = tmp_path_factory.mktemp("promoted")
    with pytest.MonkeyPatch.context() as patched, Reader(run_cli) as reader:
        patched.chdir(folder)
        cv2.imwrite("photo.jpg", photograph)
        reader.read(QUICKSTART)
        ep.promote(reader.names["runner"], BUNDLE, outputs=["edges"])
    return folder / BUNDLE


def test_the_quickstart_tunes_an_own_image(reader):
    assert reader.names["run"].report.ran == ("blurred", "edges")
    gray = cv2.cvtColor(cv2.imread("photo.jpg"), cv2.COLOR_BGR2GRAY)
    expected = cv2.Canny(cv2.GaussianBlur(gray, (9, 9), 0), 40, 200)
    assert np.array_equal(cv2.imread("edges.png", cv2.IMREAD_GRAYSCALE), expected)


def test_the_guide_on_installation_has_every_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cells = re.findall(r"^\| ([^|]+) \|", GUIDES["install"].read_text(encoding="utf-8"), re.MULTILINE)
    named = re.findall(r"`(\w+)`", " ".join(cells))
    assert sorted([*named, "all"]) == sorted(project["optional-dependencies"])


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES)
def test_the_blocks_of_a_guide_run_from_top_to_bottom(reader, guide, request):
    text = GUIDES[guide].read_text(encoding="utf-8")
    if BROKER in text and not is_installed():
        pytest.skip("nats is not installed on this machine: sh .ci/packages")
    if guide == "promote":
        cells = [nbformat.v4.new_code_cell(text) for language, text in blocks(QUICKSTART) if language == "python"]
        nbformat.write(nbformat.v4.new_notebook(cells=cells), "quickstart.ipynb")
    elif BUNDLE in text:
        shutil.copytree(request.getfixturevalue("bundle"), BUNDLE)
    reader.read(GUIDES[guide])
