"""Promotion: a notebook's graph becomes a bundle.

Slice what the functions need, write the module, record the samples, replay them in fresh isolated processes, pin what
those imported, write the manifest. Each step may refuse with a reason and a way out; none guesses. Only a bundle that
passed them all replaces an older one, in one step.

A notebook file is executed in a new kernel, and its graph is promoted there. The kernel sends the progress, and the
reasons against a promotion, as displayed data of a type of its own.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from epypes.acquisition.frames import with_images
from epypes.acquisition.video import Video
from epypes.bundle.adapters import ANSWER, answer_of, is_usual
from epypes.bundle.arrays import store_hyperparameters
from epypes.bundle.load import MAKER, Bundle, read_bundle
from epypes.bundle.manifest import MANIFEST, MODULE, SAMPLES, SETTINGS, why_no_bundle
from epypes.bundle.proof.compare import differences
from epypes.bundle.proof.determinism import prove
from epypes.bundle.settings import MOST_NUMBERS, Settings, states_of, unwritable, writable_defaults, write_settings
from epypes.bundle.source.clone import clone_runner, parameters_of
from epypes.bundle.source.module import PIPELINES, write_module
from epypes.bundle.source.objects import describe_message
from epypes.bundle.source.resolve import Refused
from epypes.errors import BundleError, EpypesError, MessageError, PromotionRefused, UnknownName, run_call
from epypes.graph import ASSUMED, ColourOrder, CompGraph
from epypes.images import has_colours
from epypes.optional import optional_import
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner, Run
from epypes.run.guard import as_written
from epypes.wording import error_message

_LOG: Final = logging.getLogger("epypes.bundle")
# From Linux's fcntl.h and fs.h.
_AT_FDCWD: Final = -100
_RENAME_EXCHANGE: Final = 2
# What the names of folders end with in which drafts are.
_DRAFTS: Final = ".epypes-draft"
_NO_FIRST: Final = (
    "Have the functions take it, or begin with a value that they take: ep.delay(cg, token, previous, initial=...)."
)
_MEDIA_TYPE: Final = "application/vnd.epypes.promotion+json"


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
        Its last run becomes the recorded sample, with the state that it began with if the graph has delays.
    to
        The folder; a bundle that is there is replaced, if all its files are its own; anything else is not.
    outputs
        The tokens that the service answers with; the sink tokens without.
    f_in, f_out
        How the service makes a payload of an event, and an answer of an event's view; those of a reactive pipeline
        without. Otherwise it takes and gives Envelopes with one part per token. Events may be Envelopes or bytes.
    samples
        Further payloads that are run and recorded, besides that of the last run: values of the one free source token,
        or mappings by token. A video, and frames of one or of a camera, get the token's order of colours. If the graph
        has delays, they are a sequence that goes on from the last run.
    on_progress
        Called with what is being done, and with what was assumed or found that is worth knowing. Without, an order of
        colours that is assumed is logged as a warning.

    Raises
    ------
    PromotionRefused
        With every reason: no run to record, a function or value that can't be promoted, or a replay in a fresh
        process that computes something else.
    """
    # A link that names the current version goes on naming it; what it points to is replaced.
    target = Path(os.path.realpath(to))
    try:
        adapters = _adapters(runner_or_pipeline, f_in, f_out)
        _check_place(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft_folder(target) as draft:
            assumptions = _write(draft, target, runner_or_pipeline, adapters, outputs, samples).assumptions()
            if assumptions:
                (_LOG.warning if on_progress is _ignore else on_progress)(assumptions)
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


def _adapters(given: object, f_in: Any, f_out: Any) -> dict[str, Callable[..., Any]]:
    """Return f_in and f_out as the user wrote them, as far as they are not the usual ones of a bundle."""
    adapters = {"f_in": f_in, "f_out": f_out}
    for name, adapter in adapters.items():
        if adapter is not None and not callable(adapter):
            raise Refused(f"{name} must be a function, not {type(adapter).__name__!r}.")
    if isinstance(given, Pipeline):  # its class may also make a adapter itself
        taken = {parameter.name for parameter in parameters_of(type(given))}
        adapters |= {name: getattr(given, name, None) for name in adapters if adapters[name] is None and name in taken}
    elif not isinstance(given, CompGraphRunner):
        way_out = "Make a runner and run it: runner = CompGraphRunner(cg, hparams); runner.run(...)."
        raise Refused(f"An object of class {type(given).__name__} can't be promoted. {way_out}")
    return {
        name: as_written(adapter) for name, adapter in adapters.items() if adapter is not None and not is_usual(adapter)
    }


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
    adapters: Mapping[str, Callable[..., Any]],
    outputs: Sequence[str] | None,
    samples: Iterable[Any],
) -> Settings:
    """Write all that can be written without running anything new; raise every reason against it at once."""
    if isinstance(given, Pipeline):
        runner, cg, attributes = given.runner, given.source_cg, dict(given.attributes)
    else:
        runner, cg, attributes = given, given.cg, {}
    wanted = cg.sink_tokens if outputs is None else tuple(outputs)
    for token in wanted:
        cg.require_token(token)
    hyperparameters, stored = store_hyperparameters(runner.current.own, MOST_NUMBERS)
    free = runner.free_source_tokens
    colours = _colours(cg, dict.fromkeys((*free, *wanted)), runner.last)
    pipeline = given if isinstance(given, Pipeline) and type(given) not in PIPELINES else None
    settings = Settings(
        target.name, free, wanted, hyperparameters, colours, writable_defaults(cg, hyperparameters), cg.types,
        own=(*adapters, *([MAKER] if pipeline is not None else ())), attributes=attributes, has_groups=bool(cg.groups),
        states=states_of(cg),
    )  # fmt: skip
    reasons = [*_unready(runner, wanted), *unwritable(hyperparameters), *unwritable(attributes, "Attribute")]
    module, files, refusals = write_module(cg, settings, adapters, pipeline)
    if reasons or refusals:
        raise PromotionRefused(target, [*reasons, *refusals])
    runs = [*_runs(runner, samples)]
    (draft / SAMPLES).mkdir(parents=True)
    (draft / MODULE).write_text(module, encoding="utf-8")
    write_settings(draft / SETTINGS, settings, cg)
    for each in (*files, stored):
        each.write(draft)
    for number, run in enumerate(runs):
        _record(draft / SAMPLES / f"{number:03}.npz", run, settings, adapters.get("f_out"))
    return settings


