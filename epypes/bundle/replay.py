"""The replay of a bundle's samples, compared with what was recorded; in this process, or alone in a fresh one.

Run as a program (``python -s -P -m epypes.bundle.replay FOLDER REPORT``) it is that process. With ``--record`` it
records the samples anew instead.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

from epypes.bundle.adapters import ANSWER, answer_of
from epypes.bundle.compare import Difference, difference, differences, largest_of
from epypes.bundle.fingerprint import Digester
from epypes.bundle.load import Bundle, pipeline_of, read_bundle
from epypes.bundle.manifest import (
    MODULE,
    REQUIREMENTS,
    SAMPLES,
    check_manifest,
    environment,
    environment_differences,
    recorded_environment,
)
from epypes.bundle.requirements import fresh_environment, imported_names, pins, read_pins, requirement_lines
from epypes.errors import BundleChanged, BundleError, EpypesError, ReplayDiffers
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.run.guard import as_written
from epypes.wire.samples import load_sample, save_sample
from epypes.wording import counted

REPLAY_TIMEOUT_S: Final = 600.0
# Noise goes up and down: 1 in 362,880 series of as many runs goes further away each time by chance.
_MOST_RUNS: Final = 10
_MOST_NAMED: Final = 8
_UNSTEADY: Final = (
    "The values of {} differ from run to run in one process, too: random numbers without a seed, a counter, or a clock."
)
_UNKNOWN: Final = (
    "Neither the bundle nor what it runs on has changed as far as is known: a function may depend on something that is "
    "not a token, such as a file, the current folder, or what was installed beside its package."
)
# They change the texts of arrays alone.
PRINT_OPTIONS: Final = "numpy.set_printoptions"
_SYSTEM: Final = (
    *("/bin", "/boot", "/dev", "/etc", "/lib", "/lib32", "/lib64", "/proc", "/run", "/sbin", "/sys", "/usr"),
    *("/System", "/Library", "/var/cache", "/var/lib"),
)
_EVENTS: Final = frozenset({"open", "os.listdir", "os.scandir", "sqlite3.connect"})
_WAY_OUT: Final = (
    "The bundle is not alone with it. Pass its content in as a token, keep it in a variable of the notebook, or put "
    "it into the data of a package that is installed and read it with importlib.resources."
)


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What a replay found.

    Attributes
    ----------
    samples
        How many samples were replayed.
    tokens
        How many tokens were compared.
    differences
        The first difference of each token that differs.
    requirements
        The lines of requirements.txt, from what the replay imported; empty where it ran in this process.
    environment
        What the replay ran on: Python, platform, processor, OpenCV's build and threads.
    causes
        What the differences likely come from, the likeliest first.
    notes
        What else is worth knowing, as sentences.
    outside
        The files outside of the bundle that its functions open or name, as sentences.
    library_settings
        How libraries were set that the replay imported.
    fingerprints
        Digests of the functions and of what they refer to, as the import of the module made them.
    """

    samples: int
    tokens: int
    differences: Sequence[Difference]
    requirements: Sequence[str] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    causes: Sequence[str] = ()
    notes: Sequence[str] = ()
    outside: Sequence[str] = ()
    library_settings: Mapping[str, str] = field(default_factory=dict)
    fingerprints: Mapping[str, str] = field(default_factory=dict)

    @property
    def identical(self) -> bool:
        """Whether every token was what had been recorded, and there was one."""
        return self.tokens > 0 and not self.differences

    def __str__(self) -> str:
        if self.identical:
            return f"identical: {counted(self.tokens, 'token')} of {counted(self.samples, 'sample')}"
        found = [*map(str, self.differences)] or ["nothing was compared: the bundle has no samples"]
        return "\n".join([*found, *(f"Likely: {cause}" for cause in self.causes)])

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, as JSON has them."""
        return {"identical": self.identical, **asdict(self)}


def replay(bundle: Bundle, *, twice: bool = False) -> ReplayReport:
    """Replay a bundle's samples in this process.

    Parameters
    ----------
    bundle
        The bundle.
    twice
        Whether every sample is replayed a second time, in the opposite order: what a function remembers from call to
        call is something else then. That time it is also checked that no function changes an object in its input.
    """
    pipeline_of(bundle, None, None)  # what serves it can be made
    # By sample and token: what each pass found.
    table: dict[Path, dict[str, list[Difference | None]]] = {path: {} for path in bundle.samples}
    for is_second in (False, True) if twice else (False,):
        for path in reversed(bundle.samples) if is_second else bundle.samples:
            for token, found in _compared(bundle, path, check_mutation=is_second).items():
                table[path].setdefault(token, []).append(found)
    explained = [
        entry
        for path, passes in table.items()
        if any(any(found) for found in passes.values())
        for entry in _explained(bundle, path, passes)
    ]
    tokens = sum(map(len, table.values()))
    return ReplayReport(len(table), tokens, tuple(explained), environment=environment())


def _compared(bundle: Bundle, path: Path, *, check_mutation: bool = False) -> dict[str, Difference | None]:
    """Run a sample, and return by token what is not as it was recorded."""
    inputs, outputs = load_sample(path)
    settings = bundle.settings
    if (set(inputs), outputs.keys() - {ANSWER}) != (set(settings.inputs), set(settings.outputs)):
        tokens = f"{', '.join(inputs) or 'nothing'} -> {', '.join(outputs)}"
        text = f"Sample {path.stem} has the tokens {tokens}, which are not those of pipeline.toml. Promote again."
        raise BundleError(path, text)
    values = _run(bundle, inputs, outputs, check_mutation=check_mutation)
    return {
        token: difference(path.stem, token, differences(expected, values[token], settings.tolerances.get(token)))
        for token, expected in outputs.items()
    }


def record_again(bundle: Bundle) -> ReplayReport:
    """Run a bundle's samples in this process, and record their outputs."""
    for path in bundle.samples:
        inputs, outputs = load_sample(path)
        values = _run(bundle, inputs, outputs)
        save_sample(path, inputs, {name: values[name] for name in outputs}, rgb=bundle.settings.rgb)
    return ReplayReport(len(bundle.samples), 0, ())


