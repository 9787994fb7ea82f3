"""Does a bundle, alone in a fresh process, compute what was recorded?

Run as a program (``python -I -m epypes.bundle.replay FOLDER REPORT``) it is that process.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import traceback
from dataclasses import asdict
from pathlib import Path

from epypes.bundle.answers import bundle_answer_difference
from epypes.bundle.compare import Difference, ReplayReport, first_difference
from epypes.bundle.load import Bundle, pipeline_of, read_bundle
from epypes.bundle.requirements import imported_requirements
from epypes.errors import BundleError, EpypesError, ReplayDiffers
from epypes.run import CompGraphRunner

REPLAY_TIMEOUT_S = 600.0


def verify(path: str | Path, *, timeout_s: float = REPLAY_TIMEOUT_S) -> ReplayReport:
    """Replay a bundle's samples in a fresh isolated process.

    Raises
    ------
    ReplayDiffers
        A token is not what was recorded; token, first differing index and both values are named.
    BundleError
        The folder is not the bundle that was promoted, or its code fails.
    """
    report = replay_isolated(Path(path), sealed=True, timeout_s=timeout_s)
    if not report.identical:
        raise ReplayDiffers(path, report)
    return report


def replay_isolated(folder: Path, *, sealed: bool, timeout_s: float = REPLAY_TIMEOUT_S) -> ReplayReport:
    """Replay in a new interpreter that sees neither the environment nor the current folder.

    Raises
    ------
    BundleError
        The process failed or took longer than ``timeout_s``.
    """
    with tempfile.TemporaryDirectory(prefix="epypes-replay-") as scratch:
        out = Path(scratch) / "report.json"
        command = [sys.executable, "-I", "-m", "epypes.bundle.replay", str(folder.resolve()), str(out)]
        try:
            done = subprocess.run(  # noqa: S603 - this interpreter, this module
                [*command, *([] if sealed else ["--unsealed"])],
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
    return ReplayReport(
        outcome["samples"],
        outcome["tokens"],
        tuple(Difference(**difference) for difference in outcome["differences"]),
        tuple(outcome["requirements"]),
    )


def replay(bundle: Bundle) -> ReplayReport:
    """Replay a bundle's samples in this process."""
    from epypes.wire.samples import load_sample

    differences: list[Difference] = []
    tokens = 0
    pipeline_of(bundle, None, None)  # what serves it can be made
    for path in bundle.samples:
        inputs, outputs = load_sample(path)
        if (set(inputs), set(outputs)) != (set(bundle.settings.inputs), set(bundle.settings.outputs)):
            ports = f"{', '.join(inputs) or 'nothing'} -> {', '.join(outputs)}"
            why = f"its ports are {ports}, those of pipeline.toml are not"
            differences.append(Difference(path.stem, ", ".join(bundle.settings.outputs), why))
        run = CompGraphRunner(bundle.cg, bundle.settings.hyperparameters).run(**inputs)
        for token, expected in outputs.items():
            tokens += 1
            text = first_difference(expected, run[token])
            if text:
                differences.append(Difference(path.stem, token, text))
        text = bundle_answer_difference(bundle, path.stem, run)
        if text:
            differences.append(
                Difference(path.stem, ", ".join(bundle.settings.outputs), f"the answer of f_out: {text}")
            )
    return ReplayReport(len(bundle.samples), tokens, tuple(differences), imported_requirements())


def main(arguments: list[str]) -> int:
    """Replay the bundle in the folder that is named first; write the outcome as JSON to the file named second."""
    folder, out = Path(arguments[0]), Path(arguments[1])
    try:
        outcome = asdict(replay(read_bundle(folder, sealed="--unsealed" not in arguments)))
    except EpypesError as error:
        outcome = {"error": str(error)}
    except BaseException as error:
        outcome = {"error": _told(error, folder)}
    out.write_text(json.dumps(outcome), encoding="utf-8")
    return 0


def _told(error: BaseException, folder: Path) -> str:
    """Tell what failed in the bundle's own code, with its last line there."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = f" at {Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""
    notes = "; ".join(getattr(error, "__notes__", ()))
    text = f"The replay of {folder} failed{where}: {type(error).__name__}: {error}"
    if isinstance(error, ModuleNotFoundError):
        text += ". Only installed packages can be imported in a bundle: install it, or move the code into the notebook"
    return f"{text} ({notes})" if notes else text


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