def _colours(cg: CompGraph, tokens: Iterable[str], run: Run | None) -> dict[str, ColourOrder]:
    """Return the order of colours of tokens; it is assumed of an image of which no function says it."""
    found = {}
    for token in tokens:
        if token in cg.colours:
            found[token] = cg.colours[token]
        elif run is not None and token in run and has_colours(run[token]):
            found[token] = ASSUMED
    return found


def _runs(runner: CompGraphRunner, samples: Iterable[Any]) -> Iterator[Run]:
    """Give the last run, then runs of further payloads; each goes on from the state that the one before has left.

    A service begins with the initial state: if no run began with that, one of the last payload does so in the end.
    """
    if runner.last is None:
        return  # as _unready has made sure, there is one
    last = run = runner.last
    initial = dict(clone_runner(runner).state)
    has_first = not any(differences(initial, dict(run.state_before)))
    yield run
    for number, sample in enumerate(samples.frames() if isinstance(samples, Video) else samples, 1):
        given = sample if isinstance(sample, Mapping) else dict.fromkeys(runner.free_source_tokens[:1], sample)
        run = _run_from(runner, with_images(given, runner.cg), run.state, f"Sample {number} can't be run")
        has_first = has_first or not any(differences(initial, dict(run.state_before)))
        yield run
    if not has_first:
        payload = {token: last[token] for token in runner.free_source_tokens}
        text = "A service begins with the initial state, and the last payload can't be run with it"
        yield _run_from(runner, payload, initial, text, f" {_NO_FIRST}")


def _run_from(
    runner: CompGraphRunner, payload: Mapping[str, Any], state: Mapping[str, Any], failure: str, way_out: str = ""
) -> Run:
    """Run a payload on a clone of a runner, from a state; a failure is refused in these words."""
    clone = clone_runner(runner)
    clone.state = state
    try:
        return clone.run_on(payload)
    except Exception as error:  # whatever a function raises on it
        raise Refused(
            f"{failure}: {type(error).__name__}: {error_message(error)}{'.' * bool(way_out)}{way_out}"
        ) from error


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

    for key, token in settings.states.items():
        for value in (run.state_before[key], run.state[key]):
            try:
                describe_message(value)
            except MessageError as error:
                text = f"State {key!r}, which token {token!r} leaves for the next run, can't be recorded: its {error}"
                raise Refused(text) from error
    inputs, outputs = ({token: run[token] for token in side} for side in (settings.inputs, settings.outputs))
    save = partial(save_sample, path, inputs, rgb=settings.rgb, state=run.state_before, state_after=run.state)
    answer = answer_of(f_out, settings.name, run, settings.attributes) if f_out is not None else None
    if answer is not None:
        # An answer without a codec can't be sent either.
        with contextlib.suppress(MessageError):
            return save({**outputs, ANSWER: answer})
    return save(outputs)


def _replace(draft: Path, target: Path) -> None:
    """Put the new bundle in the place of the old one; at every moment one of the two is there."""
    _check_place(target)
    if target.exists():
        swap_folders(draft, target)  # the old one is then in the scratch folder, and goes with it
    else:
        draft.rename(target)


# -- drafts ------------------------------------------------------------------------------------------------------------


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
    try:
        left.rename(right)
    except OSError:
        aside.rename(right)
        raise
    aside.rename(left)


# -- notebook files ----------------------------------------------------------------------------------------------------


