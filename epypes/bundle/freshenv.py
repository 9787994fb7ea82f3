"""Does a bundle compute what was recorded where nothing is installed but what its requirements.txt names?"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from epypes.bundle.replay import replay_isolated
from epypes.bundle.report import ReplayReport
from epypes.bundle.requirements import install_source, normalized, pins
from epypes.errors import BundleError

INSTALL_TIMEOUT_S: Final = 1200.0
# What EPypes needs to read samples; the rest of what it needs is for serving.
_NEEDED: Final = ("numpy", "protobuf")
_OURS: Final = "epypes"
_NO_NETWORK: Final = re.compile(
    r"dns error|name resolution|failed to fetch|connection (refused|error|reset)|newconnectionerror|"
    r"network is unreachable|tunneling|timed out|offline",
    re.IGNORECASE,
)
# uv keeps the wheels that it has built of folders, also when their code has changed.
_REFRESHED: Final = ("--refresh-package", _OURS)
_ADDRESSES: Final = re.compile(r"https?://\S+")


def replay_in_fresh_environment(folder: Path, *, sealed: bool, timeout_s: float) -> ReplayReport:
    """Make an environment from requirements.txt, replay there, and remove it.

    Raises
    ------
    BundleError
        No environment can be made, something can't be installed, or the replay fails.
    """
    with tempfile.TemporaryDirectory(prefix="epypes-fresh-") as scratch:
        home = Path(scratch) / "env"
        steps = _steps(home, _wanted(folder))
        until = time.monotonic() + INSTALL_TIMEOUT_S
        for what, command in steps:
            _step(folder, what, command, until - time.monotonic())
        return replay_isolated(folder, sealed=sealed, timeout_s=timeout_s, python=str(home / "bin" / "python"))


def _wanted(folder: Path) -> list[str]:
    """Return what is to be installed, as pip takes it: the pins, EPypes, and what that needs for a replay."""
    try:
        lines = (folder / "requirements.txt").read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BundleError(folder, f"{folder / 'requirements.txt'} can't be read: {error}. Promote again.") from error
    pinned = pins(lines)
    named = [_source(name, version) for name, version in pinned.items() if name != _OURS]
    needed = [requirement for name, requirement in _own_needs().items() if name not in pinned]
    return [*named, *needed, epypes_source(pinned)]


def epypes_source(pinned: Mapping[str, str]) -> str:
    """Return where to install EPypes from: the checkout that runs now, if it is one, else a requirement."""
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").is_file():
        return str(checkout)
    return _source(_OURS, pinned.get(_OURS, metadata.version(_OURS)))


def _source(name: str, version: str) -> str:
    """Return where to install a distribution from: where it was installed from here, if that was no index."""
    try:
        distribution = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return f"{name}=={version}"
    source = install_source(distribution)
    # Another version than is installed here can only come from an index; of EPypes it is the one that runs now.
    if not source or (distribution.version != version and name != _OURS):
        return f"{name}=={version}"
    address = urlsplit(source["url"])
    if address.scheme == "file":
        return unquote(address.path)
    commit = source.get("vcs_info", {}).get("commit_id")
    return f"{name} @ {source['vcs_info']['vcs']}+{source['url']}@{commit}" if commit else f"{name} @ {source['url']}"


def _own_needs() -> dict[str, str]:
    """Return the requirements of EPypes' own that a replay needs, without their markers, by name."""
    found: dict[str, str] = {}
    for requirement in metadata.requires(_OURS) or ():
        text = requirement.partition(";")[0].strip()
        name = normalized(re.split(r"[^\w.-]", text, maxsplit=1)[0])
        if name in _NEEDED:
            found.setdefault(name, text)
    return found


def _steps(home: Path, wanted: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the commands that make the environment, each with what it does: uv where it is, else venv and pip."""
    python = str(home / "bin" / "python")
    made, installed = "A new environment can't be made", "What requirements.txt names can't be installed"
    uv = uv_command()
    if uv:
        return [
            (made, [*uv, "venv", "--quiet", "--no-project", "--python", sys.executable, str(home)]),
            (installed, [*uv, "pip", "install", "--quiet", *_REFRESHED, "--python", python, *wanted]),
        ]
    pip = [python, "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
    return [(made, [sys.executable, "-I", "-m", "venv", str(home)]), (installed, [*pip, *wanted])]


def uv_command() -> list[str]:
    """Return how uv is called on this machine; empty if it is not there."""
    if importlib.util.find_spec("uv"):
        return [sys.executable, "-m", "uv"]
    path = shutil.which("uv")
    return [path] if path else []


def _step(folder: Path, what: str, command: Sequence[str], timeout_s: float) -> None:
    try:
        done = subprocess.run(  # noqa: S603 - uv, venv or pip of this interpreter
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=max(timeout_s, 0.0), check=False
        )
    except subprocess.TimeoutExpired as error:
        text = f"{what} within {INSTALL_TIMEOUT_S:g} s. Try again, or verify without --fresh-env."
        raise BundleError(folder, f"{folder}: {text}") from error
    except OSError as error:
        raise BundleError(folder, f"{folder}: {what}: {error}.") from error
    if done.returncode != 0:
        raise BundleError(folder, f"{folder}: {_reason(what, done.stderr.decode(errors='replace'))}")


def _reason(what: str, said: str) -> str:
    """Return in one sentence why a command failed, without the addresses of what it asked."""
    if _NO_NETWORK.search(said):
        return f"{what}: no package index answers. Connect to the network, or verify without --fresh-env."
    words = " ".join(_ADDRESSES.sub("...", said).split()) or "it said nothing"
    return f"{what}: {words[:300]}. Mend requirements.txt in a new promotion, or verify without --fresh-env."
