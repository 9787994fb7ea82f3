"""The proof of a draft: replays under usual and other conditions, and what the differences between them mean.

Two processes replay at the same time, each every sample twice. One of them has the usual conditions, in the other all
of them are others: what the surroundings of a process may change, and nothing that a bundle computes. Where a token
differs, replays with one other condition each find the one that changes it. Floats that differ by noise alone get a
tolerance. Both processes also describe how libraries are set and what they hold: what this process has otherwise, the
notebook has changed, and it is refused also where no sample shows it.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Final

from epypes.bundle.adapters import ANSWER
from epypes.bundle.manifest import REQUIREMENTS, SAMPLES, SETTINGS, code_of, write_manifest
from epypes.bundle.proof.compare import Difference, add_tolerances
from epypes.bundle.proof.file_access import named_here
from epypes.bundle.proof.libraries import attributes_of, changed_attributes
from epypes.bundle.proof.process_settings import OPERATING_SYSTEM, WARNINGS, is_of_texts, library_settings
from epypes.bundle.proof.replay import ReplayReport
from epypes.bundle.proof.replay_process import REPLAY_TIMEOUT_S, replay_isolated, without_python
from epypes.bundle.settings import read_settings
from epypes.bundle.source.side_effects import environment_changed, places_of_change, seeds_in_notebook
from epypes.errors import BundleError, PromotionRefused
from epypes.optional import optional_import
from epypes.wire.samples import read_sample, save_sample

# As many as a replay of the usual and one of the other conditions.
_PROCESSES: Final = 2
# OpenCV reads the last one as what cv2.setNumThreads would set.
_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_MOST_NAMED: Final = 12
# What a description ends with whose content is too long.
_DIGEST: Final = re.compile(r" [0-9a-f]{16}\b.*")
_VARIABLE: Final = re.compile(r"[A-Z][A-Z0-9_]*")


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
    environment: Mapping[str, str | None] = field(default_factory=dict)
    is_folder: bool = False


CALL: Final = Condition(
    "when, how often and in which order function {function!r} is called",
    "Pass a seed as a token and make the random generator of it, as in np.random.default_rng(seed), or call "
    "cv2.setRNGSeed(seed) inside the function. Pass a time as a token. What it remembers from call to call is state of "
    'the graph: cg = ep.delay(cg, "seen", "seen_before"). Round noise of threads away before it decides anything.',
)
PROCESS: Final = Condition(
    "the process that computes it",
    "It may use random numbers, the time, the process id or an address in memory. Pass it in as a token.",
)
UNKNOWN: Final = Condition(
    "what only the notebook has, or on several conditions at once",
    "If an array was written into after the run, run the graph again. Pass a file or the current folder as a token. "
    'What a function remembers is state of the graph: cg = ep.delay(cg, "seen", "seen_before").',
)


def other_conditions(bundle: Path) -> tuple[Condition, ...]:
    """Return the conditions that a second process has otherwise than this one and its children.

    Variables of the environment that a bundle's code names as texts are not there, or "1" if they are not here. The
    others are as they are here: libraries need them.
    """
    texts = (node.value for node in ast.walk(ast.parse(code_of(bundle))) if isinstance(node, ast.Constant))
    named = {text for text in texts if isinstance(text, str) and _VARIABLE.fullmatch(text)}
    usual = str(len(os.sched_getaffinity(0)))
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
            {name: "3" if os.environ.get(name, usual) == "1" else "1" for name in _THREADS},
        ),
    )


@cache
def _another_locale() -> str:
    """Return an installed locale that writes numbers and dates otherwise than this one, as far as there is one."""
    try:
        done = subprocess.run(["locale", "-a"], capture_output=True, timeout=10, check=False)  # noqa: S607
        installed = done.stdout.decode(errors="replace").split()
    except (OSError, subprocess.TimeoutExpired):
        installed = []
    now = next((os.environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if os.environ.get(name)), "C")
    others = (name for name in installed if not name.startswith(("C", "POSIX", "en", now[:2])))
    return next(others, "C.UTF-8" if now in ("C", "POSIX") else "C")


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
    conditions = other_conditions(draft)
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
        places, calls = places_of_change()
        settings = _changed_settings(usual, draft, places, calls)
        words = {getattr(node, "attr", getattr(node, "id", "")) for node in ast.walk(ast.parse(code_of(draft)))}
        notes = [reason for name, reason in settings.items() if is_of_texts(name, words)]
        reasons = [reason for name, reason in settings.items() if not is_of_texts(name, words)]
        unseeded = [*_unseeded(usual)]
        reasons += [
            *_changed_libraries(usual, other, draft, places, calls),
            *(text for text, is_refused in unseeded if is_refused),
        ]
        notes += [text for text, is_refused in unseeded if not is_refused]
        if refused or usual.outside or not usual.tokens:
            own = _own_reasons(draft, usual, refused)
            reasons += own or _reasons(found, refused, usual, conditions, replays) or [str(usual)]
            place = environment_changed()
            reasons += [f"The notebook has changed the environment ({place}); a service has its own."] if place else []
        if reasons:
            raise PromotionRefused(target, [*reasons, *notes])
    if found:
        _tolerate(draft, [entry for entry in found if entry.token != ANSWER])
    (draft / REQUIREMENTS).write_text("".join(f"{line}\n" for line in usual.requirements), encoding="utf-8")
    write_manifest(draft, usual.environment)
    return replace(usual, notes=[*usual.notes, *notes, *named_here(draft)])


def _replayed(draft: Path, target: Path, scratch: Path, timeout_s: float, changed: Sequence[Condition]) -> ReplayReport:
    """Replay under usual conditions but for those that are changed; a failure is a difference of no token."""
    variables: dict[str, str | None] = {**_environment_of_service(), "PYTHONHASHSEED": "0"}
    for condition in changed:
        variables |= condition.environment
    environment = {name: value for name, value in variables.items() if value is not None}
    cwd = scratch / ("there" if any(condition.is_folder for condition in changed) else "here")
    cwd.mkdir(exist_ok=True)
    try:
        return replay_isolated(draft, with_libraries=True, timeout_s=timeout_s, environment=environment, cwd=cwd)
    except BundleError as error:
        return ReplayReport(0, 0, (Difference(str(error).replace(str(draft.resolve()), str(target))),))


def _environment_of_service() -> dict[str, str]:
    """Return the environment without Python's variables; where cells have changed it, as this process has begun."""
    variables, began = without_python(), Path("/proc/self/environ")
    if environment_changed() and began.is_file():
        pairs = (entry.partition("=") for entry in os.fsdecode(began.read_bytes()).split("\0") if entry)
        variables = {name: value for name, _, value in pairs if not name.startswith("PYTHON")}
    return variables


