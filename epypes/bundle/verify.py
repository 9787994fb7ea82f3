"""Verification of a bundle: its samples are replayed, and a difference is explained by what is not as it was."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

from epypes.bundle.manifest import check_manifest, environment_differences, recorded_environment
from epypes.bundle.replay import REPLAY_TIMEOUT_S, ReplayReport, replay_isolated
from epypes.bundle.requirements import REQUIREMENTS, fresh_environment, pins
from epypes.errors import BundleChanged, BundleError, ReplayDiffers

_UNSTEADY: Final = (
    "The values of {} differ from run to run in one process, too: random numbers without a seed, a counter, or a clock."
)
_UNKNOWN: Final = (
    "Neither the bundle nor what it runs on has changed as far as is known: a function may depend on something that is "
    "not a token, such as a file, the current folder, or what was installed beside its package."
)


def verify(
    path: str | Path, *, fresh_env: bool = False, timeout_s: float = REPLAY_TIMEOUT_S, run_anyway: bool = False
) -> ReplayReport:
    """Replay a bundle's samples in a fresh isolated process.

    A bundle is code, and is to be trusted like code: a replay runs it with the rights of the caller. The manifest is no
    signature.

    Parameters
    ----------
    path
        The bundle.
    fresh_env
        Whether to do so in a new environment, with what requirements.txt names and nothing else.
    timeout_s
        When the replay is ended.
    run_anyway
        Whether to replay a bundle whose files are not those of its manifest, to learn which token the change affects.
        That runs the changed code. The bundle is refused all the same.

    Returns
    -------
    ReplayReport
        Its notes name what is not as it was when the samples were recorded, though it computes the same.

    Raises
    ------
    BundleChanged
        A file was changed, is missing or was added. Nothing of the bundle was run, unless ``run_anyway``.
    ReplayDiffers
        A token is not what was recorded; token, first differing index, both values and the likely cause are named.
    BundleError
        The folder is no bundle, its code fails, or no environment can be made.
    """
    folder = Path(path)
    change: BundleChanged | None = None
    try:
        check_manifest(folder)
    except BundleChanged as error:
        if not run_anyway:
            text = f"{error} Nothing of it was run; to run the changed code: epypes verify --run-anyway."
            raise BundleChanged(folder, text) from None
        change = error
    options = [] if change is None else ["--unsealed"]
    try:
        with fresh_environment(folder) if fresh_env else contextlib.nullcontext(sys.executable) as python:
            report = replay_isolated(folder, options, timeout_s=timeout_s, python=python)
    except BundleError as error:
        if change is None:
            raise
        raise BundleChanged(folder, f"{change} It can't be replayed: {error}") from error
    if change is not None:
        if report.identical:
            raise BundleChanged(folder, f"{change} It still computes what was recorded.")
        raise ReplayDiffers(folder, replace(report, causes=(str(change),)))
    notes = (
        *_pinned_otherwise(folder, report),
        *environment_differences(recorded_environment(folder), report.environment),
    )
    if report.identical:
        return replace(report, notes=(*report.notes, *report.outside, *notes))
    tokens = ", ".join(map(repr, report.unsteady))
    causes = (*([_UNSTEADY.format(tokens)] if tokens else []), *notes)
    raise ReplayDiffers(path, replace(report, causes=causes or (_UNKNOWN,)))


def _pinned_otherwise(folder: Path, report: ReplayReport) -> list[str]:
    """Return as sentences which packages are not as pinned."""
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
