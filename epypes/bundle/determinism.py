"""Determinism of the functions, learnt from runs in the notebook, one after another, with a tolerance for noise.

Where all runs agree to the last bit, nothing is tolerated. Where floating-point numbers differ in less than half of
their digits, which is what summing in another order does, the tolerance is SAFETY times the largest difference seen.
Everything else is no noise, and refused: what draws random numbers, counts, or looks at a clock can't be verified.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.clone import clone_graph
from epypes.bundle.compare import Difference, Tolerance, differences, is_noise
from epypes.bundle.mutable_state import CodeSnapshot
from epypes.errors import BundleError, InputMutated
from epypes.graph import CompGraph, with_defaults
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.run import Run

RUNS: Final = 3
# The next run may be further off than the worst of a few; ten times that is far below any change of an algorithm.
SAFETY: Final = 10.0
# Noise goes up and down: 1 in 362,880 series of as many runs goes further away each time by chance.
_RUNS_OF_SUSPECTS: Final = 10
# What likely makes a function compute something else from the same inputs, and what to do about it.
_GROWS: Final = "Its result goes further away from run to run: it counts, keeps something, or looks at a clock."
_NOISE: Final = "Its floating-point results differ by noise, and what is made of them differs by more."
_SETTLED: Final = (
    "It computes the same whenever it is run now, but not what it did then: an array that it takes was written into "
    "since, or it keeps something."
)
_UNSTEADY: Final = "It draws random numbers without a seed, looks at a clock, or keeps something from run to run."
_WAYS_OUT: Final = {
    _GROWS: "Pass what it reads or keeps as a token.",
    _NOISE: "Round the noise away before it decides anything, or compute it in one thread: cv2.setNumThreads(1).",
    _SETTLED: "Run the graph again, on arrays that nothing writes into; what is kept is to be a token.",
    _UNSTEADY: "Pass a seed as a token and make the generator of it, as in np.random.default_rng(seed), or call "
    "cv2.setRNGSeed(seed) inside the function; a time and what is kept are to be tokens, too.",
}
LEARNT: Final = f"{counted(RUNS, 'more run')} in the notebook"
_MEANING: Final = (
    "{} gave other last digits: a replay may differ by {:g} times as",
    "much, and each number by no more than the relative part of its own magnitude.",
)
OnProgress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Learnt:
    """What the runs have shown.

    Attributes
    ----------
    tolerances
        By output token, for those that differ by noise.
    reasons
        Why outputs can't be verified; each names the first function that differs.
    """

    tolerances: Mapping[str, Tolerance]
    reasons: tuple[str, ...]


def learn(
    cg: CompGraph,
    hyperparameters: Mapping[str, Any],
    samples: Sequence[Run],
    outputs: Sequence[str],
    on_progress: OnProgress,
) -> Learnt:
    """Run the payload of each sample again, RUNS times, and compare every token with what the sample has.

    Parameters
    ----------
    cg, hyperparameters
        The graph, which is run by a runner of its own: that of the user stays as it is.
    samples
        Completed runs, with all tokens.
    outputs
        The tokens that are compared when the bundle is replayed.
    on_progress
        Called before each run with which one begins.

    Raises
    ------
    BundleError
        A function fails that did not fail before, or changes an object inside its input.
    """
    # Without its defaults, so that what was unfrozen is taken from the payload.
    runner = CompGraphRunner(with_defaults(clone_graph(cg), {}), hyperparameters, check_mutation=True)
    tolerances: dict[str, Tolerance] = {}
    reasons: list[str] = []
    snapshots = {name: CodeSnapshot({name: function}, lock=False) for name, function in cg.functions.items()}
    for number, sample in enumerate(samples, 1):
        of = f" of sample {number} of {len(samples)}" if len(samples) > 1 else ""
        seen = _Seen(runner, sample, lambda text, of=of: on_progress(text + of))  # type: ignore[misc]
        for token, found in seen.unlike.items():
            if token in outputs and is_noise(found) and token not in seen.growing():
                relative = max(place.relative for place in found)
                tolerances[token] = widened(tolerances.get(token), _distance(found), relative)
        reason = seen.reason(outputs)
        reasons += [reason] if reason and reason not in reasons else []
    changed = {name: snapshot.changed() for name, snapshot in snapshots.items()}
    changes = [
        f"Function {name!r} changes {known!r} from run to run, which outlives the call: the next event would find it "
        "different. Copy it first, or make it a token."
        for name, known in changed.items()
        if known is not None
    ]
    return Learnt(tolerances, tuple(reasons or changes))


class _Seen:
    """What runs of one sample have shown: by token every place where a run differs from the sample."""

    def __init__(self, runner: CompGraphRunner, sample: Run, on_progress: OnProgress) -> None:
        self._runner, self._sample, self._on_progress = runner, sample, on_progress
        self._first: Run | None = None
        self.unlike: dict[str, list[Difference]] = {}
        # How far each run is from the first of them, by token.
        self._distances: dict[str, list[float]] = {}
        # The tokens in which the runs differ from each other.
        self._unsteady: set[str] = set()
        for number in range(RUNS):
            self._run(number + 1, RUNS)
        for number in range(RUNS, _RUNS_OF_SUSPECTS):
            if not self.growing():
                break
            self._run(number + 1, _RUNS_OF_SUSPECTS)

    def _run(self, number: int, of: int) -> None:
        self._on_progress(f"running the functions again to learn what they repeat: {number} of {of}")
        sample = self._sample
        try:
            run = self._runner.run(**{token: sample[token] for token in self._runner.free_source_tokens})
        except InputMutated as error:
            raise BundleError("", str(error)) from error
        except Exception as error:
            failure = self._runner.last and self._runner.last.failure
            where = f"function {failure.function!r}" if failure else "a function"
            text = (
                f"Run again on the same payload, {where} raised {type(error).__name__}: {error}. "
                "It keeps something from run to run, or needs what is there once. Make that a token."
            )
            raise BundleError("", text) from error
        self._first = self._first or run
        for token in run:
            if token in sample:
                self.unlike.setdefault(token, []).extend(differences(sample[token], run[token]))
                apart = [*differences(self._first[token], run[token])]
                self._distances.setdefault(token, []).append(_distance(apart))
                self._unsteady |= {token} if apart else set()
        self.unlike = {token: found for token, found in self.unlike.items() if found}

    def growing(self) -> frozenset[str]:
        """Return the tokens whose differences grow from run to run."""
        return frozenset(token for token in self.unlike if _grows(self._distances[token]))

    def reason(self, outputs: Sequence[str]) -> str:
        """Return why the outputs can't be verified, with the first function that differs; "" if they can."""
        growing = self.growing()
        bad = [
            token
            for token in outputs
            if token in self.unlike and (token in growing or not is_noise(self.unlike[token]))
        ]
        if not bad:
            return ""
        cg = self._runner.cg
        name = next(name for name in cg.func_io if any(token in self.unlike for token in cg.func_outputs(name)))
        token = next(token for token in cg.func_outputs(name) if token in self.unlike)
        also = f" So {', '.join(map(repr, bad))} can't be verified." if bad != [token] else ""
        if token in growing:
            cause = _GROWS
        elif is_noise(self.unlike[token]):
            cause = _NOISE
        else:
            cause = _UNSTEADY if token in self._unsteady else _SETTLED
        return (
            f"Function {name!r} does not compute the same again from the same inputs: token {token!r}: "
            f"{self.unlike[token][0].text}. {cause}{also} {_WAYS_OUT[cause]}"
        )


