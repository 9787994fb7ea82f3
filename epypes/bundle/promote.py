"""Promotion: a notebook's graph becomes a bundle.

Slice what the functions need, write the module, record the samples, replay them in fresh isolated processes, pin what
those imported, write the manifest. Each step may refuse with a reason and a way out; none guesses. Only a bundle that
passed them all replaces an older one.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from epypes.bundle.adapters import ANSWER, answer_of, is_usual
from epypes.bundle.arrays import store_hyperparameters
from epypes.bundle.clone import clone_runner, parameters_of
from epypes.bundle.determinism import prove
from epypes.bundle.draft import draft_folder, swap_folders
from epypes.bundle.load import MAKER, MODULE, SAMPLES, SETTINGS, Bundle, read_bundle
from epypes.bundle.manifest import MANIFEST, why_no_bundle
from epypes.bundle.module import PIPELINES, write_module
from epypes.bundle.resolve import Refused
from epypes.bundle.settings import MOST_NUMBERS, Settings, unwritable, writable_defaults, write_settings
from epypes.errors import EpypesError, MessageError, PromotionRefused, run_call
from epypes.graph import colour_order
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner, Run
from epypes.run.guard import as_written


def _ignore(text: str) -> None:
    """Take the progress of a promotion that shows none."""


def promote(
    runner_or_pipeline: CompGraphRunner | Pipeline,
    to: str | Path,
    outputs: Sequence[str] | None = None,
    f_in: Callable[[Any], Mapping[str, Any]] | None = None,
    f_out: Callable[[Any], Any] | None = None,
    *,
    samples: Iterable[Any] = (),
    on_progress: Callable[[str], None] = _ignore,
) -> Bundle:
    """Write a bundle: a folder of text that computes what the runner's last run computed, and proves it.

    Parameters
    ----------
    runner_or_pipeline
        Its last run becomes the recorded sample.
    to
        The folder; a bundle that is there is replaced, if all its files are its own; anything else is not.
    outputs
        The tokens that the service answers with; the sink tokens without.
    f_in, f_out
        How the service makes a payload of an event, and an answer of an event's view; those of a reactive pipeline
        without. Otherwise it takes and gives Envelopes with one part per token. Events may be Envelopes or bytes.
    samples
        Further payloads that are run and recorded, besides that of the last run: values of the one free source token,
        or mappings by token.
    on_progress
        Called with what is being done, and with what the replays found that is worth knowing.

    Raises
    ------
    PromotionRefused
        With every reason: no run to record, a function or value that can't be promoted, or a replay in a fresh
        process that computes something else.
    """
    # A link that names the current version goes on naming it; what it points to is replaced.
    target = Path(os.path.realpath(to))
    try:
        ports = _ports(runner_or_pipeline, f_in, f_out)
        _check_place(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft_folder(target) as draft:
            _write(draft, target, runner_or_pipeline, ports, outputs, samples)
            on_progress("replaying in fresh processes")
            for note in prove(draft, target).notes:
                on_progress(note)
            _replace(draft, target)
    except (Refused, MessageError) as refusal:
        raise PromotionRefused(target, [str(refusal)]) from refusal
    except (OSError, UnicodeError) as error:
        if isinstance(error, EpypesError):
            raise
        raise PromotionRefused(target, [f"{target} can't be written: {error}. Name another folder."]) from error
    return read_bundle(target)


def _ports(given: object, f_in: Any, f_out: Any) -> dict[str, Callable[..., Any]]:
    """Return f_in and f_out as the user wrote them, as far as they are not the usual ones of a bundle."""
    ports = {"f_in": f_in, "f_out": f_out}
    for name, port in ports.items():
        if port is not None and not callable(port):
            raise Refused(f"{name} must be a function, not {type(port).__name__!r}.")
    if isinstance(given, Pipeline):  # its class may also make a port itself
        taken = {parameter.name for parameter in parameters_of(type(given))}
        ports |= {name: getattr(given, name, None) for name in ports if ports[name] is None and name in taken}
    elif not isinstance(given, CompGraphRunner):
        way_out = "Make a runner and run it: runner = CompGraphRunner(cg, hparams); runner.run(...)."
        raise Refused(f"An object of class {type(given).__name__} can't be promoted. {way_out}")
    return {name: as_written(port) for name, port in ports.items() if port is not None and not is_usual(port)}


def _check_place(target: Path) -> None:
    """Refuse to write over what is neither a bundle nor an empty folder, or into a bundle."""
    around = next((parent for parent in target.parents if (parent / MANIFEST).is_file()), None)
    if around is not None:
        raise Refused(f"{target} is inside the bundle {around}, whose files may not change. Name another folder.")
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / MANIFEST).is_file():
        raise Refused(f"{target} exists and is not a bundle. Name another folder, or remove it.")
    why = why_no_bundle(target)
    if why:
        raise Refused(f"{why} Replacing it would delete what it holds: name another folder, or move that away.")


def _write(
    draft: Path,
    target: Path,
    given: CompGraphRunner | Pipeline,
    ports: Mapping[str, Callable[..., Any]],
    outputs: Sequence[str] | None,
    samples: Iterable[Any],
) -> None:
    """Write all that can be written without running anything new; raise every reason against it at once."""
    if isinstance(given, Pipeline):
        runner, cg, attributes = given.runner, given.source_cg, dict(given.attributes)
    else:
        runner, cg, attributes = given, given.cg, {}
    wanted = cg.sink_tokens if outputs is None else tuple(outputs)
    for token in wanted:
        cg.require_token(token)
    hyperparameters, stored = store_hyperparameters(runner.hyperparameters, MOST_NUMBERS)
    free = runner.free_source_tokens
    rgb = tuple(token for token in dict.fromkeys((*free, *wanted)) if colour_order(cg, token) == "rgb")
    pipeline = given if isinstance(given, Pipeline) and type(given) not in PIPELINES else None
    settings = Settings(
        target.name, free, wanted, hyperparameters, rgb, writable_defaults(cg, hyperparameters), cg.types,
        own=(*ports, *([MAKER] if pipeline is not None else ())), attributes=attributes, has_groups=bool(cg.groups),
    )  # fmt: skip
    reasons = [*_unready(runner, wanted), *unwritable(hyperparameters), *unwritable(attributes, "Attribute")]
    module, arrays, refusals = write_module(cg, settings, ports, pipeline)
    if reasons or refusals:
        raise PromotionRefused(target, [*reasons, *refusals])
    runs = [*_runs(runner, samples)]
    (draft / SAMPLES).mkdir(parents=True)
    (draft / MODULE).write_text(module, encoding="utf-8")
    write_settings(draft / SETTINGS, settings, cg)
    arrays.write(draft)
    stored.write(draft)
    for number, run in enumerate(runs):
        _record(draft / SAMPLES / f"{number:03}.npz", run, settings, ports.get("f_out"))


def _runs(runner: CompGraphRunner, samples: Iterable[Any]) -> Iterator[Run]:
    """Give the last run, then runs of further payloads."""
    if runner.last is not None:  # as _unready has made sure
        yield runner.last
    for number, sample in enumerate(samples, 1):
        payload = sample if isinstance(sample, Mapping) else dict.fromkeys(runner.free_source_tokens[:1], sample)
        try:
            run = clone_runner(runner).run_on(payload)
        except Exception as error:  # whatever a function raises on it
            raise Refused(f"Sample {number} can't be run: {type(error).__name__}: {error}") from error
        yield run


def _unready(runner: CompGraphRunner, outputs: Sequence[str]) -> list[str]:
    """Return why the last run can't serve as a sample."""
    call = run_call(runner.free_source_tokens)
    if not outputs:
        return ["The graph has no output: name at least one token as output."]
    if runner.last is None:
        return [f"Nothing has been run, so there is nothing to compare with. Call {call} first."]
    if runner.last.failure is not None:
        return [f"The last run failed in {runner.last.failure}. Call {call} again first."]
    if runner.stale:
        return [f"These functions are stale: {', '.join(runner.stale)}. Call rerun() first."]
    return []


def _record(path: Path, run: Run, settings: Settings, f_out: Callable[..., Any] | None) -> None:
    """Record a run as a sample, with the answer that the user's own f_out makes of it."""
    from epypes.wire.samples import save_sample

    inputs, outputs = ({token: run[token] for token in side} for side in (settings.inputs, settings.outputs))
    answer = answer_of(f_out, settings.name, run, settings.attributes) if f_out is not None else None
    if answer is not None:
        # An answer without a codec can't be sent either.
        with contextlib.suppress(MessageError):
            return save_sample(path, inputs, {**outputs, ANSWER: answer}, rgb=settings.rgb)
    return save_sample(path, inputs, outputs, rgb=settings.rgb)


def _replace(draft: Path, target: Path) -> None:
    """Put the new bundle in the place of the old one; at every moment one of the two is there."""
    _check_place(target)
    if target.exists():
        swap_folders(draft, target)  # the old one is then in the scratch folder, and goes with it
    else:
        draft.rename(target)
