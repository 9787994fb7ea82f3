"""Events that wait: which are dropped, how many are done ahead of a slow one, and that counts add up."""

from __future__ import annotations

import os

import pytest

from epypes.errors import ServiceError
from epypes.service import Service
from tests.service.served import check_counts, serving, until

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("policy", "size", "kept"), [("drop_oldest", 3, [2, 3, 4]), ("latest", 1, [4]), ("fault", 3, [0, 1, 2])]
)
def test_a_full_mailbox_drops_and_answers_the_events_of_its_policy(acting, policy, size, kept):
    with serving(acting, mailbox_policy=policy, mailbox_size=size) as (service, peer):
        service.pause()
        sent = [peer.send(number=number) for number in range(5)]
        dropped = peer.take(5 - size)
        assert {answer.correlation_id for answer in dropped} == {sent[n] for n in range(5) if n not in kept}
        assert all("dropped this event" in answer.failure.message for answer in dropped)
        until(lambda: service.counts()["waiting"] == size)
        check_counts(service.counts())
        service.resume()
        assert [answer.parts["out"] for answer in peer.take(size)] == [2 * number for number in kept]
        assert service.counts()["dropped"] == 5 - size


@pytest.mark.parametrize(
    ("policy", "size", "why"), [("block", 8, "no mailbox of policy"), ("latest", 2, "size 2"), ("fault", 0, "size 0")]
)
def test_a_mailbox_that_cannot_be_is_refused(acting, policy, size, why):
    with pytest.raises(ServiceError, match=why):
        Service(acting, mailbox_policy=policy, mailbox_size=size)


def test_the_number_of_events_that_are_done_ahead_of_a_slow_one_is_bounded(acting, tmp_path):
    with serving(acting, threads=2, mailbox_size=100) as (service, peer):
        peer.send(f"hold:{tmp_path}", 0)
        for number in range(1, 61):
            peer.send(number=number)
        until(lambda: service.counts()["received"] == 61 and service.counts()["in_flight"] >= 17)
        counts = service.counts()
        assert (counts["answered"], counts["in_flight"] <= 18, counts["waiting"] >= 43) == (0, True, True), counts
        (tmp_path / "release").touch()
        assert [answer.parts["out"] for answer in peer.take(61)] == [2 * number for number in range(61)]


def test_services_that_have_stopped_leave_no_descriptor_open(acting):
    def serve_once():
        with serving(acting) as (_, peer):
            peer.ask()

    # What is opened once for the process is open from the first on.
    serve_once()
    before = len(os.listdir("/proc/self/fd"))
    serve_once()
    serve_once()
    until(lambda: len(os.listdir("/proc/self/fd")) <= before)
