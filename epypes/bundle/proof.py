"""The proof of a draft: replays under usual and other conditions; then it is swapped into its place.

Two processes replay at the same time, each every sample twice. One of them has the usual conditions, in the other all
of them are others: what the surroundings of a process may change, and nothing that a bundle computes. Where a token
differs, replays with one other condition each find the one that changes it. Floats that differ by noise alone get a
tolerance.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

from epypes.bundle.adapters import ANSWER
from epypes.bundle.compare import Difference, add_tolerances
from epypes.bundle.determinism import (
    CALL,
    PROCESS,
    UNKNOWN,
    Condition,
    library_settings,
    named_here,
    other_conditions,
    usual_environment,
)
from epypes.bundle.load import MODULE, SAMPLES, SETTINGS
from epypes.bundle.manifest import write_manifest
from epypes.bundle.replay import REPLAY_TIMEOUT_S, ReplayReport, replay_isolated
from epypes.bundle.requirements import REQUIREMENTS
from epypes.bundle.settings import read_settings
from epypes.errors import BundleError, PromotionRefused
from epypes.optional import optional_import
from epypes.wire.samples import load_sample, save_sample

# From Linux's fcntl.h and fs.h.
_AT_FDCWD: Final = -100
_RENAME_EXCHANGE: Final = 2
# As many as a replay of the usual and one of the other conditions.
_PROCESSES: Final = 2
# What the names of folders end with in which drafts are.
_DRAFTS: Final = ".epypes-draft"


def prove(draft: Path, target: Path, timeout_s: float = REPLAY_TIMEOUT_S) -> ReplayReport:
    """Replay a draft in fresh isolated processes, and write its tolerances, its requirements and its manifest.

    An answer of f_out that is another one at each call, such as one with times, is not compared from then on.

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
    conditions = other_conditions(draft / MODULE)
    with tempfile.TemporaryDirectory(prefix="epypes-proof-") as scratch, ThreadPoolExecutor(_PROCESSES) as pool:
        replays = partial(pool.map, partial(_replayed, draft, target, Path(scratch), timeout_s))
        usual, other = replays([(), conditions])
        found = [*other.differences, *usual.differences]
        found += [
            Difference(f"What function {name!r} refers to is another one in another process.", token=_function(name))
            for name, fingerprint in other.fingerprints.items()
            if usual.fingerprints.get(name, fingerprint) != fingerprint
        ]
        # What is the same in each run of a process, and not what the notebook computed, is not what threads make.
        refused = {entry.token for entry in usual.differences if not entry.function}
        refused |= {
            entry.token for entry in found if not entry.is_noise and (entry.token, entry.function) != (ANSWER, "f_out")
        }
        reasons = _changed_settings(usual)
        if refused or usual.outside or not usual.tokens:
            reasons += _own_reasons(draft, usual, refused)
            reasons = reasons or _reasons(found, refused, usual, conditions, replays) or [str(usual)]
        if reasons:
            raise PromotionRefused(target, reasons)
    if found:
        _tolerate(draft, [entry for entry in found if entry.token != ANSWER])
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in usual.requirements), encoding="utf-8")
    write_manifest(draft, usual.environment)
    return usual


def _replayed(draft: Path, target: Path, scratch: Path, timeout_s: float, changed: Sequence[Condition]) -> ReplayReport:
    """Replay under usual conditions but for those that are changed; a failure is a difference of no token."""
    variables: dict[str, str | None] = {**usual_environment()}
    for condition in changed:
        variables |= condition.environment
    environment = {name: value for name, value in variables.items() if value is not None}
    cwd = scratch / ("there" if any(condition.is_folder for condition in changed) else "here")
    cwd.mkdir(exist_ok=True)
    try:
        return replay_isolated(draft, timeout_s=timeout_s, environment=environment, cwd=cwd)
    except BundleError as error:
        return ReplayReport(0, 0, (Difference(str(error).replace(str(draft.resolve()), str(target))),))


def _changed_settings(usual: ReplayReport) -> list[str]:
    """Return how this process has set libraries that are set otherwise in a fresh one, as reasons."""
    here = library_settings()
    return [
        f"The notebook has changed {name} ({here[name]}); a service has it as it is by default ({default}). "
        "Change it inside the function that needs it, or set it back."
        for name, default in usual.library_settings.items()
        if here.get(name, default) != default
    ]


