"""The replay of a bundle in a process of its own, fresh and isolated, and the verification that stands on it.

Run as a program (``python -s -P -m epypes.bundle.proof.replay_process FOLDER REPORT``) it is that process. With
``--record`` it records the samples anew instead.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import json
import os
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

from epypes.bundle.load import MODULES_OF_A_BUNDLE, WITH_DELAYS, Bundle, read_bundle
from epypes.bundle.manifest import (
    REQUIREMENTS,
    SAMPLES,
    check_manifest,
    code_of,
    environment_differences,
    module_files,
    own_packages,
    recorded_environment,
)
from epypes.bundle.proof.code_snapshot import CodeSnapshot
from epypes.bundle.proof.compare import Difference, differences
from epypes.bundle.proof.file_access import FileAccess
from epypes.bundle.proof.fingerprint import Digester
from epypes.bundle.proof.libraries import library_attributes
from epypes.bundle.proof.process_settings import GlobalGenerators, library_settings
from epypes.bundle.proof.replay import ReplayReport, record_again, replay
from epypes.bundle.requirements import fresh_environment, imported_names, pins, read_pins, requirement_lines
from epypes.bundle.source.resolve import evaluated
from epypes.errors import BundleChanged, BundleError, EpypesError, ReplayDiffers
from epypes.run.guard import as_written
from epypes.wire.samples import read_sample
from epypes.wording import error_message

_PROGRAM: Final = "epypes.bundle.proof.replay_process"
REPLAY_TIMEOUT_S: Final = 600.0
_MOST_NAMED: Final = 8
_UNSTEADY: Final = (
    "The values of {} differ from run to run in one process, too: random numbers without a seed, a counter, or a clock."
)
_UNKNOWN: Final = (
    "Neither the bundle nor what it runs on has changed as far as is known: a function may depend on something that is "
    "not a token, such as a file, the current folder, or what was installed beside its package."
)
_TOO_LONG: Final = (
    "Each sample is run twice: give fewer or smaller samples, or look for a function that waits for what only the "
    "notebook has, such as a window, a camera or a lock."
)
_DIED: Final = (
    "Memory has run out, or a library has crashed: run the functions in a new process, and give smaller samples if "
    "memory has."
)


def replay_isolated(
    folder: Path,
    *,
    record: bool = False,
    with_libraries: bool = False,
    timeout_s: float = REPLAY_TIMEOUT_S,
    python: str = sys.executable,
    environment: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> ReplayReport:
    """Replay every sample twice in a new interpreter that has neither the current folder nor Python's variables.

    The manifest is not compared: that is the caller's part.

    Parameters
    ----------
    folder
        The bundle.
    record
        Whether the samples are recorded anew, and nothing is compared.
    with_libraries
        Whether the report says what the modules of libraries hold.
    timeout_s
        When the process is ended.
    python
        The interpreter, this one without.
    environment, cwd
        The variables and the working folder of the process; the usual ones and a new folder without.

    Raises
    ------
    BundleError
        The process failed, took longer than ``timeout_s``, or has written an error.
    """
    options = [*(["--record"] if record else []), *(["--libraries"] if with_libraries else [])]
    with tempfile.TemporaryDirectory(prefix="epypes-replay-") as scratch:
        out = Path(scratch) / "report.json"
        try:
            # Isolated as by -I, which would also have it overlook PYTHONHASHSEED.
            done = subprocess.run(  # noqa: S603 - an interpreter, a module of ours
                [python, "-s", "-P", "-m", _PROGRAM, str(folder.resolve()), str(out), *options],
                cwd=cwd or scratch,
                env=without_python() if environment is None else environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            text = f"The replay of {folder} did not end within {timeout_s:g} s. {_TOO_LONG}"
            raise BundleError(folder, text) from error
        if not out.is_file():
            ending = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            text = f"The replay of {folder} died with status {done.returncode}: {ending[0].rstrip('.')}. {_DIED}"
            raise BundleError(folder, text)
        outcome = json.loads(out.read_text(encoding="utf-8"))
    if "error" in outcome:
        raise BundleError(folder, outcome["error"])
    found = tuple(Difference(**entry) for entry in outcome.pop("differences"))
    return ReplayReport(differences=found, **outcome)


def without_python() -> dict[str, str]:
    """Return the environment without the variables that Python reads."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def main(arguments: Sequence[str]) -> int:
    """Replay the bundle in the folder that is named first; write the outcome as JSON to the file named second."""
    folder, out = Path(arguments[0]), Path(arguments[1])
    GlobalGenerators.are_put_back = False
    try:
        if "--record" in arguments:
            report = record_again(read_bundle(folder, compare=False))
        else:
            report = _watched(folder, with_libraries="--libraries" in arguments)
        outcome = asdict(report)
    except EpypesError as error:
        cause = error.__cause__
        outcome = {"error": _describe(cause, folder) if isinstance(cause, ImportError) else str(error)}
    except BaseException as error:
        outcome = {"error": _describe(error, folder)}
    out.write_text(json.dumps(outcome), encoding="utf-8")
    return 0


