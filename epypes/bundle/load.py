"""Loading: a bundle becomes a runner or a pipeline again."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from epypes.bundle.adapters import answer_with, own_part, payload_of
from epypes.bundle.arrays import StoredArray, read_array
from epypes.bundle.manifest import (
    MODULE,
    OWN_MODULES,
    REQUIREMENTS,
    SAMPLES,
    SETTINGS,
    bundle_files,
    check_manifest,
)
from epypes.bundle.private_import import PrivateImport
from epypes.bundle.proof.mutable_state import MutableState
from epypes.bundle.settings import Settings, read_settings, states_of
from epypes.errors import BundleError
from epypes.graph import CompGraph, group, with_defaults
from epypes.pipeline import FullPipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import called_for

MAKER: Final = "make_pipeline"
MODULES_OF_A_BUNDLE: Final = (
    "A bundle imports installed packages, and the modules of the project that its code named when it was promoted: "
    f"install what its {REQUIREMENTS} lists, or import the module by name and promote it again"
)
WITH_DELAYS: Final = "with_delays"


@dataclass(frozen=True, slots=True, repr=False)
class Bundle:
    """A bundle that was read.

    Attributes
    ----------
    path
        Its folder.
    cg
        Its graph.
    settings
        What stands in pipeline.toml.
    digest
        Its digest; empty if its manifest was not compared.
    own
        What its module has of its own in place of the usual adapters and pipeline, by the names in ``settings.own``.
    enums
        The enumerations whose members are values of hyperparameters, by name.
    """

    path: Path
    cg: CompGraph
    settings: Settings
    digest: str
    own: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    enums: Mapping[str, Any] = field(default_factory=dict)

    @property
    def samples(self) -> tuple[Path, ...]:
        """The files of its samples, sorted."""
        return tuple(sorted((self.path / SAMPLES).glob("*.npz")))

    def __repr__(self) -> str:
        ends = f"{', '.join(self.settings.inputs)} -> {', '.join(self.settings.outputs)}"
        return f"<Bundle {self.settings.name!r:.30}: {ends:.40}>"


def read_bundle(path: str | Path, *, compare: bool = True) -> Bundle:
    """Read a bundle; its module's code is executed.

    Parameters
    ----------
    path
        Its folder.
    compare
        Whether its files have to be those of its manifest.

    Raises
    ------
    BundleError
        A file was changed, is missing, was added or can't be read, or the folder is no bundle.
    GraphError
        The graph in its module is not valid.
    """
    folder = Path(path).resolve()
    while True:
        before = _identity(folder)
        try:
            digest = check_manifest(folder) if compare else ""
            files = bundle_files(folder)
            if MODULE not in files:
                raise BundleError(folder, f"{folder} has no {MODULE}. Promote the graph again.")
            for file in files:
                if file.endswith(".npy") and not file.startswith(f"{OWN_MODULES}/"):
                    read_array(folder / file, "r")
            module = _imported(folder)
            enums = getattr(module, "enums", {})
            settings = read_settings(folder / SETTINGS, enums)
            values = {
                token: read_array(folder / value.file) if type(value) is StoredArray else value
                for token, value in settings.hyperparameters.items()
            }
        except Exception:  # whatever the module's own code raises
            if _identity(folder) == before:
                raise
            continue
        # A promotion swaps another folder in: then what was read, also by the module, may be of both.
        if _identity(folder) == before:
            break
    needed = ("func_dict", "func_io", *(("func_groups",) if settings.has_groups else ()), *settings.own)
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        names = ", ".join(map(repr, missing))
        text = f"{folder / MODULE} defines no {names}, which the bundle needs. Promote the graph again."
        raise BundleError(folder, text)
    own = {name: own_part(module, name) for name in settings.own}
    adapters = {name: adapter for name, adapter in own.items() if name != MAKER}
    state = MutableState({**module.func_dict, **adapters}, values)
    cg = _graph(module, state.guarded(module.func_dict), settings)
    if states_of(cg) != settings.states:
        names = ", ".join(map(repr, states_of(cg).items() ^ settings.states.items()))
        text = f"{folder / SETTINGS} and {MODULE} name other states between runs: {names}. Promote the graph again."
        raise BundleError(folder, text)
    own |= {name: called_for(name, adapter) for name, adapter in state.guarded(adapters).items()}
    return Bundle(folder, cg, replace(settings, hyperparameters=values), digest, own, enums)


def _imported(folder: Path) -> Any:
    """Execute a bundle's module; what it can't import is named with the way out."""
    path = folder / MODULE
    try:
        return PrivateImport(folder).execute(path)
    except ImportError as error:
        frames = [
            frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))
        ]
        path = Path(frames[-1].filename) if frames else path
        where = f" at line {frames[-1].lineno}, {frames[-1].line!r}" if frames else ""
        text = f"{path} can't be imported{where}: {type(error).__name__}: {error}. {MODULES_OF_A_BUNDLE}."
        raise BundleError(folder, text) from error


def _graph(module: Any, functions: Mapping[str, Callable[..., Any]], settings: Settings) -> CompGraph:
    cg = CompGraph(functions, module.func_io, types=settings.types)
    if settings.has_groups:
        for name, functions in module.func_groups.items():
            cg = group(cg, name, functions)
    if settings.states and hasattr(module, WITH_DELAYS):  # a nested pipeline has its own
        cg = module.with_delays(cg)
    return with_defaults(cg, settings.defaults)


def _identity(folder: Path) -> tuple[int, int] | None:
    """Return what a folder has in common with no other of its name, also none that was there before."""
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_ino, found.st_ctime_ns


def load(path: str | Path) -> CompGraphRunner:
    """Return a runner with a bundle's graph and hyperparameters, and the initial state of its delays.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    bundle = read_bundle(path)
    return CompGraphRunner(bundle.cg, bundle.settings.hyperparameters)


def load_pipeline(path: str | Path, q_in: Any, q_out: Any) -> FullPipeline:
    """Return the FullPipeline that ``epypes serve`` runs; its delays begin with their initial values.

    Parameters
    ----------
    path
        The bundle's folder.
    q_in
        Gives Envelopes whose parts are the bundle's input tokens; or what the bundle's own f_in takes.
    q_out
        Gets Envelopes whose parts are its output tokens; or what its own f_out makes.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    return pipeline_of(read_bundle(path), q_in, q_out)


def pipeline_of(bundle: Bundle, q_in: Any, q_out: Any, *, detach: bool = True) -> FullPipeline:
    """Return the FullPipeline of a bundle that was read.

    Parameters
    ----------
    bundle
        The bundle.
    q_in, q_out
        As for :func:`load_pipeline`.
    detach
        Whether answers are copies, for a ``q_out`` that keeps them while the next event is worked on.
    """
    settings, own = bundle.settings, bundle.own
    f_in = own.get("f_in") or payload_of(settings.inputs, settings.rgb)
    f_out = own.get("f_out") or answer_with(settings.outputs, bundle.digest, settings.rgb, detach=detach)
    make = own.get(MAKER)
    if make is None:
        pipeline = FullPipeline(settings.name, bundle.cg, q_in, q_out, f_in, f_out, settings.hyperparameters)
    else:
        pipeline = make(bundle.cg, q_in, q_out, f_in, f_out, settings.hyperparameters)
    pipeline.attributes.update(settings.attributes)
    return pipeline
