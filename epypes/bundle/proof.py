"""The proof of a draft: replays under usual and other conditions; then it is sealed and swapped into its place."""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from epypes.bundle.adapters import ANSWER, ANSWERS
from epypes.bundle.compare import Difference, Tolerance
from epypes.bundle.conditions import CALL, PROCESS, Condition, other_conditions, usual_environment
from epypes.bundle.determinism import add_tolerances, read_tolerances, widened
from epypes.bundle.file_access import named_here
from epypes.bundle.load import SETTINGS
from epypes.bundle.manifest import write_manifest
from epypes.bundle.replay import REPLAY_TIMEOUT_S, ReplayReport, replay_isolated, run_isolated
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
    """Replay a draft in fresh isolated processes, write its requirements, seal it; return what the replay found.

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
        folders = _Folders(Path(scratch))
        jobs = [pool.submit(_replayed, draft, changed, folders, timeout_s) for changed in ((), conditions)]
        usual, other = (job.result() for job in jobs)
        if _tolerate_noise(draft, usual, other):
            other = _replayed(draft, conditions, folders, timeout_s)
        if isinstance(usual, ReplayReport) and usual.identical and usual.outside:
            raise PromotionRefused(target, usual.outside)
        if isinstance(usual, BundleError) or not (usual.identical and _is_identical(other)):
            raise PromotionRefused(target, _reasons(draft, target, usual, other, conditions, folders))
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in usual.requirements), encoding="utf-8")
    write_manifest(draft, usual.environment)
    return usual


def _tolerate_noise(draft: Path, usual: ReplayReport | BundleError, other: ReplayReport | BundleError) -> bool:
    """Write tolerances if all that differs under other conditions is noise; return whether there is any.

    A clock or a counter is none: under usual conditions too it would have another value than in the notebook.
    """
    if not (_is_identical(usual) and _differences(other)) or not all(entry.is_noise for entry in _differences(other)):
        return False
    with optional_import():
        import tomlkit

    document = tomlkit.parse((draft / SETTINGS).read_text(encoding="utf-8"))
    known = read_tolerances(document.unwrap())
    found: dict[str, Tolerance] = {}
    for entry in _differences(other):
        if entry.token != ANSWER:
            before = found.get(entry.token, known.get(entry.token))
            found[entry.token] = widened(before, entry.largest or 0.0, entry.relative)
    add_tolerances(document, found, "Another number of threads, or the like,")
    (draft / SETTINGS).write_text(tomlkit.dumps(document), encoding="utf-8")
    # They are compared to the last bit.
    shutil.rmtree(draft / ANSWERS, ignore_errors=True)
    return True


class _Folders:
    """The working folders of the replays: one is usual, one is the other."""

    def __init__(self, scratch: Path) -> None:
        self.scratch, self.usual, self.other = scratch, scratch / "here", scratch / "there"
        self.usual.mkdir()
        self.other.mkdir()


def _replayed(
    draft: Path, changed: Iterable[Condition], folders: _Folders, timeout_s: float
) -> ReplayReport | BundleError:
    """Replay under usual conditions but for those that are changed."""
    environment, cwd, is_usual = usual_environment(), folders.usual, True
    for condition in changed:
        environment |= condition.environment
        cwd, is_usual = folders.other if condition.is_folder else cwd, False
    try:
        return replay_isolated(
            draft, sealed=False, twice=True, timeout_s=timeout_s, environment=environment, cwd=cwd,
            watched=is_usual,
        )  # fmt: skip
    except BundleError as error:
        return error


def _reasons(
    draft: Path,
    target: Path,
    usual: ReplayReport | BundleError,
    other: ReplayReport | BundleError,
    conditions: tuple[Condition, ...],
    folders: _Folders,
) -> list[str]:
    """Return why a draft is refused: what differs or fails, and the condition that changes it."""
    if isinstance(usual, BundleError):
        return [_text_of(usual, draft, target), *named_here(draft)]
    if not usual.tokens:
        return [str(usual)]
    files = [*usual.outside, *named_here(draft)]
    if files and not usual.identical:
        return [*map(str, usual.differences), *files]
    found = {(entry.sample, entry.token): entry for entry in _differences(other)}
    found |= {(entry.sample, entry.token): entry for entry in usual.differences}
    unsteady = {*usual.unsteady, *(other.unsteady if isinstance(other, ReplayReport) else ())}
    tokens = {token for _, token in found} - unsteady
    causes: dict[str, list[Condition]] = {token: [CALL] for token in unsteady}
    failing: list[Condition] = []
    if tokens or isinstance(other, BundleError):
        failing = _find_causes(draft, conditions, folders, tokens, causes)
    reasons = [_explained(str(entry), causes.get(entry.token, [])) for entry in found.values()]
    if isinstance(other, BundleError):
        reasons.append(_explained(_text_of(other, draft, target), failing or [*conditions]))
    return reasons if all(entry.token in causes for entry in found.values()) else [*reasons, _WHY]


def _is_identical(report: ReplayReport | BundleError) -> bool:
    return isinstance(report, ReplayReport) and report.identical


def _differences(report: ReplayReport | BundleError) -> tuple[Difference, ...]:
    return report.differences if isinstance(report, ReplayReport) else ()


def _text_of(error: BundleError, draft: Path, target: Path) -> str:
    return str(error).replace(str(draft.resolve()), str(target))


def _explained(text: str, causes: Iterable[Condition]) -> str:
    """Return what differs, followed by what it depends on and the way out."""
    names, ways = " and ".join(cause.name for cause in causes), " ".join(cause.way_out for cause in causes)
    return f"{text.rstrip('.')}. It depends on {names}, something that is not a token. {ways}" if names else text


def _find_causes(
    draft: Path,
    conditions: tuple[Condition, ...],
    folders: _Folders,
    tokens: set[str],
    causes: dict[str, list[Condition]],
) -> list[Condition]:
    """Add the conditions that change a token, found by changing one at a time; return those under which it fails.

    The samples are recorded anew under usual conditions, since those of the notebook are not known.
    """
    again = folders.scratch / "again" / draft.name
    shutil.copytree(draft, again)
    try:
        run_isolated(again, ["--record"], environment=usual_environment(), cwd=folders.usual)
    except BundleError:
        return []
    changes: list[tuple[Condition, ...]] = [(), *((condition,) for condition in conditions)]
    failing = []
    with ThreadPoolExecutor(_PROCESSES) as pool:
        reports = [*pool.map(lambda changed: _replayed(again, changed, folders, REPLAY_TIMEOUT_S), changes)]
    for changed, report in zip(changes, reports, strict=True):
        condition = changed[0] if changed else PROCESS
        if isinstance(report, BundleError):
            failing.append(condition)
        for token in tokens & {entry.token for entry in _differences(report)}:
            if PROCESS not in causes.setdefault(token, []):
                causes[token].append(condition)
    return failing


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