def _watched(folder: Path, *, with_libraries: bool) -> ReplayReport:
    """Replay, and report what was imported, which files were opened, and which lines did not run."""
    text, own = code_of(folder), own_packages(folder)
    for path in sorted((folder / SAMPLES).glob("*.npz")):
        # What reading a sample needs is loaded now, so that it is not taken for what the bundle needs.
        with contextlib.suppress(EpypesError):
            sample = read_sample(path)
            list(differences(sample, sample))
    before = frozenset(sys.modules)
    access, ran = FileAccess(folder), trace_lines(folder)
    bundle = read_bundle(folder, compare=False)
    access.note_names(bundle.settings.hyperparameters)
    fingerprints, named = _fingerprints(bundle), imported_names(text, own)
    report = replay(bundle, twice=True, on_run=access.begin_run)
    sys.settrace(None)
    new = sys.modules.keys() - before
    if with_libraries:
        _load_named(text, own)
    random = {name: CodeSnapshot({name: function}, {}, lock=False) for name, function in bundle.cg.functions.items()}
    return replace(
        report,
        outside=access.files,
        requirements=requirement_lines(named | new),
        libraries=library_attributes(named, new) if with_libraries else {},
        notes=_unproved_lines(ran, folder),
        library_settings=library_settings(),
        fingerprints=fingerprints,
        draws={
            name: {home: draw for draw, home in one.draws.items() if home not in one.seeds}
            for name, one in random.items()
        },
        seeds={name: sorted(one.seeds) for name, one in random.items()},
    )


def _load_named(text: str, own: Collection[str]) -> None:
    """Load what a bundle names of libraries that load their parts when these are first asked for; none of its own."""
    nodes, names = [*ast.walk(ast.parse(text))], {**sys.modules}
    for node in nodes:
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        for alias in node.names:
            home = alias.name if isinstance(node, ast.Import) else "." * node.level + (node.module or "")
            if home.partition(".")[0] in {"", *own}:
                continue
            with contextlib.suppress(Exception):  # whatever a module raises that no sample has imported
                if isinstance(node, ast.ImportFrom):
                    source = importlib.import_module(node.module or "")
                    names[alias.asname or alias.name] = getattr(source, alias.name)
                else:
                    names[alias.asname or alias.name] = importlib.import_module(alias.name)
    for node in nodes:
        if isinstance(node, ast.Attribute):
            with contextlib.suppress(Exception):
                evaluated(node, names)


def _fingerprints(bundle: Bundle) -> dict[str, str]:
    found: dict[str, str] = {}
    initial = {WITH_DELAYS: [delay.initial for delay in bundle.cg.delays.values()]}
    for name, value in {**bundle.cg.functions, **bundle.own, **initial}.items():
        digester = Digester()
        digester.add(as_written(value))
        found[name] = digester.digest().hex()
    return found


