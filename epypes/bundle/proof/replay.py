"""The replay of a bundle's samples in this process, compared with what was recorded.

The samples of a graph with state are a sequence: a sample goes on from the state that the one before has left, if it
was recorded so. Each also holds the state that it began with, so that it can be replayed alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from epypes.bundle.adapters import ANSWER, answer_of
from epypes.bundle.load import Bundle, pipeline_of
from epypes.bundle.manifest import environment
from epypes.bundle.proof.compare import Difference, difference, differences, largest_of
from epypes.errors import BundleError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.wire.samples import Sample, read_sample, save_sample
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
    fingerprints
        Digests of the functions and of what they refer to, as the import of the module made them.
    draws, seeds
        By function the random generators of the whole process that it draws from without a seed, with the name by which
        it draws; and those that it seeds.
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
    fingerprints: Mapping[str, str] = field(default_factory=dict)
    draws: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    seeds: Mapping[str, Sequence[str]] = field(default_factory=dict)

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
        call is something else then. That time each begins with its recorded state, not with what another one has left,
        and it is also checked that no function changes an object in its input.
    on_run
        Called before each of these runs.
    """
    pipeline_of(bundle, None, None)  # what serves it can be made
    # By sample and token: what each pass found.
    table: dict[Path, dict[str, list[Difference | None]]] = {path: {} for path in bundle.samples}
    for is_second in (False, True) if twice else (False,):
        left = None
        for path in reversed(bundle.samples) if is_second else bundle.samples:
            if on_run is not None:
                on_run()
            sample = _sample(bundle, path)
            state = sample.state if is_second else _beginning(sample, left)
            values, after = _run(bundle, sample, state, check_mutation=is_second)
            left = sample, after
            for token, found in _compared(bundle, path.stem, sample, values, after).items():
                table[path].setdefault(token, []).append(found)
    explained = [
        entry
        for path, passes in table.items()
        if any(any(found) for found in passes.values())
        for entry in _explained(bundle, path, passes)
    ]
    tokens = sum(map(len, table.values()))
    return ReplayReport(len(table), tokens, tuple(explained), environment=environment())


def _sample(bundle: Bundle, path: Path) -> Sample:
    """Return a sample, whose tokens and states are those of the bundle.

    Raises
    ------
    BundleError
        They are others.
    """
    sample, settings = read_sample(path), bundle.settings
    text = ""
    if (set(sample.inputs), sample.outputs.keys() - {ANSWER}) != (set(settings.inputs), set(settings.outputs)):
        tokens = f"{', '.join(sample.inputs) or 'nothing'} -> {', '.join(sample.outputs)}"
        text = f"Sample {path.stem} has the tokens {tokens}, which are not those of pipeline.toml. Promote again."
    elif not sample.state.keys() == sample.state_after.keys() == settings.states.keys():
        states = ", ".join(sample.state) or "none"
        text = f"Sample {path.stem} has the states {states}, which are not those of pipeline.toml. Promote again."
    if text:
        raise BundleError(path, text)
    return sample


def _beginning(sample: Sample, left: tuple[Sample, Mapping[str, Any]] | None) -> Mapping[str, Any]:
    """Return the state with which a sample is replayed: its own, or what the replay of the one before has left.

    ``left`` is the sample before and the state after it; it is passed on if the sample was recorded after that one.
    """
    if left is None or any(differences(left[0].state_after, sample.state)):
        return sample.state
    return left[1]


def _compared(
    bundle: Bundle, name: str, sample: Sample, values: Mapping[str, Any], after: Mapping[str, Any]
) -> dict[str, Difference | None]:
    """Return by token what is not as it was recorded, also of the tokens that are kept for the next run."""
    tolerances = bundle.settings.tolerances
    compared = {
        token: difference(name, token, differences(expected, values[token], tolerances.get(token)))
        for token, expected in sample.outputs.items()
    }
    for key, token in bundle.settings.states.items():
        entry = difference(name, token, differences(sample.state_after[key], after[key], tolerances.get(token)))
        kept = entry and replace(entry, text=f"{entry.text} (kept as {key!r} for the next run)")
        compared[token] = compared.get(token) or kept
    return compared


def record_again(bundle: Bundle) -> ReplayReport:
    """Run a bundle's samples in this process, in order, and record their outputs."""
    left = None
    for path in bundle.samples:
        sample = _sample(bundle, path)
        before = _beginning(sample, left)
        values, after = _run(bundle, sample, before)
        left = sample, after
        outputs = {name: values[name] for name in sample.outputs}
        save_sample(path, sample.inputs, outputs, rgb=bundle.settings.rgb, state=before, state_after=after)
    return ReplayReport(len(bundle.samples), 0, ())


def _run(
    bundle: Bundle, sample: Sample, state: Mapping[str, Any], *, check_mutation: bool = False
) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """Return the values of a new run by token, and the state after it.

    Among the values are the tokens that nested pipelines keep, and the answer that is made of the run where that is
    among the outputs.
    """
    settings = bundle.settings
    runner = CompGraphRunner(bundle.cg, settings.hyperparameters, check_mutation=check_mutation)
    runner.state = state
    run = runner.run(**sample.inputs)
    values = {**{token: run.state[key] for key, token in settings.states.items()}, **run}
    if ANSWER in sample.outputs:
        values[ANSWER] = answer_of(bundle.own["f_out"], settings.name, run, settings.attributes)
    return values, run.state


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
    sample = read_sample(path)
    first: dict[str, Any] = {}
    distances: dict[str, list[float]] = {}
    for number in range(_MOST_RUNS):
        values, _ = _run(bundle, sample, sample.state)
        first = first or values
        for token, value in values.items():
            found = difference("", token, differences(first[token], value))
            distances.setdefault(token, []).append((found.largest or math.inf) if found else 0.0)
        if number > 1 and not any(map(_is_growing, distances.values())):
            break
    return distances


def _is_growing(distances: Sequence[float]) -> bool:
    return all(left < right for left, right in pairwise(distances))


def _origin(cg: CompGraph, token: str, unsteady: Collection[str], passed: frozenset[str] = frozenset()) -> str:
    """Return the first function on the way to a token that computes something else each time.

    A value that another run has left is followed last, and no delay twice.
    """
    if token == ANSWER:
        return "f_out"
    if token in cg.delays:
        return _origin(cg, cg.delays[token].token, unsteady, passed | {token})
    name = cg.digraph.producer.get(token) or next((name for name in cg.functions if token.startswith(f"{name}.")), "")
    inputs = cg.func_inputs(name) if name else ()
    ways = [given for given in inputs if given in unsteady and given not in passed]
    before = next(iter(sorted(ways, key=cg.delays.__contains__)), None)
    return name if before is None else _origin(cg, before, unsteady, passed)