def _run(
    bundle: Bundle, inputs: Mapping[str, Any], outputs: Collection[str], *, check_mutation: bool = False
) -> dict[str, Any]:
    """Return the values of a new run by token, and the answer that is made of it where that is among the outputs."""
    settings = bundle.settings
    run = CompGraphRunner(bundle.cg, settings.hyperparameters, check_mutation=check_mutation).run(**inputs)
    if ANSWER not in outputs:
        return dict(run)
    return {**run, ANSWER: answer_of(bundle.own["f_out"], settings.name, run, settings.attributes)}


def _explained(bundle: Bundle, path: Path, passes: Mapping[str, Sequence[Difference | None]]) -> Iterator[Difference]:
    """Give the difference of each token of a sample, with the first function that computes something else each time.

    What goes further away with each run is a clock or a counter, and no noise.
    """
    distances = _distances(bundle, path)
    unsteady = {token for token, found in distances.items() if any(found)}
    unsteady |= {token for token, found in passes.items() if len({entry and entry.text for entry in found}) > 1}
    for token, found in passes.items():
        if any(found):
            entry = largest_of([entry for entry in found if entry])
            is_noise = entry.is_noise and not _is_growing(distances[token])
            function = _origin(bundle.cg, token, unsteady) if token in unsteady else ""
            yield replace(entry, is_noise=is_noise, function=function)


def _distances(bundle: Bundle, path: Path) -> dict[str, list[float]]:
    """Run a sample some times more; return by token how far each run is from the first, infinity if in no number."""
    inputs, outputs = load_sample(path)
    first: dict[str, Any] = {}
    distances: dict[str, list[float]] = {}
    for number in range(_MOST_RUNS):
        values = _run(bundle, inputs, outputs)
        first = first or values
        for token, value in values.items():
            found = difference("", token, differences(first[token], value))
            distances.setdefault(token, []).append((found.largest or math.inf) if found else 0.0)
        if number > 1 and not any(map(_is_growing, distances.values())):
            break
    return distances


def _is_growing(distances: Sequence[float]) -> bool:
    return all(left < right for left, right in pairwise(distances))


def _origin(cg: CompGraph, token: str, unsteady: Collection[str]) -> str:
    """Return the first function on the way to a token that computes something else each time."""
    if token == ANSWER:
        return "f_out"
    name = cg.digraph.producer[token]
    before = next((given for given in cg.func_inputs(name) if given in unsteady), None)
    return name if before is None else _origin(cg, before, unsteady)


# -- in a process of its own -----------------------------------------------------------------------------------------