def _describe(error: BaseException, folder: Path) -> str:
    """Describe what failed in the bundle's own code, with its last line there."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = (
        f" at {Path(frames[-1].filename).relative_to(folder).as_posix()}, line {frames[-1].lineno}: {frames[-1].line}"
        if frames
        else ""
    )
    notes = "; ".join(" ".join(note.split()) for note in getattr(error, "__notes__", ()))
    text = f"The replay of {folder} failed{where}: {type(error).__name__}: {' '.join(error_message(error).split())}"
    if isinstance(error, ModuleNotFoundError):
        text += f". {MODULES_OF_A_BUNDLE}"
    elif isinstance(error, FileNotFoundError) and not os.path.isabs(os.fsdecode(error.filename or os.sep)):
        text += ". A replay runs in another working folder than the notebook"
    return f"{text} ({notes})" if notes else text


def trace_lines(folder: Path) -> dict[CodeType, set[int]]:
    """Note from now on which lines of a bundle's functions run, in this thread and in those that begin later."""
    files, ran = frozenset(map(str, module_files(folder))), dict[CodeType, set[int]]()

    def on_event(frame: FrameType, event: str, argument: Any) -> Any:
        code = frame.f_code
        if code.co_filename not in files or not code.co_flags & inspect.CO_OPTIMIZED:
            return None  # another file, or the body of a module or class
        ran.setdefault(code, {code.co_firstlineno}).add(frame.f_lineno)
        return on_event

    sys.settrace(on_event)
    threading.settrace(on_event)
    return ran


def _unproved_lines(ran: Mapping[CodeType, Collection[int]], folder: Path) -> list[str]:
    """Return for each file the lines that were left out of functions that ran, as a sentence, if there are any."""
    found = []
    for file in module_files(folder):
        lines = {code: numbers for code, numbers in ran.items() if code.co_filename == str(file)}
        missed = sorted({line for code in lines for _, _, line in code.co_lines() if line}.difference(*lines.values()))
        grouped = groupby(enumerate(missed), key=lambda numbered: numbered[1] - numbered[0])
        spans = [[line for _, line in group] for _, group in grouped]
        if spans:
            named = ", ".join(
                f"{span[0]}-{span[-1]}" if len(span) > 1 else f"{span[0]}" for span in spans[:_MOST_NAMED]
            )
            more = " and others" if len(spans) > _MOST_NAMED else ""
            name = file.relative_to(folder).as_posix()
            text = f"No sample runs these lines of {name}, so no replay proves them: {named}{more}."
            found.append(f"{text} Give payloads that do: samples=[...].")
    return found


# -- verification ---------------------------------------------------------------------------------------------------


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
    try:
        with fresh_environment(folder) if fresh_env else contextlib.nullcontext(sys.executable) as python:
            report = replay_isolated(folder, timeout_s=timeout_s, python=python)
    except BundleError as error:
        if change is None:
            raise
        raise BundleChanged(folder, f"{change} It can't be replayed: {error}") from error
    if change is not None:
        if report.identical:
            raise BundleChanged(folder, f"{change} It still computes what was recorded.")
        raise ReplayDiffers(folder, replace(report, causes=(str(change),)))
    notes = _pinned_otherwise(folder, report)
    notes += environment_differences(recorded_environment(folder), report.environment)
    if report.identical:
        return replace(report, notes=(*report.notes, *report.outside, *notes))
    tokens = ", ".join(dict.fromkeys(repr(entry.token) for entry in report.differences if entry.function))
    causes = [_UNSTEADY.format(tokens), *notes] if tokens else notes
    raise ReplayDiffers(folder, replace(report, causes=causes or [_UNKNOWN]))


def _pinned_otherwise(folder: Path, report: ReplayReport) -> list[str]:
    """Return as sentences which packages are not as pinned."""
    pinned, imported = read_pins(folder), pins(report.requirements)
    found = [
        f"{REQUIREMENTS} pins {name} {version}, and {imported[name]} is imported here."
        for name, version in pinned.items()
        if imported.get(name, version) != version
    ]
    missing = sorted(imported.keys() - pinned.keys())
    return found + ([f"{REQUIREMENTS} does not name what is imported: {', '.join(missing)}."] if missing else [])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
