"""State between events under load, while the worker is killed again and again: the answers are those of a run without."""

from __future__ import annotations

import os
import random
import signal
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

import epypes as ep
from tests.service.bundles import written_bundle
from tests.service.served import event, serving, until

pytestmark = pytest.mark.slow

SOURCE = """
    import numpy as np

    import epypes as ep


    def smooth(what, number, before):
        if what == "fail":
            raise ValueError(number)
        picture = np.random.default_rng(number).random((40, 50))
        return picture if before is None else 0.9 * before + 0.1 * picture


    def check(what, smoothed):
        if what == "fail late":
            raise ValueError("late")
        return smoothed.sum(), smoothed[3, 4]


    def with_delays(cg):
        return ep.delay(cg, "smoothed", "before", initial=None)


    func_dict = {"smooth": smooth, "check": check}
    func_io = {"smooth": (("what", "number", "before"), "smoothed"), "check": (("what", "smoothed"), ("sum", "pixel"))}
"""
# Events that are sent and not answered, at most.
WINDOW = 20
BETWEEN_KILLS = 25


@pytest.fixture(scope="module")
def smoothing(tmp_path_factory):
    """A bundle that smooths noise over its events."""
    first = np.random.default_rng(3).random((40, 50))
    return written_bundle(
        tmp_path_factory.mktemp("chaos") / "smoothing",
        SOURCE,
        ("what", "number"),
        ("sum", "pixel"),
        sample=({"what": "plain", "number": 3}, {"sum": first.sum(), "pixel": first[3, 4]}),
        states={"before": "smoothed"},
        state=({"before": None}, {"before": first}),
    )


def what_of(number):
    """One event in ten fails, before its state is computed or after."""
    return {3: "fail", 7: "fail late"}.get(number % 20, "plain")


def undisturbed(bundle, numbers):
    """Return what the graph answers in this process, None for an event that fails."""
    runner, found = ep.load(bundle), []
    for number in numbers:
        before = runner.state
        try:
            run = runner.run(what=what_of(number), number=number)
            found.append((run["sum"], run["pixel"]))
        except ValueError:
            runner.state = before
            found.append(None)
    return found


@pytest.mark.parametrize("kills", [12, pytest.param(60, marks=pytest.mark.soak)])
@pytest.mark.parametrize("options", [{}, {"state_per": "source", "threads": 3}], ids=["one", "source"])
def test_the_answers_are_those_of_a_service_whose_worker_is_not_killed(smoothing, quick, kills, options):
    count, chance = (kills + 1) * BETWEEN_KILLS, random.Random(kills)
    sources = ["left", "middle", "right"] if options else [""]
    answers, sent, killed = [], {}, set()
    with serving(smoothing, retries=1_000, mailbox_size=4 * WINDOW, **options) as (service, peer):
        number, next_kill = 0, 1
        while len(answers) < count:
            while number < count and number - len(answers) < WINDOW:
                request = replace(event(what_of(number), number), source=sources[number % len(sources)])
                sent[request.id] = request
                peer.requests.put(request)
                number += 1
            answers += peer.take()
            if len(answers) >= next_kill and len(killed) < kills:
                until(lambda: service.info()["worker_pid"] not in {None, *killed})
                worker = service.info()["worker_pid"]
                os.kill(worker, signal.SIGKILL)
                killed.add(worker)
                next_kill = len(answers) + chance.randrange(1, 2 * BETWEEN_KILLS)
        counts = service.counts()
    assert len(killed) >= kills // 2
    assert counts["retried"] > kills // 4
    assert (counts["dropped"], counts["dead_letters"]) == (0, 0)
    by_source = defaultdict(list)
    for answer in answers:
        request = sent.pop(answer.correlation_id)
        found = None if answer.failure else (answer.parts["sum"], answer.parts["pixel"])
        by_source[request.source].append((request.parts["number"], found))
    for place, source in enumerate(sources):
        numbers = range(place, count, len(sources))
        assert [number for number, _ in by_source[source]] == list(numbers)
        assert [found for _, found in by_source[source]] == undisturbed(smoothing, numbers)