def _distance(found: Sequence[Difference]) -> float:
    """Return how far apart two values are; 0.0 for what is no number."""
    return max((place.largest or 0.0 for place in found), default=0.0)


def _grows(distances: Sequence[float]) -> bool:
    """Whether a value went further from that of the first run at every run, as a clock does."""
    later = distances[1:]
    return 0.0 not in later and all(left < right for left, right in itertools.pairwise(later))


def widened(known: Tolerance | None, absolute: float, relative: float) -> Tolerance:
    """Return a tolerance that covers what was known before, and differences with the factor of safety."""
    # Two digits are enough, rounded up: the file is read by people, and small changes of the noise don't change it.
    absolute, relative = _rounded_up(SAFETY * absolute), _rounded_up(SAFETY * relative)
    if known is None:
        return Tolerance(absolute, relative)
    return Tolerance(max(absolute, known.absolute), max(relative, known.relative))


def _rounded_up(number: float) -> float:
    if number == 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(number)))
    return float(f"{math.ceil(number / step) * step:.0e}")


def add_tolerances(document: Any, tolerances: Mapping[str, Tolerance], origin: str = LEARNT) -> None:
    """Add tolerances to the document of pipeline.toml, with a comment of what they mean, in the place of former ones.

    Parameters
    ----------
    document
        The document of tomlkit.
    tolerances
        By token.
    origin
        What has shown the noise.
    """
    with optional_import():
        import tomlkit

    if not tolerances:
        return
    entries = document.setdefault("tolerance", tomlkit.table(is_super_table=True))
    for token, tolerance in tolerances.items():
        entry = tomlkit.table()
        for line in _MEANING:
            entry.add(tomlkit.comment(line.format(origin, SAFETY)))
        entry.add("absolute", tolerance.absolute)
        entry.add("relative", tolerance.relative)
        entries[token] = entry


def read_tolerances(document: Mapping[str, Any]) -> dict[str, Tolerance]:
    """Return the tolerances of pipeline.toml.

    Raises
    ------
    KeyError, TypeError
        An entry lacks a bound, or has one that is no number of 0 or more.
    """
    found = {}
    for token, entry in document.get("tolerance", {}).items():
        bounds = (entry["absolute"], entry["relative"])
        if not all(type(bound) in (int, float) and 0 <= bound < math.inf for bound in bounds):
            raise TypeError(f"the tolerance of {token!r} is {bounds!r}, not two numbers of 0 or more")
        found[token] = Tolerance(*map(float, bounds))
    return found