def _changed_settings(
    usual: ReplayReport, bundle: Path, places: Mapping[str, str], calls: Mapping[str, str]
) -> dict[str, str]:
    """Return by name what this process has set in libraries that is set otherwise in a fresh one, as sentences."""
    here, nodes = library_settings(), [*ast.walk(ast.parse(code_of(bundle)))]
    catches = any(isinstance(node, ast.ExceptHandler) or getattr(node, "attr", "") == "suppress" for node in nodes)
    found: dict[str, str] = {}
    for name, default in usual.library_settings.items():
        value = here.get(name, default)
        if value != default and (name != WARNINGS or catches):
            setting, _, option = name.partition(" ")
            place = places.get(option.rpartition(".")[2]) if option else calls.get(setting.rpartition(".")[2])
            here_is = ", ".join(filter(None, (place, value)))
            found[name] = (
                f"The notebook has changed {name} ({here_is}); a service has it as it is by default "
                f"({default or 'not set'}). Change it inside the function that needs it, or set it back."
            )
    return found


def _changed_libraries(
    usual: ReplayReport, other: ReplayReport, bundle: Path, places: Mapping[str, str], calls: Mapping[str, str]
) -> list[str]:
    """Return what this process has changed in the libraries of a bundle, as sentences."""
    # What two fresh processes have otherwise depends on the process, and is no change.
    fresh = {
        library: {name: value for name, value in described.items() if others.get(name, value) == value}
        for library, described in usual.libraries.items()
        if (others := other.libraries.get(library, described)) is not None
    }
    changed = changed_attributes(attributes_of(fresh), fresh, code_of(bundle), places, calls.keys())
    # One change is found wherever a library has the object; the shortest of these names is the best known.
    distinct: dict[tuple[str, str, str], str] = {}
    for (library, name), both in sorted(changed.items(), key=lambda item: len(item[0][0])):
        distinct.setdefault((name, *both), library)
    found = []
    for (name, value, default), library in distinct.items():
        here, there = (_DIGEST.sub("", text) for text in (value, default or "it is not there"))
        registering = (calls[one] for one in calls if name.endswith("]") and one in vars(sys.modules[library]))
        place = places.get(name.rpartition(".")[2]) or next(registering, None)
        here = ", ".join(filter(None, (place, here if here != there else "in its code or defaults")))
        found.append(
            f"The notebook has changed {library}.{name} ({here}); a service has it as it was installed ({there}). "
            "Undo that; call yours by a name of its own, or make the value a token."
        )
    return found[:_MOST_NAMED]


def _unseeded(usual: ReplayReport) -> Iterator[tuple[str, bool]]:
    """Give which functions draw random numbers without a seed, as sentences, each with whether that is refused.

    It is where a cell or another function seeds the generator: in a service, that doesn't decide what is drawn.
    """
    seeded = {home: f"the notebook seeds ({place})" for home, place in seeds_in_notebook().items()}
    seeded |= {home: f"function {name!r} seeds" for name, seeds in usual.seeds.items() for home in seeds}
    for name, draws in usual.draws.items():
        for home, draw in draws.items():
            text = f"Function {name!r} draws by {draw!r} from the random generator of {home}"
            way_out = f"Seed it in {name!r}, or draw from np.random.default_rng(seed)."
            if home in seeded:
                yield (
                    f"{text}, which {seeded[home]}; in a service, other events draw from it in between. {way_out}",
                    True,
                )
            elif home == OPERATING_SYSTEM:
                yield f"{text}: each answer is another one. Give it a seed.", False
            else:
                yield f"{text}, which nothing seeds: a service draws the same in each event. {way_out}", False


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
        sample = read_sample(path)
        if sample.outputs.pop(ANSWER, None) is not None:
            save_sample(path, **sample._asdict(), rgb=rgb)
