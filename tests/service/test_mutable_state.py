"""The answers of a service do not depend on earlier events."""

from __future__ import annotations

import pytest

from tests.service.bundles import written_bundle
from tests.service.served import serving

SOURCE = """
    import functools

    import numpy as np

    acc, weights = [], np.zeros(2)


    @functools.lru_cache
    def table(n):
        return [n]


    def f(what, x):
        if what == "list":
            acc.append(x)
        elif what == "array":
            np.multiply(x, 2, weights)
        elif what == "cached":
            table(3).append(x)
        return x + 1000 * len(acc) + int(weights.sum()) + 1000 * len(table(3))


    func_dict = {"f": f}
    func_io = {"f": (("what", "x"), "y")}
"""


FAILURES = {
    1: "StateChanged: Function 'f' changed 'acc', which outlives the call",
    3: "ValueError: output array is read-only",
    5: "StateChanged: Function 'f' changed 'table', which outlives the call",
}


@pytest.mark.slow
def test_an_event_that_changes_what_outlives_it_fails_and_the_next_answers_are_as_before(tmp_path):
    sample = {"what": "plain", "x": 1}, {"y": 1001}
    bundle = written_bundle(tmp_path / "b", SOURCE, ["what", "x"], ["y"], sample=sample)
    with serving(bundle, threads=2) as (_, peer):
        for _ in range(4):
            answers = {}
            for x, what in enumerate(["plain", "list", "plain", "array", "plain", "cached", "plain"]):
                answers[peer.send_parts(what=what, x=x)] = x
            for answer in peer.take(len(answers)):
                x = answers.pop(answer.correlation_id)
                if x in FAILURES:
                    text = f"{answer.failure.exception}: {answer.failure.message}"
                    assert text.startswith(FAILURES[x])
                else:
                    assert answer.failure is None
                    assert answer.parts["y"] == 1000 + x
            assert not answers
