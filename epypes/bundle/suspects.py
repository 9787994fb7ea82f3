"""Why would a function compute something else from the same inputs? Told by what it calls, as far as that shows."""

from __future__ import annotations

from collections.abc import Iterator
from types import CodeType
from typing import Any, Final

# fmt: off
_RANDOM: Final = frozenset((
    "random", "rand", "randn", "randint", "randrange", "random_sample", "default_rng", "RandomState", "shuffle",
    "permutation", "choice", "choices", "sample", "uniform", "normal", "gauss", "standard_normal", "kmeans", "randu",
    "randShuffle", "setRNGSeed", "uuid1", "uuid4", "urandom", "token_bytes",
))
_TIME: Final = frozenset((
    "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time", "now", "today",
    "utcnow", "getTickCount", "localtime", "gmtime",
))
# fmt: on
DRAWS: Final = "It draws random numbers."
CLOCK: Final = "It looks at a clock."
GROWS: Final = "Its result goes further away from run to run: it counts, keeps something, or looks at a clock."
NOISE: Final = "Its floating-point results differ by noise, and what is made of them differs by more."
SETTLED: Final = (
    "It computes the same whenever it is run now, but not what it did then: an array that it takes was written into "
    "since, or it keeps something."
)
UNKNOWN: Final = "It draws random numbers without a seed, or keeps something from run to run."


def suspicion(function: Any, *, grows: bool, is_noise: bool, is_settled: bool) -> str:
    """Return as a sentence what a function likely does that makes its results differ.

    Parameters
    ----------
    function
        The function; it is looked at, not called.
    grows
        Whether its result went further and further away.
    is_noise
        Whether its own results differ by no more than noise.
    is_settled
        Whether it computed the same in all runs but the one that is promoted.
    """
    if grows:
        return GROWS
    if is_noise:
        return NOISE
    if is_settled:
        return SETTLED
    called = {*_names(function)}
    if called & _RANDOM:
        return DRAWS
    return CLOCK if called & _TIME else UNKNOWN


def way_out(suspected: str) -> str:
    """Return what to do about it."""
    if suspected in (GROWS, CLOCK):
        return "Pass what it reads or keeps as a token."
    if suspected == SETTLED:
        return "Run the graph again, on arrays that nobody writes into; what is kept is to be a token."
    if suspected == NOISE:
        return "Round the noise away before it decides anything, or compute it in one thread: cv2.setNumThreads(1)."
    return (
        "Pass a seed as a token and make the generator of it, as in np.random.default_rng(seed), or call "
        "cv2.setRNGSeed(seed) inside the function; what is kept is to be a token, too."
    )


def _names(function: Any) -> Iterator[str]:
    """Yield the names that a function uses in its own code, and its own name and class where it has none."""
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    if isinstance(code, CodeType):
        yield from _names_in(code)
        return
    for part in (function, getattr(function, "__self__", None)):
        for name in (getattr(part, "__module__", None), getattr(part, "__name__", None), type(part).__name__):
            yield from str(name).replace("_", ".").split(".")
            yield str(name)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_in(constant)
