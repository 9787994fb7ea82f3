"""The replay of a bundle's samples, compared with what was recorded, and the likely cause of a difference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from epypes.bundle.causes import environment_notes, likely_causes
from epypes.bundle.freshenv import replay_in_fresh_environment
from epypes.bundle.replay import REPLAY_TIMEOUT_S, replay_isolated
from epypes.bundle.report import ReplayReport
from epypes.bundle.seal import check_seal
from epypes.errors import BundleChanged, BundleError, ReplayDiffers


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
        Its notes tell what is not as it was when the samples were recorded, though it computes the same.

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
        check_seal(folder)
    except BundleChanged as error:
        if not run_anyway:
            text = f"{error} Nothing of it was run; to run the changed code: epypes verify --run-anyway."
            raise BundleChanged(folder, text) from None
        change = error
    replayed = replay_in_fresh_environment if fresh_env else replay_isolated
    try:
        report = replayed(folder, sealed=change is None, timeout_s=timeout_s)
    except BundleError as error:
        if change is None:
            raise
        raise BundleChanged(folder, f"{change} It can't be replayed: {error}") from error
    if change is not None:
        if report.identical:
            raise BundleChanged(folder, f"{change} It still computes what was recorded.")
        raise ReplayDiffers(folder, replace(report, causes=(str(change),)))
    if report.identical:
        return replace(report, notes=(*report.notes, *report.outside, *environment_notes(folder, report)))
    raise ReplayDiffers(path, replace(report, causes=likely_causes(folder, report)))
