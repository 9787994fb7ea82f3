"""Why does a replay compute something else? What is not as it was when the samples were recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from epypes.bundle.environment import environment_differences
from epypes.bundle.report import ReplayReport
from epypes.bundle.requirements import pins
from epypes.bundle.seal import changed_since_recorded, recorded_environment

REQUIREMENTS: Final = "requirements.txt"
_UNSTEADY: Final = (
    "{} differ{} from run to run in one process, too: random numbers without a seed, a counter, or a clock."
)
_UNKNOWN: Final = (
    "Neither the bundle nor what it runs on has changed as far as is known: a function may depend on something that is "
    "not a token, such as a file, the current folder, or what was installed beside its package."
)


def likely_causes(folder: Path, report: ReplayReport) -> tuple[str, ...]:
    """Return as sentences what a difference likely comes from, the likeliest first."""
    causes = [*changed_since_recorded(folder), *_unsteady(report), *environment_notes(folder, report)]
    return tuple(causes or [_UNKNOWN])


def environment_notes(folder: Path, report: ReplayReport) -> tuple[str, ...]:
    """Return as sentences which packages are not as pinned, and what else the replay ran on that is not as it was."""
    recorded = recorded_environment(folder)
    return (*_pinned_otherwise(folder, report), *environment_differences(recorded, dict(report.environment)))


def warnings_in(report: ReplayReport) -> tuple[str, ...]:
    """Return the comments among the requirements, as sentences."""
    return tuple(line.removeprefix("# ") for line in report.requirements if line.startswith("#"))


def _unsteady(report: ReplayReport) -> list[str]:
    tokens = ", ".join(map(repr, report.unsteady))
    return [_UNSTEADY.format(f"The values of {tokens}", "")] if report.unsteady else []


def _pinned_otherwise(folder: Path, report: ReplayReport) -> list[str]:
    try:
        lines = (folder / REQUIREMENTS).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    pinned, imported = pins(lines), pins(report.requirements)
    found = [
        f"{REQUIREMENTS} pins {name} {version}, and {imported[name]} is imported here."
        for name, version in pinned.items()
        if name in imported and imported[name] != version
    ]
    missing = sorted(imported.keys() - pinned.keys())
    return found + ([f"{REQUIREMENTS} does not name what is imported: {', '.join(missing)}."] if missing else [])
