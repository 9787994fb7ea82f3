"""Groups of replicas on each real broker: what a log and a broadcast are there."""

from __future__ import annotations

import itertools
import signal
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from time import monotonic

import pytest

from epypes.errors import RevisionConflict
from epypes.service import Service
from epypes.transport.channels import place_of
from epypes.wire import Envelope
from tests.brokers import nats as nats_server
from tests.service.group.test_agreement import group_of, started
from tests.service.served import TIMEOUT_S, until

pytestmark = pytest.mark.slow

_numbers = itertools.count(1)


@pytest.fixture
def place(broker):
    """A place of its own."""
    return place_of(broker.address(f"group{next(_numbers)}", create=True))


def test_replicas_agree_and_who_comes_late_knows_it(place):
    first, second, late = group_of(place)
    with started(first, second):
        for k in range(3, 8):
            assert first.set(k).revision == k - 2
        until(lambda: second.shown() == (5, 7))
        with started(late):
            assert late.shown() == (5, 7)
            assert late.set(8, 5).revision == 6
            until(lambda: first.shown() == second.shown() == (6, 8))


def test_changes_at_once_are_made_by_all_or_by_none(place):
    replicas = group_of(place)
    with started(*replicas), ThreadPoolExecutor(3) as pool:
        for before in range(8):
            until(lambda before=before: [each.shown()[0] for each in replicas] == [before] * 3)

            def change(number, before=before):
                try:
                    return replicas[number].set(10 * before + number + 100, before).revision
                except RevisionConflict:
                    return None

            assert Counter(pool.map(change, range(3))) == {before + 1: 1, None: 2}
        until(lambda: len({each.shown() for each in replicas}) == 1)
        (late,) = group_of(place, 1)
        with started(late):
            until(lambda: late.shown() == replicas[0].shown())


def test_others_hear_of_what_is_done_and_answers_keep_their_order(place):
    first, second = replicas = group_of(place, 2, timeout_s=TIMEOUT_S)
    events = [Envelope(type="x", sequence=number, source="camera", epoch=1) for number in range(1, 61)]
    with started(*replicas):
        for replica, own in ((first, events[0::2]), (second, events[1::2])):
            for event in reversed(own):
                replica.finish(event)
            assert replica.passed == sorted(replica.passed)
        until(lambda: len(first.passed) + len(second.passed) == len(events))
        until(lambda: len(first.seen) == len(second.seen) == 30)
        assert set(first.seen) == {event.id for event in events[1::2]}
        assert first.group.overtaken == second.group.overtaken == 0


@pytest.mark.skipif(not nats_server.is_installed(), reason="no NATS server is installed")
@pytest.mark.slow
def test_a_service_stops_in_time_though_its_broker_does_not_answer(acting):
    with nats_server.server() as broker:
        service = Service(acting, broker.address("events", create="true"), broker.address("answers", create="true"))
        service.start()
        until(lambda: not service.group()["trouble"] and service._endpoints.events._subscriber.is_connected)
        broker.process.send_signal(signal.SIGSTOP)
        try:
            began_s = monotonic()
            service.stop(2.0)
            took_s = monotonic() - began_s
        finally:
            broker.process.send_signal(signal.SIGCONT)
        assert service.state == "STOPPED"
        # Bounded by 2 s and the least that each end has; not by the sum of what each may take.
        assert took_s < TIMEOUT_S / 2
