"""A message that is delivered again is settled as the first one was."""

from __future__ import annotations

import pytest

from epypes.transport.channel import Delivery
from epypes.transport.deduplication import Deduplication


@pytest.fixture
def deliver():
    """Delivers a message of one id over one connection; returns the delivery, and what it was settled by."""
    deduplication = Deduplication()

    def deliver(attempt):
        verdicts = []
        delivery = Delivery((b"x",), "a", attempt, settle=lambda *verdict: verdicts.append(verdict))
        deduplication.is_first("a", delivery, "connection")
        return delivery, verdicts

    return deliver


@pytest.mark.parametrize(("attempt", "expected"), [(0, "reject"), (1, "ack"), (2, "reject")])
def test_a_rejected_message_that_comes_again_is_rejected_again_unless_it_was_sent_twice(deliver, attempt, expected):
    first, _ = deliver(min(attempt, 1))
    first.reject("dark")
    _, verdicts = deliver(attempt)
    assert [verdict for verdict, _ in verdicts] == [expected]


@pytest.mark.parametrize("verdict", ["nack", "reject"])
@pytest.mark.parametrize("attempts", [(0, 0), (1, 2)])
def test_copies_of_one_stored_message_get_the_same_verdict(deliver, attempts, verdict):
    (first, older), (_, newest) = map(deliver, attempts)
    getattr(first, verdict)(*["dark"] * (verdict == "reject"))
    assert older == newest
    assert [name for name, _ in newest] == [verdict]


def test_of_a_message_that_was_sent_twice_one_copy_is_a_dead_letter(deliver):
    (first, older), (_, newest) = deliver(1), deliver(1)
    first.reject("dark")
    assert (newest, older) == ([("reject", "dark")], [("ack", "")])