def replay_isolated(
    folder: Path,
    *,
    record: bool = False,
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
    options = ["--record"] if record else []
    with tempfile.TemporaryDirectory(prefix="epypes-replay-") as scratch:
        out = Path(scratch) / "report.json"
        try:
            # Isolated as by -I, which would also have it overlook PYTHONHASHSEED.
            done = subprocess.run(  # noqa: S603 - an interpreter, a module of ours
                [python, "-s", "-P", "-m", "epypes.bundle.replay", str(folder.resolve()), str(out), *options],
                cwd=cwd or scratch,
                env=without_python() if environment is None else environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise BundleError(folder, f"The replay of {folder} did not end within {timeout_s:g} s.") from error
        if not out.is_file():
            ending = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
            text = f"The replay of {folder} died with status {done.returncode}: {ending[0]}"
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
    try:
        report = record_again(read_bundle(folder, compare=False)) if "--record" in arguments else _watched(folder)
        outcome = asdict(report)
    except EpypesError as error:
        cause = error.__cause__
        outcome = {"error": _describe(cause, folder) if isinstance(cause, ImportError) else str(error)}
    except BaseException as error:
        outcome = {"error": _describe(error, folder)}
    out.write_text(json.dumps(outcome), encoding="utf-8")
    return 0


def _watched(folder: Path) -> ReplayReport:
    """Replay, and report what was imported, which files were opened, and which lines did not run."""
    for path in sorted((folder / SAMPLES).glob("*.npz")):
        # What reading a sample needs is loaded now, so that it is not taken for what the bundle needs.
        with contextlib.suppress(EpypesError):
            sample = load_sample(path)
            list(differences(sample, sample))
    before = frozenset(sys.modules)
    access, ran = FileAccess(folder), trace_lines(folder / MODULE)
    bundle = read_bundle(folder, compare=False)
    access.note_names(bundle.settings.hyperparameters)
    fingerprints = _fingerprints(bundle)
    report = replay(bundle, twice=True)
    sys.settrace(None)
    named = imported_names((folder / MODULE).read_text(encoding="utf-8"))
    return replace(
        report,
        outside=access.files,
        requirements=requirement_lines(named | (sys.modules.keys() - before)),
        notes=_unproved_lines(ran),
        library_settings=library_settings(),
        fingerprints=fingerprints,
    )


def _fingerprints(bundle: Bundle) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, function in {**bundle.cg.functions, **bundle.own}.items():
        digester = Digester()
        digester.add(as_written(function))
        found[name] = digester.digest().hex()
    return found


def _describe(error: BaseException, folder: Path) -> str:
    """Describe what failed in the bundle's own code, with its last line there."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = f" at {Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""
    notes = "; ".join(getattr(error, "__notes__", ()))
    text = f"The replay of {folder} failed{where}: {type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(error, ModuleNotFoundError):
        text += (
            ". Only installed packages can be imported in a bundle: install what its requirements.txt lists, "
            "or move the code into the notebook"
        )
    elif isinstance(error, FileNotFoundError) and not os.path.isabs(os.fsdecode(error.filename or os.sep)):
        text += ". A replay runs in another working folder than the notebook"
    return f"{text} ({notes})" if notes else text


def trace_lines(path: Path) -> dict[CodeType, set[int]]:
    """Note from now on which lines of a module's functions run, in this thread and in those that begin later."""
    ran: dict[CodeType, set[int]] = {}

    def on_event(frame: FrameType, event: str, argument: Any) -> Any:
        code = frame.f_code
        if code.co_filename != str(path) or not code.co_flags & inspect.CO_OPTIMIZED:
            return None  # another file, or the body of a module or class
        ran.setdefault(code, {code.co_firstlineno}).add(frame.f_lineno)
        return on_event

    sys.settrace(on_event)
    threading.settrace(on_event)
    return ran


def _unproved_lines(ran: Mapping[CodeType, Collection[int]]) -> list[str]:
    """Return the lines that were left out of functions that ran, as a sentence, if there are any."""
    every = {line for code in ran for _, _, line in code.co_lines() if line}
    missed = sorted(every.difference(*ran.values()))
    grouped = groupby(enumerate(missed), key=lambda numbered: numbered[1] - numbered[0])
    spans = [[line for _, line in group] for _, group in grouped]
    if not spans:
        return []
    named = ", ".join(f"{span[0]}-{span[-1]}" if len(span) > 1 else f"{span[0]}" for span in spans[:_MOST_NAMED])
    more = " and others" if len(spans) > _MOST_NAMED else ""
    text = f"No sample runs these lines of {MODULE}, so no replay proves them: {named}{more}."
    return [f"{text} Give payloads that do: samples=[...]."]


# -- what is watched -------------------------------------------------------------------------------------------------


def library_settings() -> dict[str, str]:
    """Return how libraries are set in this process, where that changes what functions compute."""
    found: dict[str, str] = {}
    numpy, cv2, decimal = (sys.modules.get(name) for name in ("numpy", "cv2", "decimal"))
    if numpy is not None:
        raising = {error: way for error, way in numpy.geterr().items() if way not in ("ignore", "warn", "print", "log")}
        found["numpy.seterr"] = f"{raising or 'no errors are raised'}"
        found[PRINT_OPTIONS] = f"{numpy.get_printoptions()}"
    if cv2 is not None:
        found["cv2.setUseOptimized"] = f"{cv2.useOptimized()}"
    if decimal is not None:
        context = decimal.getcontext()
        found["decimal.getcontext"] = f"prec={context.prec}, rounding={context.rounding}"
    return found


class FileAccess:
    """Notes from now on which files outside of a bundle its functions open.

    An audit hook receives every file that Python opens. Libraries in C open files without it, so their names are looked
    for in the text of the module and in the values of hyperparameters.

    Parameters
    ----------
    folder
        The bundle.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._opened: dict[str, str] = {}
        self._made: set[str] = set()
        # By path: what names it, and when it was written last.
        self._named: dict[str, tuple[str, int]] = {}
        sys.addaudithook(self._on_event)

    def note_names(self, hyperparameters: Mapping[str, Any]) -> None:
        """Note the files that the text of the module and values of hyperparameters name by an absolute path."""
        named = [*_texts_of(self._folder)]
        for token, value in hyperparameters.items():
            named += [(text, f"Hyperparameter {token!r} (pipeline.toml)") for text in _texts_in(value)]
        for text, what in named:
            # A folder such as /tmp or /data is on every machine, or is part of a longer name.
            if os.path.isabs(text) and Path(text).parts[2:] and os.path.exists(text):
                self._named.setdefault(text, (what, os.stat(text).st_mtime_ns))

    @property
    def files(self) -> tuple[str, ...]:
        """Why the bundle is not alone: a sentence for each file that is not its own."""
        found = {path: f"{what} opens {path}." for path, what in self._opened.items()}
        for text, (what, written_ns) in self._named.items():
            # A file that has changed meanwhile was written, not read.
            if os.path.exists(text) and os.stat(text).st_mtime_ns == written_ns:
                found.setdefault(os.path.realpath(text), f"{what} names {text}, which is there.")
        own = self._own_folders()
        return tuple(
            f"{reason} {_WAY_OUT}"
            for path, reason in found.items()
            if os.path.exists(path) and not own & {path, *map(str, Path(path).parents)}
        )

    def _own_folders(self) -> set[str]:
        """Return the folders whose files are there wherever the bundle's requirements are."""
        home = Path("~").expanduser()
        packages = (module for name, module in [*sys.modules.items()] if "." not in name)
        folders = [
            *(self._folder, os.getcwd(), sys.prefix, sys.base_prefix, *_SYSTEM),
            *(folder for module in packages for folder in getattr(module, "__path__", ())),
            *(os.environ.get("XDG_CACHE_HOME", home / ".cache"), os.environ.get("XDG_CONFIG_HOME", home / ".config")),
        ]
        return {os.path.realpath(folder) for folder in folders} - {os.sep, os.path.realpath(home)}

    def _on_event(self, event: str, given: tuple[Any, ...]) -> None:
        if event not in _EVENTS or not isinstance(given[0], str | bytes | os.PathLike):
            return
        if what := self._running_function():
            path = os.path.realpath(os.fsdecode(given[0]))
            flags = given[2] if event == "open" and isinstance(given[2], int) else 0
            if flags & os.O_TRUNC or not os.path.exists(path):
                self._made.add(path)
            elif not flags & os.O_WRONLY and path not in self._made:
                self._opened.setdefault(path, what)

    def _running_function(self) -> str:
        """Return which function of the bundle is running; "" if none is, or it is importing a module."""
        frame: FrameType | None = sys._getframe(2)
        while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
            file, name = Path(frame.f_code.co_filename), frame.f_code.co_name
            if file.parent == self._folder:
                return f"{'The module' if name == '<module>' else f'{name}()'} ({file.name}, line {frame.f_lineno})"
            frame = frame.f_back
        return ""


def named_here(folder: Path) -> list[str]:
    """Return a sentence for each text of a bundle that names a file in the current folder, which a replay has not."""
    return [
        f"{what} names {text!r}, a file in the current folder here. The current folder is another one there. {_WAY_OUT}"
        for text, what in _texts_of(folder)
        if text.strip("./ ") and not os.path.isabs(text)
        if os.path.isfile(text) or (os.sep in text and os.path.isdir(text))
    ]


def _texts_of(folder: Path) -> Iterator[tuple[str, str]]:
    """Give the strings in a bundle's module with the function that has each; not those that nothing reads."""
    module = folder / MODULE
    tree = ast.parse(module.read_bytes())
    functions: dict[ast.AST, str] = {}
    unread: set[ast.AST] = set()
    for node in ast.walk(tree):  # a function before the functions in it
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions |= dict.fromkeys(ast.walk(node), f"{node.name}()")
        elif isinstance(node, ast.Expr):  # a docstring is one
            unread.add(node.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in unread:
            yield node.value, f"{functions.get(node, 'The module')} ({module.name}, line {node.lineno})"


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | tuple | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(part)


# -- verification --------------------------------------------------------------------------------------------------


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
