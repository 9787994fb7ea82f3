"""How does a notebook's graph become a bundle?

Resolve every function, slice what it needs, emit the module, record the sample, replay it in a fresh isolated
process, pin what that imported, seal. Each step may refuse with a reason and a way out; none guesses; and only a
bundle that passed them all takes the place of an older one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from epypes.bundle.emit import emit_module
from epypes.bundle.exchange import exchange as _exchange
from epypes.bundle.load import MODULE, SAMPLES, SETTINGS, Bundle, read_bundle
from epypes.bundle.nodes import called_by, is_plain_pipeline
from epypes.bundle.proof import prove
from epypes.bundle.seal import MANIFEST
from epypes.bundle.settings import Settings, unwritable, writable_defaults, write_settings
from epypes.bundle.slicer import slice_graph
from epypes.bundle.tolerance import Learnt, learn
from epypes.errors import BundleError, EpypesError, MessageError, PromotionRefused, run_call
from epypes.graph import CompGraph, as_switch, colour_order, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.run import CompGraphRunner, Run

_NO_RUNNER: Final = (
    "An object of class {} can't be promoted. Make a runner and run it: "
    "runner = CompGraphRunner(cg, hparams); runner.run(...)."
)
_AS_ONE: Final = (
    "ep.to_source(cg) writes the graph as one plain function: put its text into a cell, make a graph of that "
    "function, run it and promote that."
)


def promote(
    runner_or_pipeline: CompGraphRunner | Pipeline,
    to: str | Path,
    outputs: Sequence[str] | None = None,
    f_in: Callable[[Any], Mapping[str, Any]] | None = None,
    f_out: Callable[[Any], Any] | None = None,
    *,
    told: Callable[[str], None] = lambda text: None,
) -> Bundle:
    """Write a bundle: a folder of text that computes what the runner's last run computed, and proves it.

    Parameters
    ----------
    runner_or_pipeline
        Its last run becomes the recorded sample.
    to
        The folder; a bundle that is there is replaced, anything else is not.
    outputs
        The tokens that the service answers with; the sink tokens without.
    f_in, f_out
        Refused so far: a bundle takes and gives Envelopes with one part per token.
    told
        Is told what is being done: the functions are run three times more, to learn which tokens they repeat to the
        last bit and how far noise puts the others apart.

    Raises
    ------
    PromotionRefused
        With every reason: no run to record, a function or value that can't be promoted, or a replay in a fresh
        process that computes something else.
    """
    # A link that names the current version goes on naming it; what it points to is replaced.
    try:
        target = Path(to).resolve()
    except (OSError, RuntimeError) as error:
        raise PromotionRefused(to, [f"{to} is no place to write to: {error}. Name another folder."]) from error
    runner, cg = _subject(runner_or_pipeline, target)
    if f_in is not None or f_out is not None:
        raise PromotionRefused(target, ["f_in and f_out can't be promoted yet. Leave them out."])
    try:
        _check_place(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name[:40]}-", dir=target.parent) as scratch:
            draft = Path(scratch) / target.name
            _write(draft, target, runner, cg, outputs, told)
            told("replaying in a fresh process")
            prove(draft, target)
            _replace(draft, target)
    except (OSError, UnicodeError) as error:
        if isinstance(error, EpypesError):
            raise
        raise PromotionRefused(target, [f"{target} can't be written: {error}. Name another folder."]) from error
    return read_bundle(target)


def _check_place(target: Path) -> None:
    """Refuse to write over what is not a bundle, or into one."""
    if target.exists() and not (target / MANIFEST).is_file() and (not target.is_dir() or any(target.iterdir())):
        raise PromotionRefused(target, [f"{target} exists and is not a bundle. Name another folder, or remove it."])
    around = next((parent for parent in target.parents if (parent / MANIFEST).is_file()), None)
    if around is not None:
        raise PromotionRefused(
            target, [f"{target} is inside the bundle {around}, which is sealed. Name another folder."]
        )


def _subject(given: object, target: Path) -> tuple[CompGraphRunner, CompGraph]:
    if isinstance(given, CompGraphRunner):
        return given, given.cg
    if type(given) is Pipeline:
        return given.runner, given.source_cg
    if isinstance(given, Pipeline):
        kind = type(given).__name__
        text = f"A {kind} can't be promoted yet. Promote its runner: promote(CompGraphRunner(pipe.cg, hparams), ...)."
        raise PromotionRefused(target, [text])
    raise PromotionRefused(target, [_NO_RUNNER.format(type(given).__name__)])


def _write(
    draft: Path,
    target: Path,
    runner: CompGraphRunner,
    cg: CompGraph,
    outputs: Sequence[str] | None,
    told: Callable[[str], None],
) -> None:
    """Write all that can be written without running anything; raise every reason against it at once."""
    wanted = cg.sink_tokens if outputs is None else tuple(outputs)
    for token in wanted:
        cg.require_token(token)
    reasons = [*_unready(runner, wanted), *unwritable(runner.hyperparameters)]
    functions = {name: function.func if type(function) is Node else function for name, function in cg.functions.items()}
    reasons += _unheld(functions)
    needed, references = slice_graph({name: function for name, function in functions.items() if not _kind(function)})
    reasons += needed.refusals
    if reasons:
        raise PromotionRefused(target, reasons)
    learnt = _learnt(target, runner, cg, wanted, told)
    (draft / SAMPLES).mkdir(parents=True)
    free = runner.free_source_tokens
    rgb = tuple(token for token in dict.fromkeys((*free, *wanted)) if colour_order(cg, token) == "rgb")
    hyperparameters = runner.hyperparameters
    defaults = writable_defaults(cg, hyperparameters)
    settings = Settings(target.name, free, wanted, hyperparameters, rgb, defaults, cg.types, learnt.tolerances)
    (draft / MODULE).write_text(emit_module(settings, cg, needed, references), encoding="utf-8")
    write_settings(draft / SETTINGS, settings, cg)
    if runner.last is not None:  # as _unready has made sure
        _record(draft / SAMPLES / "000.npz", target, runner.last, settings)


def _kind(function: object) -> str:
    """Return what a function is that a bundle can't hold yet, though it has no text to be refused for; "" if none."""
    if is_placeholder(function):
        return "a placeholder"
    if as_switch(function) is not None:
        return "a switch"
    return "a pipeline" if is_plain_pipeline(called_by(function)) else ""


