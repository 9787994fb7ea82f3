"""How is a runner brought before a function that must not be called, since it is known to kill or to hang?"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any

from epypes.run.attempt import ended
from epypes.run.call import StepFailed
from epypes.run.draft import Draft
from epypes.run.record import Run

if TYPE_CHECKING:
    from epypes.run.runner import CompGraphRunner


def stop_at(
    runner: CompGraphRunner, payload: Mapping[str, Any], function: str | None = None, why: BaseException | None = None
) -> Run:
    """Run what a function needs, and have it fail without being called; the run becomes the runner's last.

    ``rerun`` goes on from there, and calls it.

    Parameters
    ----------
    payload
        The free source tokens by name.
    function
        Without, no function at all is called, and the run has the payload alone.
    why
        What the function fails with. If one that it needs fails, the run is that one's.

    Raises
    ------
    PayloadError, PlaceholderNeeded, UnknownName
        As ``run`` does.
    """
    start_ns = perf_counter_ns()
    hparams, program = runner._state[0], runner._program
    before = _before(runner, payload, function)
    if before is not None and before.failure is not None:
        runner.adopt(before)
        return before
    places = {step.name: step.place for step in program.steps}
    if before is None:
        values = hparams.with_payload(payload)
        draft, durations_ns = Draft.of_sources(program, values, len(payload) == len(hparams.free_slots)), {}
    else:
        draft = Draft.after(before.tokens)
        durations_ns = {places[name]: spent_ns for name, spent_ns in before.report.durations_ns.items()}
    failed = None if function is None or why is None else StepFailed(places[function], why, 0)
    outcome = ended(draft, failed, bytes(len(program.steps)), durations_ns, start_ns, False)
    try:
        return runner._ended(outcome, hparams)
    except BaseException as raised:
        if raised is not why or runner.last is None:
            raise
        return runner.last


def _before(runner: CompGraphRunner, payload: Mapping[str, Any], function: str | None) -> Run | None:
    """Run what a function needs; None if that are source tokens alone."""
    if function is None:
        return None
    made = [token for token in runner.cg.func_inputs(function) if token not in runner.cg.source_tokens]
    return runner.trial({}, *made, payload=payload) if made else None
