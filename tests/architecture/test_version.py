"""The version of the package is that of the newest tag; builds work without tags and without Git, too."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HATCH = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]
FALLBACK = HATCH["version"]["fallback-version"]


def git(*arguments, folder):
    author = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *author, *arguments], cwd=folder, check=True, capture_output=True, timeout=60)


def version_of(folder):
    command = [sys.executable, "-m", "hatchling", "version"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


@pytest.fixture
def folder(tmp_path):
    """A folder with this project's settings, as in an unpacked archive of the repository."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_version_is_the_newest_tag_of_one_and_the_fallback_without_one(folder):
    assert version_of(folder) == FALLBACK
    git("init", folder=folder)
    git("add", ".", folder=folder)
    git("commit", "-m", "first", folder=folder)
    assert version_of(folder) == FALLBACK
    git("tag", "v9.8.7", folder=folder)
    assert version_of(folder) == "9.8.7"
    # A bundle that is promoted between two releases pins the same version on every commit.
    git("commit", "-m", "second", "--allow-empty", folder=folder)
    (folder / "changed").write_text("not committed")
    assert version_of(folder) == "9.8.7"
    git("tag", "v9.9.0.dev0", folder=folder)
    assert version_of(folder) == "9.9.0.dev0"
    git("commit", "-m", "third", "--allow-empty", folder=folder)
    for tag in ("data/v1", "paper-2019", "before-2020-cleanup"):
        git("tag", tag, folder=folder)
    assert version_of(folder) == "9.9.0.dev0"


@pytest.mark.packaging
def test_a_source_distribution_carries_its_version_with_it(source_distribution, tmp_path):
    with tarfile.open(source_distribution) as archive:
        archive.extractall(tmp_path, filter="data")
    (unpacked,) = tmp_path.iterdir()
    version = unpacked.name.removeprefix("epypes-")
    # As if another release had been made since.
    text = (unpacked / "pyproject.toml").read_text().replace(FALLBACK, "0.0.1")
    (unpacked / "pyproject.toml").write_text(text)
    assert version_of(unpacked) == version