def promote_notebook(
    notebook: str | Path,
    name: str,
    to: str | Path,
    outputs: Sequence[str] | None = None,
    on_cell: Callable[[int, int], None] = lambda done, total: None,
    on_progress: Callable[[str], None] = lambda text: None,
    samples: Sequence[str] = (),
) -> None:
    """Execute every cell of a notebook in a new kernel of this Python, then promote one of its objects there.

    Parameters
    ----------
    notebook
        An ``.ipynb`` file; it is not changed.
    name
        The variable that holds the runner or pipeline.
    to, outputs
        As for ``promote``.
    on_cell
        Called with the number of code cells done and their total.
    on_progress
        Called with what the promotion in the kernel is doing.
    samples
        The variables that hold further payloads, as ``promote`` takes them, or lists of such.

    Raises
    ------
    BundleError
        The file can't be read, or a cell raises; the cell is named.
    PromotionRefused
        The graph can't be promoted, or there is no such variable.
    """
    given = name, str(Path(to).resolve()), None if outputs is None else list(outputs), list(samples)
    last_cell = f"from epypes.bundle.promote import promote_here as _promote_here\n_promote_here{given!r}"
    reasons: list[str] = []

    def on_message(message: Mapping[str, Any]) -> None:
        if "progress" in message:
            on_progress(message["progress"])
        reasons.extend(message.get("reasons", ()))

    _execute_notebook(Path(notebook), last_cell, on_cell, on_message)
    if reasons:
        raise PromotionRefused(to, reasons)


def _execute_notebook(
    path: Path,
    last_cell: str,
    on_cell: Callable[[int, int], None],
    on_message: Callable[[Mapping[str, Any]], None],
) -> None:
    """Execute a notebook and one cell more, and pass on what is displayed with our media type."""
    with optional_import():
        import nbformat
        from nbclient import NotebookClient
        from nbclient.exceptions import CellExecutionError, DeadKernelError

    class Client(NotebookClient):  # type: ignore[misc]
        def process_message(self, msg: dict[str, Any], cell: Any, cell_index: int) -> Any:
            if _MEDIA_TYPE in msg["content"].get("data", ()):
                on_message(msg["content"]["data"][_MEDIA_TYPE])
            return super().process_message(msg, cell, cell_index)

    try:
        document = nbformat.read(path, as_version=4)
    except OSError as error:
        text = f"Notebook {path} can't be read: {error.strerror or error}. Name an .ipynb file that is there."
        raise BundleError(path, text) from error
    except Exception as error:  # nbformat raises its own and json's errors for what is no notebook
        reason = f"{type(error).__name__}: {error}".replace("\n", " ")[:120]
        text = f"{path} is not a notebook that Jupyter opens ({reason}). Name an .ipynb file that it does."
        raise BundleError(path, text) from error
    total = sum(cell.cell_type == "code" for cell in document.cells)
    document.cells.append(nbformat.v4.new_code_cell(last_cell))
    done = 0

    def cell_executed(cell: Any, cell_index: int, **_: Any) -> None:
        nonlocal done
        done += 1
        on_cell(min(done, total), total)

    with tempfile.TemporaryDirectory(prefix="epypes-promote-") as scratch:
        client = Client(
            document,
            timeout=None,
            kernel_name="python3",
            resources={"metadata": {"path": str(path.resolve().parent)}},
            on_cell_executed=cell_executed,
        )
        # Sockets in a folder of this user: over TCP others on the machine could listen.
        client.config.KernelManager.transport = "ipc"
        client.config.KernelManager.ip = str(Path(scratch) / "kernel")
        try:
            client.execute()
        except CellExecutionError as error:
            text = f"{path}: code cell {done} of {total} raised {error.ename}: {error.evalue}"
            way_out = "Change it so that all cells run from top to bottom."
            raise BundleError(path, f"{text.rstrip('.')}. {way_out}") from error
        except DeadKernelError as error:
            text = f"{path}: the kernel died in code cell {done + 1} of {total}. Run that cell in Jupyter to see why."
            raise BundleError(path, text) from error


def promote_here(name: str, to: str, outputs: Sequence[str] | None, samples: Sequence[str]) -> None:
    """Promote a variable of the notebook that this kernel runs; display the progress and the reasons against it."""
    from IPython.display import display

    def send(**message: Any) -> None:
        display({_MEDIA_TYPE: message}, raw=True)

    names = vars(sys.modules["__main__"])
    try:
        if name not in names:
            known = [key for key, value in names.items() if isinstance(value, CompGraphRunner | Pipeline)]
            raise UnknownName("variable", name, known, "that holds a runner or pipeline in the notebook")
        payloads = _payloads(names, samples)
        promote(names[name], to, outputs, samples=payloads, on_progress=lambda text: send(progress=text))
    except EpypesError as error:
        send(reasons=list(error.reasons) if isinstance(error, PromotionRefused) else [str(error)])


def _payloads(names: Mapping[str, Any], variables: Sequence[str]) -> list[Any]:
    """Return the payloads that variables hold: one, or those of a list or tuple."""
    found: list[Any] = []
    for name in variables:
        if name not in names:
            known = [key for key, value in names.items() if not key.startswith("_") and not callable(value)]
            raise UnknownName("variable", name, known, "that holds a payload in the notebook")
        found += names[name] if isinstance(names[name], list | tuple) else [names[name]]
    return found
