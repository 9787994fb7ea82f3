"""The proof of a draft: replays under usual and other conditions; then it is sealed and swapped into its place."""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

from epypes.bundle.adapters import ANSWER, ANSWERS
from epypes.bundle.compare import Difference, Tolerance
from epypes.bundle.conditions import (
    CALL,
    PROCESS,
    Condition,
    library_settings,
    other_conditions,
    usual_environment,
)
from epypes.bundle.determinism import add_tolerances, read_tolerances, widened
from epypes.bundle.file_access import named_here
from epypes.bundle.load import SETTINGS
from epypes.bundle.manifest import write_manifest
from epypes.bundle.replay import REPLAY_TIMEOUT_S, ReplayReport, replay_isolated
from epypes.bundle.requirements import REQUIREMENTS
from epypes.errors import BundleError, PromotionRefused
from epypes.optional import optional_import

# From Linux's fcntl.h and fs.h.
_AT_FDCWD: Final = -100
_RENAME_EXCHANGE: Final = 2
_WHY: Final = (
    "A function may depend on something that is not a token, such as a file, the current folder, a counter, "
    "the time or random numbers. Pass it in as a token."
)
# As many as a replay of the usual and one of the other conditions.
_PROCESSES: Final = 2


def prove(draft: Path, target: Path, timeout_s: float = REPLAY_TIMEOUT_S) -> ReplayReport:
    """Replay a draft in fresh isolated processes, write its requirements, and seal it.

    Two processes replay at the same time, each every sample twice and the second time in the opposite order. The
    second one has another hash seed, working folder, time zone, locale and number of threads. Where these make floats
    differ by noise alone, as sums in parallel do, a tolerance for it is written into the draft.

    Parameters
    ----------
    draft
        A folder with everything but requirements and manifest.
    target
        What it is to be; errors name it.
    timeout_s
        When a process is ended.

    Raises
    ------
    PromotionRefused
        The draft fails, or computes something else. The token and what changes it are named.
    """
    conditions = other_conditions()
    with tempfile.TemporaryDirectory(prefix="epypes-proof-") as scratch, ThreadPoolExecutor(_PROCESSES) as pool:
        replayed = partial(_replayed, draft, target, Path(scratch), timeout_s)
        usual, other = pool.map(replayed, [(), conditions])
        if _tolerate_noise(draft, usual, other):
            other = replayed(conditions)
        changed = _changed_settings(usual)
        if changed or usual.outside or not (usual.identical and other.identical):
            raise PromotionRefused(target, [*changed, *_reasons(draft, usual, other, partial(pool.map, replayed))])
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in usual.requirements), encoding="utf-8")
    write_manifest(draft, usual.environment)
    return usual


def _changed_settings(usual: ReplayReport) -> list[str]:
    """Return how this process has set libraries that are set otherwise in a fresh one, as reasons."""
    here = library_settings()
    return [
        f"The notebook has changed {name} ({value}); a service has it as it is by default ({default}). "
        "Change it inside the function that needs it, or set it back."
        for name, default in usual.library_settings.items()
        for value in [here.get(name, default)]
        if value != default
    ]


def _tolerate_noise(draft: Path, usual: ReplayReport, other: ReplayReport) -> bool:
    """Write tolerances if all that differs under other conditions is noise; return whether there is any.

    A clock or a counter is none: under usual conditions too it would have another value than in the notebook.
    """
    if not (usual.identical and other.differences) or not all(entry.is_noise for entry in other.differences):
        return False
    with optional_import():
        import tomlkit

    document = tomlkit.parse((draft / SETTINGS).read_text(encoding="utf-8"))
    known = read_tolerances(document.unwrap())
    found: dict[str, Tolerance] = {}
    for entry in other.differences:
        if entry.token != ANSWER:
            before = found.get(entry.token, known.get(entry.token))
            found[entry.token] = widened(before, entry.largest or 0.0, entry.relative)
    add_tolerances(document, found, "Another number of threads, or the like,")
    (draft / SETTINGS).write_text(tomlkit.dumps(document), encoding="utf-8")
    # They are compared to the last bit.
    shutil.rmtree(draft / ANSWERS, ignore_errors=True)
    return True


def _replayed(draft: Path, target: Path, scratch: Path, timeout_s: float, changed: Sequence[Condition]) -> ReplayReport:
    """Replay under usual conditions but for those that are changed; a failure is a difference of no token."""
    environment = usual_environment()
    for condition in changed:
        environment |= condition.environment
    cwd = scratch / ("there" if any(condition.is_folder for condition in changed) else "here")
    cwd.mkdir(exist_ok=True)
    options = ["--unsealed", "--twice", *(["--unwatched"] if changed else [])]
    try:
        return replay_isolated(draft, options, timeout_s=timeout_s, environment=environment, cwd=cwd)
    except BundleError as error:
        return ReplayReport(0, 0, (Difference(str(error).replace(str(draft.resolve()), str(target))),))


def _reasons(
    draft: Path,
    usual: ReplayReport,
    other: ReplayReport,
    replays: Callable[[Sequence[Sequence[Condition]]], Iterable[ReplayReport]],
) -> list[str]:
    """Return why a draft is refused: what differs or fails, and what changes it, found by one change at a time."""
    known = _texts(usual)
    files = [*usual.outside, *([] if usual.identical else named_here(draft))]
    if files or "" in known:
        return [*(_explained(entry, []) for entry in usual.differences), *files]
    found = {(entry.sample, entry.token): entry for entry in (*other.differences, *usual.differences)}
    causes = {token: [CALL] for token in (*usual.unsteady, *other.unsteady)}
    unexplained = {token for _, token in found} - causes.keys()
    if unexplained:
        conditions = other_conditions()
        reports = replays([(), *((condition,) for condition in conditions)])
        for condition, report in zip((PROCESS, *conditions), reports, strict=True):
            texts = _texts(report)
            for token in unexplained & ({""} if "" in texts else unexplained):
                # What another process alone changes differs under each condition too.
                if texts.get(token) != known.get(token) and PROCESS not in causes.setdefault(token, []):
                    causes[token].append(condition)
    reasons = [_explained(entry, causes.get(entry.token, [])) for entry in found.values()]
    return reasons if all(causes.get(token) for _, token in found) else [*reasons, _WHY]


def _texts(report: ReplayReport) -> dict[str, list[str]]:
    """Return what a replay found of each token that differs, "" for a failure."""
    texts: dict[str, list[str]] = {}
    for entry in report.differences:
        texts.setdefault(entry.token, []).append(str(entry))
    return texts


def _explained(entry: Difference, causes: Sequence[Condition]) -> str:
    """Return what differs, followed by what it depends on and the way out."""
    text = str(entry)
    names, ways = " and ".join(cause.name for cause in causes), " ".join(cause.way_out for cause in causes)
    return f"{text.rstrip('.')}. It depends on {names}, something that is not a token. {ways}" if names else text


def swap_folders(left: Path, right: Path) -> None:
    """Exchange two folders in one step, which Python has no call for; rename by rename where the system has none."""
    libc = ctypes.CDLL(None, use_errno=True)
    in_one = getattr(libc, "renameat2", None)
    if in_one and in_one(_AT_FDCWD, os.fsencode(left), _AT_FDCWD, os.fsencode(right), _RENAME_EXCHANGE) == 0:
        return
    aside = left.with_name("old")
    right.rename(aside)
    left.rename(right)
    aside.rename(left)
