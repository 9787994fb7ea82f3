"""How is the same work done with EPypes?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import epypes as ep
from tests.benchmarks.work import Work


def runner(work: Work, **options: Any) -> ep.CompGraphRunner:
    return ep.CompGraphRunner(ep.CompGraph(work.functions, work.io), work.hparams, **options)


def run(work: Work, **options: Any) -> Callable[[], Any]:
    """Return a call that runs the graph on the payload and reads the target, as every contender's call does."""
    made, payload, target = runner(work, **options), work.payload, work.target
    return lambda: made.run(**payload)[target]


def first_result(work: Work) -> Any:
    return runner(work).run(**work.payload)[work.target]
