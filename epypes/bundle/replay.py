"""Does a bundle, alone in a fresh process, compute what was recorded?

Run as a program (``python -I -m epypes.bundle.replay FOLDER REPORT``) it is that process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from epypes.bundle.answers import answer_differences
from epypes.bundle.compare import differences
from epypes.bundle.environment import environment
from epypes.bundle.importwatch import ImportWatch
from epypes.bundle.load import MODULE, SAMPLES, Bundle, module_name, pipeline_of, read_bundle
from epypes.bundle.reach import ReachWatch
from epypes.bundle.report import Difference, ReplayReport, difference, report_from
from epypes.bundle.requirements import owner, requirement_lines
from epypes.errors import BundleError, EpypesError
from epypes.run import CompGraphRunner

REPLAY_TIMEOUT_S = 600.0


def replay_isolated(
    folder: Path, *, sealed: bool, timeout_s: float = REPLAY_TIMEOUT_S, python: str = sys.executable
) -> ReplayReport:
    """Replay in a new interpreter that sees neither the environment nor the current folder.

    Parameters
    ----------
    folder
        The bundle.
    sealed
        Whether it must be what was promoted.
    timeout_s
        When the process is ended.
    python
        The interpreter, this one without.

    Raises
    ------
    BundleError
        The process failed or took longer than ``timeout_s``.
    """
    outcome = run_isolated(
        "epypes.bundle.replay", folder, [] if sealed else ["--unsealed"], timeout_s=timeout_s, python=python
    )
    return report_from(outcome)


def run_isolated(
    module: str, folder: Path, arguments: Sequence[str], *, timeout_s: float, python: str = sys.executable
) -> Any:
    """Run a module of EPypes as a program on a bundle, in a new interpreter; return what it has written as JSON.

    Raises
    ------
    BundleError
        The process failed, took longer than ``timeout_s``, or has written an error.
    """
    with tempfile.TemporaryDirectory(prefix="epypes-replay-") as scratch:
        out = Path(scratch) / "report.json"
        try:
            done = subprocess.run(  # noqa: S603 - an interpreter, a module of ours
                [python, "-I", "-m", module, str(folder.resolve()), str(out), *arguments],
                cwd=scratch,
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
    return outcome


def replay(bundle: Bundle) -> ReplayReport:
    """Replay a bundle's samples in this process."""
    from epypes.wire.samples import load_sample

    found: list[Difference] = []
    unsteady: list[str] = []
    tokens = 0
    pipeline_of(bundle, None, None)  # what serves it can be made
    for path in bundle.samples:
        inputs, outputs = load_sample(path)
        if (set(inputs), set(outputs)) != (set(bundle.settings.inputs), set(bundle.settings.outputs)):
            ports = f"{', '.join(inputs) or 'nothing'} -> {', '.join(outputs)}"
            why = f"its ports are {ports}, those of pipeline.toml are not"
            found.append(Difference(path.stem, ", ".join(bundle.settings.outputs), why))
        run = _run(bundle, inputs)
        differing = [*_differing(bundle, path.stem, outputs, run)]
        if differing:
            again = _run(bundle, inputs)
            differs = (entry.token for entry in differing)
            unsteady += [token for token in differs if next(differences(run[token], again[token]), None)]
        found += [*differing, *answer_differences(bundle, path.stem, run)]
        tokens += len(outputs)
    return ReplayReport(
        len(bundle.samples), tokens, tuple(found), environment=environment(), unsteady=tuple(dict.fromkeys(unsteady))
    )


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
    out.write_text(json.dumps(outcome_of(folder, lambda: _watched(folder, arguments))), encoding="utf-8")
    return 0


def _watched(folder: Path, arguments: list[str]) -> dict[str, Any]:
    """Replay, and say what that has imported."""
    from epypes.wire.samples import load_sample

    with ImportWatch() as watch:
        for path in sorted((folder / SAMPLES).glob("*.npz")):
            # What reading a sample needs is loaded now, so that it is not taken for what the bundle needs.
            try:
                sample = load_sample(path)
                list(differences(sample, sample))
            except EpypesError:
                break
        watch.mark()
        with ReachWatch(folder) as reached:
            bundle = read_bundle(folder, sealed="--unsealed" not in arguments)
            reached.also_in(bundle.settings.hyperparameters)
            report = replay(bundle)
        name = module_name(folder)
        watch.import_all_of((folder / MODULE).read_text(encoding="utf-8"), name)
    modules = watch.imported_by(name, owner)
    report = replace(report, outside=reached.files, notes=(*report.notes, *reached.notes))
    return replace(report, requirements=requirement_lines(modules)).to_dict()


def outcome_of(folder: Path, work: Any) -> dict[str, Any]:
    """Return what some work with a bundle returns, or as an error what stopped it."""
    try:
        outcome: dict[str, Any] = work()
    except EpypesError as error:
        return {"error": str(error)}
    except BaseException as error:
        return {"error": _told(error, folder)}
    return outcome


def _told(error: BaseException, folder: Path) -> str:
    """Tell what failed in the bundle's own code, with its last line there."""
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
