"""The proof of a draft: replays under usual and other conditions; then it is swapped into its place.

Two processes replay at the same time, each every sample twice. One of them has the usual conditions, in the other all
of them are others: what the surroundings of a process may change, and nothing that a bundle computes. Where a token
differs, replays with one other condition each find the one that changes it. Floats that differ by noise alone get a
tolerance.
"""

from __future__ import annotations

import ast
import ctypes
import fcntl
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Final

from epypes.bundle.adapters import ANSWER
from epypes.bundle.compare import Difference, add_tolerances
from epypes.bundle.file_access import named_here
from epypes.bundle.load import MODULE, SAMPLES, SETTINGS
from epypes.bundle.manifest import write_manifest
from epypes.bundle.replay import REPLAY_TIMEOUT_S, ReplayReport, library_settings, replay_isolated, without_python
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
_VARIABLE: Final = re.compile(r"[A-Z][A-Z0-9_]*")
_THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",  # what cv2.setNumThreads would set
)


@dataclass(frozen=True, slots=True)
class Condition:
    """One thing about the surroundings of a process.

    Attributes
    ----------
    name
        What a result depends on: "the hash seed (PYTHONHASHSEED)".
    way_out
        What to change in the function, as a sentence.
    environment
        The variables of the environment under the other condition; None for one that is not there.
    is_folder
        Whether it is the working folder.
    """

    name: str
    way_out: str
    environment: Mapping[str, str | None]
    is_folder: bool = False


CALL: Final = Condition(
    "when, how often and in which order function {function!r} is called",
    "Pass a seed as a token and make the random generator of it, as in np.random.default_rng(seed), or call "
    "cv2.setRNGSeed(seed) inside the function. Pass a time, and what it remembers from call to call, as tokens. Round "
    "noise of threads away before it decides anything.",
    {},
)
PROCESS: Final = Condition(
    "the process that computes it",
    "It may use random numbers, the time, the process id or an address in memory. Pass it in as a token.",
    {},
)
UNKNOWN: Final = Condition(
    "what only the notebook has, or on several conditions at once",
    "If an array was written into after the run, run the graph again. A file, the current folder, or what a function "
    "remembers is to be a token.",
    {},
)


def other_conditions(module: Path) -> tuple[Condition, ...]:
    """Return the conditions that a second process has otherwise than this one and its children.

    Variables of the environment that a module names as texts are not there, or "1" if they are not here. The others
    are as they are here: libraries need them.
    """
    count = "1" if _threads() != 1 else "3"
    texts = (node.value for node in ast.walk(ast.parse(module.read_bytes())) if isinstance(node, ast.Constant))
    named = {text for text in texts if isinstance(text, str) and _VARIABLE.fullmatch(text)}
    return (
        Condition(
            "the variables of the environment",
            "Read them in the notebook, and make what is read a token.",
            {"EPYPES_PROOF": "1", **{name: None if name in os.environ else "1" for name in sorted(named)}},
        ),
        Condition(
            "the hash seed (PYTHONHASHSEED)",
            "The order of a set of strings is another one in each process: sort it, as in sorted(names).",
            {"PYTHONHASHSEED": "12345"},
        ),
        Condition(
            "the working folder",
            "Pass the folder in as a token, or use absolute paths of what is installed.",
            {},
            is_folder=True,
        ),
        Condition(
            "the time zone (TZ)",
            "Use UTC: datetime.now(UTC), time.gmtime().",
            {"TZ": "<+1337>-13:37"},
        ),
        Condition(
            "the locale (LC_ALL)",
            "Format and parse without locale.setlocale(), as f-strings and float() do.",
            {"LC_ALL": _another_locale()},
        ),
        Condition(
            "the number of threads (OMP_NUM_THREADS, cv2.setNumThreads)",
            "Compute it in one thread, or round the noise away before it decides anything.",
            dict.fromkeys(_THREAD_VARIABLES, count),
        ),
    )


def usual_environment() -> dict[str, str]:
    """Return the environment of a replay under usual conditions: this one, without what changes Python itself."""
    return {**without_python(), "PYTHONHASHSEED": "0"}


def _threads() -> int:
    given = next((os.environ[name] for name in _THREAD_VARIABLES if os.environ.get(name, "").isdigit()), "")
    return int(given) if given else os.cpu_count() or 1


