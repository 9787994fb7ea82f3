"""How does another runner begin where one stands?"""

from __future__ import annotations

import threading
from copy import copy

from epypes.run.report import Reports
from epypes.run.runner import CompGraphRunner
from epypes.run.trials import Trials
from epypes.run.watchers import Watchers


def branched(runner: CompGraphRunner) -> CompGraphRunner:
    """Return a runner with the hyperparameters and the last run of another one, that goes its own way from there.

    Both share values and what is compiled, and no state: each may be used on a thread of its own.
    """
    hparams, last = runner._state
    branch = copy(runner)
    branch._lock, branch._trials, branch._watchers = threading.Lock(), Trials(), Watchers()
    branch._hparams, branch.last, branch.reports = hparams, last, Reports()
    return branch