def _own_reasons(draft: Path, usual: ReplayReport, refused: Collection[str]) -> list[str]:
    """Return why a draft is refused whatever the conditions are: it fails, or reads files outside of it."""
    differs = any(entry.token in refused for entry in usual.differences)
    files = [*usual.outside, *(named_here(draft) if differs else [])]
    is_failed = any(not entry.token for entry in usual.differences)
    return [*map(str, usual.differences), *files] if files or is_failed else []


def _reasons(
    found: Iterable[Difference],
    refused: Collection[str],
    usual: ReplayReport,
    conditions: Sequence[Condition],
    replays: Callable[[Sequence[Sequence[Condition]]], Iterable[ReplayReport]],
) -> list[str]:
    """Return what differs of the tokens that are refused, and what changes it, found by one change at a time."""
    named = {(entry.sample, entry.token): entry for entry in found if entry.token in refused}
    causes = {entry.token: [CALL] for entry in named.values() if entry.function}
    unexplained = refused - causes.keys()
    if unexplained:
        known = _findings(usual)
        reports = replays([(), *((condition,) for condition in conditions)])
        for condition, report in zip((PROCESS, *conditions), reports, strict=True):
            findings = _findings(report)
            for token in {""} if "" in findings else unexplained:
                # What another process alone changes differs under each condition too.
                if findings.get(token) != known.get(token) and PROCESS not in causes.setdefault(token, []):
                    causes[token].append(condition)
    return [_explained(entry, causes.get(entry.token) or [UNKNOWN]) for entry in named.values()]


def _findings(report: ReplayReport) -> dict[str, list[str]]:
    """Return what a replay found of each token that differs, "" for a failure; and the fingerprints of functions."""
    found = {_function(name): [fingerprint] for name, fingerprint in report.fingerprints.items()}
    for entry in report.differences:
        found.setdefault(entry.token, []).append(str(entry))
    return found


def _function(name: str) -> str:
    """Return what stands for a function where otherwise a token does."""
    return f"function {name}"


def _explained(entry: Difference, causes: Sequence[Condition]) -> str:
    """Return what differs, followed by what it depends on and the way out."""
    names = " and ".join(cause.name.format(function=entry.function) for cause in causes)
    ways = " ".join(cause.way_out for cause in causes)
    return f"{str(entry).rstrip('.')}. It depends on {names}, something that is not a token. {ways}"


def _tolerate(draft: Path, noise: Sequence[Difference]) -> None:
    """Write tolerances, and leave the answers of f_out out of the samples: they may be bytes, which have none."""
    with optional_import():
        import tomlkit

    document = tomlkit.parse((draft / SETTINGS).read_text(encoding="utf-8"))
    add_tolerances(document, noise)
    (draft / SETTINGS).write_text(tomlkit.dumps(document), encoding="utf-8")
    rgb = read_settings(draft / SETTINGS).rgb
    for path in (draft / SAMPLES).glob("*.npz"):
        inputs, outputs = load_sample(path)
        if outputs.pop(ANSWER, None) is not None:
            save_sample(path, inputs, outputs, rgb=rgb)


# -- drafts ----------------------------------------------------------------------------------------------------------


@contextmanager
def draft_folder(target: Path) -> Iterator[Path]:
    """Give the path of a draft beside its target, where the two can be swapped; it is deleted in the end.

    A process that was killed leaves its draft there. The next one to the same target deletes it, once its own is done:
    a folder in use is locked, and the lock ends with the process.
    """
    prefix = f".{target.name[:40]}-"
    with tempfile.TemporaryDirectory(prefix=prefix, suffix=_DRAFTS, dir=target.parent) as scratch, _locked(scratch):
        yield Path(scratch) / target.name
        for folder in target.parent.glob(f".*{_DRAFTS}"):
            # What another process has not locked yet is empty.
            if folder.name.startswith(prefix) and any(folder.iterdir()):
                with _locked(folder) as is_ours:
                    if is_ours:
                        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: str | Path) -> Iterator[bool]:
    """Lock a folder until this process ends, at the latest; give whether that was possible."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_locked = True
    except OSError:  # another process has it, or the file system has no locks
        is_locked = False
    try:
        yield is_locked
    finally:
        os.close(descriptor)


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
