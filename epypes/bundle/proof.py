"""Does a draft compute what its samples say? Then it is sealed, with what it needs and what it was recorded on."""

from __future__ import annotations

from pathlib import Path

from epypes.bundle.causes import REQUIREMENTS
from epypes.bundle.reach import named_here
from epypes.bundle.replay import replay_isolated
from epypes.bundle.report import ReplayReport
from epypes.bundle.seal import seal
from epypes.errors import BundleError, PromotionRefused

_WHY = (
    "A function may depend on something that is not a token, such as a file, the current folder, a counter, "
    "the time or random numbers. Pass it in as a token."
)


def prove(draft: Path, target: Path) -> ReplayReport:
    """Replay a draft in a fresh isolated process, write its requirements, seal it; return what the replay found.

    Parameters
    ----------
    draft
        A folder with everything but requirements and manifest.
    target
        What it is to be; errors speak of it.

    Raises
    ------
    PromotionRefused
        The draft fails, or computes something else.
    """
    try:
        report = replay_isolated(draft, sealed=False)
    except BundleError as error:
        failed = str(error).replace(str(draft.resolve()), str(target))
        raise PromotionRefused(target, [failed, *named_here(draft)]) from error
    if not report.identical:
        why = [*report.outside, *named_here(draft)] or [_WHY]
        raise PromotionRefused(target, [*map(str, report.differences), *why])
    if report.outside:
        raise PromotionRefused(target, report.outside)
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in report.requirements), encoding="utf-8")
    seal(draft, report.environment)
    return report
