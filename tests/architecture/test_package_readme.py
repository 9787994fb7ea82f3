"""A package index shows the README with links and pictures that lead to the repository, if its address is set."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from hatchling.metadata.core import ProjectMetadata
from hatchling.plugin.manager import PluginManager

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
LINK = re.compile(r"\]\(([^)]+)\)|src=\"([^\"]+)\"")


def built(urls: dict[str, str]) -> str:
    """Return the README in the metadata of a build."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project["project"]["urls"] = urls
    return ProjectMetadata(str(ROOT), PluginManager(), project).core.readme


def test_with_the_address_of_the_repository_every_link_leads_to_a_file_there(monkeypatch):
    monkeypatch.chdir(ROOT)
    text = built({"Repository": "https://host.example/epypes/"})
    links = [link or picture for link, picture in LINK.findall(text)]
    assert len(links) == len(LINK.findall(README))
    for link in links:
        below = re.fullmatch(r"https://host\.example/epypes/(blob|raw)/main/(.+)", link)
        assert below, link
        assert (below[1] == "raw") == below[2].endswith(".png")
    assert LINK.sub("", text) == LINK.sub("", README), "nothing else differs"


def test_without_one_the_readme_is_as_it_is(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert built({"Paper": "https://host.example/paper"}) == README
