"""The replay of a bundle's samples, alone in a fresh process, compared with what was recorded.

Run as a program (``python -s -P -m epypes.bundle.replay FOLDER REPORT``) it is that process. With ``--record`` it
records the samples anew instead.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from epypes.bundle.adapters import ANSWERS, answer_differences, record_answer
from epypes.bundle.compare import Difference, difference, differences
from epypes.bundle.conditions import library_settings, without_python
from epypes.bundle.coverage import LineCoverage
from epypes.bundle.file_access import FileAccess
from epypes.bundle.load import MODULE, SAMPLES, Bundle, pipeline_of, read_bundle
from epypes.bundle.manifest import environment
from epypes.bundle.requirements import imported_names, requirement_lines
from epypes.errors import BundleError, EpypesError
from epypes.run import CompGraphRunner
from epypes.wire.samples import load_sample, save_sample
from epypes.wording import counted


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
    unsteady
        The tokens that differ from what was recorded, and from run to run as well.
    causes
        What the differences likely come from, the likeliest first.
    notes
        What else is worth knowing, as sentences.
    outside
        The files outside of the bundle that its functions open or name, as sentences.
    library_settings
        How libraries were set that the replay imported.
    """

    samples: int
    tokens: int
    differences: tuple[Difference, ...]
    requirements: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    unsteady: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()
    library_settings: Mapping[str, str] = field(default_factory=dict)

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


REPLAY_TIMEOUT_S = 600.0


def replay_isolated(
    folder: Path,
    options: Sequence[str] = (),
    *,
    timeout_s: float = REPLAY_TIMEOUT_S,
    python: str = sys.executable,
    environment: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> ReplayReport:
    """Replay in a new interpreter that sees neither the current folder nor the variables that Python reads.

    Parameters
    ----------
    folder
        The bundle.
    options
        ``"--unsealed"``: it need not be what was promoted. ``"--twice"``: every sample is replayed a second time, in
        the opposite order. ``"--unwatched"``: without the requirements, and the files outside of the bundle.
        ``"--record"``: the samples are recorded anew, and nothing is compared.
    timeout_s
        When the process is ended.
    python
        The interpreter, this one without.
    environment, cwd
        The variables and the working folder of the process; this environment and a new folder without.

    Raises
    ------
    BundleError
        The process failed, took longer than ``timeout_s``, or has written an error.
    """
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
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in outcome.items()
    }
    return ReplayReport(differences=found, **values)


def replay(bundle: Bundle, *, twice: bool = False) -> ReplayReport:
    """Replay a bundle's samples in this process.

    Parameters
    ----------
    bundle
        The bundle.
    twice
        Whether every sample is replayed a second time, in the opposite order: a function that keeps something from
        call to call computes something else then.
    """
    found: list[Difference] = []
    unsteady: dict[str, None] = {}
    tokens = 0
    pipeline_of(bundle, None, None)  # what serves it can be made
    for path in bundle.samples:
        inputs, outputs = load_sample(path)
        if (set(inputs), set(outputs)) != (set(bundle.settings.inputs), set(bundle.settings.outputs)):
            ports = f"{', '.join(inputs) or 'nothing'} -> {', '.join(outputs)}"
            why = f"its ports are {ports}, those of pipeline.toml are not"
            found.append(Difference(why, sample=path.stem, token=", ".join(bundle.settings.outputs)))
        run = _run(bundle, inputs)
        differing = [*_differing(bundle, path.stem, outputs, run)]
        if differing:
            again = _run(bundle, inputs)
            differs = (entry.token for entry in differing)
            unsteady |= {token: None for token in differs if next(differences(run[token], again[token]), None)}
        found += [*differing, *answer_differences(bundle, path.stem, run)]
        tokens += len(outputs)
    known = {(entry.sample, entry.token) for entry in found}
    for path in reversed(bundle.samples) if twice else ():
        inputs, outputs = load_sample(path)
        again = _differing(bundle, path.stem, outputs, _run(bundle, inputs))
        new = [entry for entry in again if (entry.sample, entry.token) not in known]
        found += new
        unsteady |= {entry.token: None for entry in new}
    return ReplayReport(len(bundle.samples), tokens, tuple(found), environment=environment(), unsteady=tuple(unsteady))


def record_again(bundle: Bundle) -> ReplayReport:
    """Run a bundle's samples in this process, and record their outputs and answers."""
    settings = bundle.settings
    for path in bundle.samples:
        inputs, outputs = load_sample(path)
        run = _run(bundle, inputs)
        save_sample(path, inputs, {token: run[token] for token in outputs}, rgb=settings.rgb)
        answer = bundle.path / ANSWERS / path.name
        if answer.is_file():
            answer.unlink()
            record_answer(answer, bundle.own["f_out"], settings.name, (run, _run(bundle, inputs)), settings.attributes)
    return ReplayReport(len(bundle.samples), 0, ())


def _run(bundle: Bundle, inputs: dict[str, Any]) -> Any:
    return CompGraphRunner(bundle.cg, bundle.settings.hyperparameters).run(**inputs)


def _differing(bundle: Bundle, sample: str, outputs: dict[str, Any], run: Any) -> list[Difference]:
    tolerances = bundle.settings.tolerances
    found = (
        difference(sample, token, differences(expected, run[token], tolerances.get(token)))
        for token, expected in outputs.items()
    )
    return [entry for entry in found if entry is not None]


def main(arguments: list[str]) -> int:
    """Replay the bundle in the folder that is named first; write the outcome as JSON to the file named second."""
    folder, out = Path(arguments[0]), Path(arguments[1])
    try:
        outcome = asdict(_replayed(folder, arguments[2:]))
    except EpypesError as error:
        outcome = {"error": str(error)}
    except BaseException as error:
        outcome = {"error": _describe(error, folder)}
    out.write_text(json.dumps(outcome), encoding="utf-8")
    return 0


def _replayed(folder: Path, options: Sequence[str]) -> ReplayReport:
    """Replay, or record anew, as the options say; a report has what was imported and opened unless ``--unwatched``."""
    is_sealed, twice = not {"--unsealed", "--record"} & {*options}, "--twice" in options
    if "--record" in options:
        return record_again(read_bundle(folder, compare=is_sealed))
    if "--unwatched" in options:
        return replay(read_bundle(folder, compare=is_sealed), twice=twice)
    for path in sorted((folder / SAMPLES).glob("*.npz")):
        # What reading a sample needs is loaded now, so that it is not taken for what the bundle needs.
        try:
            sample = load_sample(path)
            list(differences(sample, sample))
        except EpypesError:
            break
    before = frozenset(sys.modules)
    with FileAccess(folder) as access, LineCoverage(folder / MODULE) as coverage:
        bundle = read_bundle(folder, compare=is_sealed)
        access.also_in(bundle.settings.hyperparameters)
        report = replay(bundle, twice=twice)
    named = imported_names((folder / MODULE).read_text(encoding="utf-8"))
    requirements = requirement_lines(named | (sys.modules.keys() - before))
    notes = (coverage.note,) if coverage.note else ()
    return replace(
        report, outside=access.files, requirements=requirements, notes=notes, library_settings=library_settings()
    )


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
    elif (
        isinstance(error, FileNotFoundError) and error.filename and not Path(os.fsdecode(error.filename)).is_absolute()
    ):
        text += ". The current folder is another one there"
    return f"{text} ({notes})" if notes else text


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
