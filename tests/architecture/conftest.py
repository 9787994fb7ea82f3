"""The wheel of this checkout, built once, and environments that have it with some extras."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UV = [sys.executable, "-m", "uv"]


class Environment:
    """A virtual environment with EPypes and some of its extras, and a folder to run things in.

    What it has ``before`` are requirements that are installed first.
    """

    def __init__(self, home: Path, wheel: Path, extras: str, before: Sequence[str] = ()) -> None:
        self.bin, self.folder = home / "venv" / "bin", home / "empty"
        self.folder.mkdir()
        named = f"epypes[{extras}]" if extras else "epypes"
        subprocess.run([*UV, "venv", "--quiet", "--python", sys.executable, str(home / "venv")], check=True)
        install = [*UV, "pip", "install", "--quiet", "--python", str(self.bin / "python")]
        if before:
            subprocess.run([*install, *before], check=True)
        subprocess.run([*install, f"{named} @ {wheel.as_uri()}"], check=True)

    def has(self, *modules: str) -> list[str]:
        """Return which of these modules are installed."""
        code = "import sys, importlib.util as u; print(*[name for name in sys.argv[1:] if u.find_spec(name)])"
        return self.python(code, *modules).split()

    def python(self, code: str, *arguments: str) -> str:
        """Return what a script prints; a script that fails fails the test."""
        # A file, since processes that are started by what it does import it again.
        (self.folder / "script.py").write_text(code, encoding="utf-8")
        done = self._run([str(self.bin / "python"), "script.py", *arguments])
        assert done.returncode == 0, done.stderr
        return done.stdout

    def epypes(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of EPypes."""
        return self._run([str(self.bin / "epypes"), *arguments])

    def would_install(self, requirement: str) -> set[str]:
        """Return the packages that an installation would add or replace."""
        install = [*UV, "pip", "install", "--dry-run", "--python", str(self.bin / "python"), requirement]
        return set(re.findall(r"^ [+-] ([\w.-]+)", self._run(install).stderr, re.MULTILINE))

    def _run(self, command: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False, timeout=240)


@pytest.fixture(scope="session")
def distributions(tmp_path_factory):
    """The folder of the source distribution, and of the wheel that was built from it."""
    out = tmp_path_factory.mktemp("distributions")
    subprocess.run([*UV, "build", "--quiet", "--out-dir", str(out), str(ROOT)], check=True)
    return out


@pytest.fixture(scope="session")
def source_distribution(distributions):
    (found,) = distributions.glob("*.tar.gz")
    return found


@pytest.fixture(scope="session")
def wheel(distributions):
    (found,) = distributions.glob("*.whl")
    return found


@pytest.fixture
def environment(wheel, tmp_path_factory):
    """Make an environment with the extras that are named, as ``"serve"`` or ``"widgets,vision"``."""
    return lambda extras, before=(): Environment(tmp_path_factory.mktemp("environment"), wheel, extras, before)
