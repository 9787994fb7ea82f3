"""The replay of a bundle's samples in this process, compared with what was recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from epypes.bundle.adapters import ANSWER, answer_of
from epypes.bundle.compare import Difference, difference, differences, largest_of
from epypes.bundle.load import Bundle, pipeline_of
from epypes.bundle.manifest import environment
from epypes.errors import BundleError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.wire.samples import load_sample, save_sample
from epypes.wording import counted

# Noise goes up and down: 1 in 362,880 series of as many runs goes further away each time by chance.
_MOST_RUNS: Final = 10


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
    libraries
        What their modules hold, by module and attribute, if that was asked for.
    changes
        What the functions have changed in libraries, as sentences.
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
    libraries: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    changes: Sequence[str] = ()
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


def replay(bundle: Bundle, *, twice: bool = False, on_run: Callable[[], object] | None = None) -> ReplayReport:
    """Replay a bundle's samples in this process.

    Parameters
    ----------
    bundle
        The bundle.
    twice
        Whether every sample is replayed a second time, in the opposite order: what a function remembers from call to
        call is something else then. That time it is also checked that no function changes an object in its input.
    on_run
        Called before each of these runs.
    """
    pipeline_of(bundle, None, None)  # what serves it can be made
    # By sample and token: what each pass found.
    table: dict[Path, dict[str, list[Difference | None]]] = {path: {} for path in bundle.samples}
    for is_second in (False, True) if twice else (False,):
        for path in reversed(bundle.samples) if is_second else bundle.samples:
            if on_run is not None:
                on_run()
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
