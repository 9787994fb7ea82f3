"""Does a bundle still compute what was recorded, and if not, what does that likely come from?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from epypes.bundle.causes import environment_notes, likely_causes
from epypes.bundle.freshenv import replay_in_fresh_environment
from epypes.bundle.replay import REPLAY_TIMEOUT_S, replay_isolated
from epypes.bundle.report import ReplayReport
from epypes.bundle.seal import MANIFEST, check_seal
from epypes.errors import BundleError, ReplayDiffers


def verify(path: str | Path, *, fresh_env: bool = False, timeout_s: float = REPLAY_TIMEOUT_S) -> ReplayReport:
    """Replay a bundle's samples in a fresh isolated process.

    Parameters
    ----------
    path
        The bundle.
    fresh_env
        Whether to do so in a new environment, with what requirements.txt names and nothing else.
    timeout_s
        When the replay is ended.

    Returns
    -------
    ReplayReport
        Its notes tell what is not as it was when the samples were recorded, though it computes the same.

    Raises
    ------
    ReplayDiffers
        A token is not what was recorded; token, first differing index, both values and the likely cause are named.
    BundleError
        The folder is not the bundle that was promoted, its code fails, or no environment can be made.
    """
    folder = Path(path)
    try:
        check_seal(folder)
    except BundleError as error:
        raise _with_its_effect(folder, error, timeout_s) from None
    if fresh_env:
        report = replay_in_fresh_environment(folder, timeout_s)
    else:
        report = replay_isolated(folder, sealed=True, timeout_s=timeout_s)
    if report.identical:
        return replace(report, notes=(*report.notes, *report.outside, *environment_notes(folder, report)))
    raise ReplayDiffers(path, replace(report, causes=likely_causes(folder, report)))


def _with_its_effect(folder: Path, broken: BundleError, timeout_s: float) -> BundleError:
    """Return the error of a broken seal, with the token that is another because of it, if that can be found out.

    The seal tells what was changed; it does not keep strangers out, who could write it anew.
    """
    if not (folder / MANIFEST).is_file():
        return broken
    try:
        report = replay_isolated(folder, sealed=False, timeout_s=timeout_s)
    except BundleError:
        return broken
    if report.identical:
        return BundleError(folder, f"{broken} It still computes what was recorded.")
    return ReplayDiffers(folder, replace(report, causes=(str(broken),)))