def _unheld(functions: Mapping[str, Callable[..., Any]]) -> list[str]:
    """Return a reason, with the way out, for each function that a bundle can't hold yet."""
    kinds = {name: _kind(function) for name, function in functions.items()}
    return [
        f"Function {name!r} is a placeholder. Give it: ep.extend(cg, {{{name!r}: ...}}), and run that graph."
        if kind == "a placeholder"
        else f"Function {name!r} is {kind}, which a bundle can't hold yet. {_AS_ONE}"
        for name, kind in kinds.items()
        if kind
    ]


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


def _learnt(
    target: Path, runner: CompGraphRunner, cg: CompGraph, outputs: Sequence[str], told: Callable[[str], None]
) -> Learnt:
    """Return the tolerances of the outputs; refuse outputs that are something else at every run."""
    samples = [runner.last] if runner.last is not None else []
    try:
        learnt = learn(cg, runner.hyperparameters, samples, outputs, told)
    except BundleError as error:
        raise PromotionRefused(target, [str(error)]) from error
    if learnt.reasons:
        raise PromotionRefused(target, learnt.reasons)
    return learnt


def _record(path: Path, target: Path, run: Run, settings: Settings) -> None:
    from epypes.wire.samples import save_sample

    try:
        inputs, outputs = ({token: run[token] for token in side} for side in (settings.inputs, settings.outputs))
        save_sample(path, inputs, outputs, rgb=settings.rgb)
    except MessageError as error:
        raise PromotionRefused(target, [str(error)]) from error


def _replace(draft: Path, target: Path) -> None:
    """Put the new bundle in the place of the old one; at every moment one of the two is there."""
    if target.exists():
        # The old one is then in the scratch folder, and goes with it.
        _exchange(draft, target)
    else:
        draft.rename(target)