@cache
def _another_locale() -> str:
    """Return an installed locale that writes numbers and dates otherwise than this one, as far as there is one."""
    try:
        done = subprocess.run(["locale", "-a"], capture_output=True, timeout=10, check=False)  # noqa: S607
        installed = done.stdout.decode(errors="replace").split()
    except (OSError, subprocess.TimeoutExpired):
        installed = []
    now = next((os.environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if os.environ.get(name)), "C")
    plain = "C.UTF-8" if now in ("C", "POSIX") else "C"
    others = (name for name in installed if not name.startswith(("C", "POSIX", "en", now[:2])))
    return next(others, plain)


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
        replayed = partial(_replayed, draft, target, Path(scratch), timeout_s)
        usual, other = pool.map(replayed, [(), conditions])
        other = _compared(other, usual)
        found = [*usual.differences, *other.differences]
        # What is the same in each run of a process, and not what the notebook computed, is not what threads make.
        refused = {entry.token for entry in usual.differences if not entry.function}
        refused |= {
            entry.token for entry in found if not entry.is_noise and (entry.token, entry.function) != (ANSWER, "f_out")
        }
        changed = _changed_settings(usual)
        if changed or usual.outside or refused or not usual.tokens:
            reasons = _reasons(draft, usual, other, refused, partial(pool.map, replayed))
            raise PromotionRefused(target, [*changed, *reasons])
    if found:
        _tolerate(draft, [entry for entry in found if entry.token != ANSWER])
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in usual.requirements), encoding="utf-8")
    write_manifest(draft, usual.environment)
    return usual


def _compared(report: ReplayReport, usual: ReplayReport) -> ReplayReport:
    """Return a report with the functions that are another one than in the usual replay, as differences."""
    found = [
        Difference(f"What function {name!r} refers to is another one in another process.", token=f"function {name}")
        for name, fingerprint in report.fingerprints.items()
        if usual.fingerprints.get(name, fingerprint) != fingerprint
    ]
    return replace(report, differences=(*report.differences, *found))


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


def _reasons(
    draft: Path,
    usual: ReplayReport,
    other: ReplayReport,
    refused: Collection[str],
    replays: Callable[[Sequence[Sequence[Condition]]], Iterable[ReplayReport]],
) -> list[str]:
    """Return why a draft is refused: what differs or fails, and what changes it, found by one change at a time."""
    known = _texts(usual)
    files = [*usual.outside, *(named_here(draft) if refused & known.keys() else [])]
    if files or "" in known:
        return [*map(str, usual.differences), *files]
    found = {(e.sample, e.token): e for e in (*other.differences, *usual.differences) if e.token in refused}
    causes = {entry.token: [CALL] for entry in found.values() if entry.function}
    unexplained = refused - causes.keys()
    if unexplained:
        conditions = other_conditions(draft / MODULE)
        reports = replays([(), *((condition,) for condition in conditions)])
        for condition, report in zip((PROCESS, *conditions), reports, strict=True):
            texts = _texts(_compared(report, usual))
            for token in unexplained & ({""} if "" in texts else unexplained):
                # What another process alone changes differs under each condition too.
                if texts.get(token) != known.get(token) and PROCESS not in causes.setdefault(token, []):
                    causes[token].append(condition)
    return [_explained(entry, causes.get(entry.token) or [UNKNOWN]) for entry in found.values()]


def _texts(report: ReplayReport) -> dict[str, list[str]]:
    """Return what a replay found of each token that differs, "" for a failure."""
    texts: dict[str, list[str]] = {}
    for entry in report.differences:
        texts.setdefault(entry.token, []).append(str(entry))
    return texts


def _explained(entry: Difference, causes: Sequence[Condition]) -> str:
    """Return what differs, followed by what it depends on and the way out."""
    names = " and ".join(cause.name.format(function=entry.function) for cause in causes)
    ways = " ".join(cause.way_out for cause in causes)
    return f"{str(entry).rstrip('.')}. It depends on {names}, something that is not a token. {ways}"


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
                with _locked(folder, wait=False) as is_ours:
                    if is_ours:
                        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: str | Path, *, wait: bool = True) -> Iterator[bool]:
    """Lock a folder until this process ends, at the latest; give whether that was possible."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
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
