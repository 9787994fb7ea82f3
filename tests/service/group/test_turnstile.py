from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.service.group.turnstile import SETTLE_S, Turnstile

CAMERA = ("camera", 17)
TIMEOUT_S = 10.0


def passed(turnstile, now_s=0.0):
    return [each.number for each in turnstile.passing(now_s)]


def test_an_answer_waits_for_those_before_it():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 3, "three", 0.0)
    turnstile.enter(CAMERA, 2, "two", 0.0)
    assert passed(turnstile) == []
    turnstile.done(CAMERA, 1, 0.0)
    assert passed(turnstile) == [2, 3]
    assert passed(turnstile) == [], "each goes through once"
    assert turnstile.overtaken == 0


def test_streams_do_not_wait_for_each_other():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.enter(CAMERA, 1, "", 0.0)
    turnstile.enter(("robot", 17), 2, "", 0.0)
    turnstile.enter(("camera", 18), 1, "", 0.0)
    assert passed(turnstile) == [1, 1]


def test_no_answer_waits_longer_than_its_time():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 3, "", 1.0)
    turnstile.enter(CAMERA, 5, "", 4.0)
    assert turnstile.due_s() == 11.0
    assert passed(turnstile, 10.9) == []
    (gone,) = turnstile.passing(11.0)
    assert (gone.number, gone.has_overtaken, turnstile.overtaken) == (3, True, 1)
    assert turnstile.due_s() == 14.0
    turnstile.done(CAMERA, 4, 12.0)
    assert passed(turnstile, 12.0) == [5], "what is missing before was given up"
    assert turnstile.overtaken == 1


def test_a_lower_number_goes_before_one_whose_time_is_over():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 7, "", 0.0)
    turnstile.enter(CAMERA, 5, "", 9.0)
    assert passed(turnstile, 10.0) == [5, 7]


def test_an_event_that_was_given_up_goes_through_when_it_comes():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 2, "", 0.0)
    assert passed(turnstile, 10.0) == [2]
    turnstile.enter(CAMERA, 1, "", 11.0)
    assert passed(turnstile, 11.0) == [1]


def test_what_one_replica_has_given_up_the_others_do_not_wait_for():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 6, "", 0.0)
    turnstile.done(CAMERA, 5, 1.0, has_overtaken=True)
    assert passed(turnstile, 1.0) == [6]


def test_a_stream_that_began_before_is_taken_up_where_others_are():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.enter(CAMERA, 58, "", 0.0)
    assert passed(turnstile) == []
    turnstile.told(CAMERA, 57, 0.5)
    assert passed(turnstile, 0.5) == [], "another has 57"
    turnstile.done(CAMERA, 57, 0.6)
    assert passed(turnstile, 0.6) == [58]


def test_a_stream_that_nobody_knows_begins_with_the_lowest_number_that_somebody_has():
    turnstile = Turnstile(TIMEOUT_S)
    assert turnstile.arrived(CAMERA, 59, 0.0) is True
    assert turnstile.arrived(CAMERA, 57, 0.1) is True
    assert turnstile.arrived(CAMERA, 58, 0.2) is False
    turnstile.enter(CAMERA, 57, "", 0.2)
    assert passed(turnstile, 0.3) == []
    assert turnstile.due_s() == SETTLE_S
    assert passed(turnstile, SETTLE_S) == [57]
    assert turnstile.arrived(CAMERA, 60, 2.0) is False
    assert turnstile.overtaken == 0


def test_a_sender_that_has_just_begun_is_not_waited_for():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.enter(CAMERA, 1, "", 0.0)
    assert passed(turnstile) == [1]


def test_others_are_told_what_is_done_and_not_what_was_let_through_alone():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.enter(CAMERA, 1, "", 0.0)
    assert passed(turnstile) == [1]
    assert turnstile.known() == [(CAMERA, 1)]
    turnstile.done(CAMERA, 1, 0.0)
    assert turnstile.known() == [(CAMERA, 2)]


def test_streams_that_are_over_are_forgotten():
    turnstile = Turnstile(TIMEOUT_S)
    turnstile.arrived(CAMERA, 1, 0.0)
    turnstile.enter(CAMERA, 2, "", 0.0)
    for epoch in range(2_000):
        turnstile.done(("other", epoch), 1, 0.0)
    assert len(turnstile.known(10_000)) <= 1_000
    assert turnstile.waiting == 1
    assert [each.ticket for each in turnstile.leave()] == [""]
    assert turnstile.waiting == 0


class Group:
    """Replicas at a queue, whose notices may be lost, and which may die."""

    def __init__(self, count, first):
        self.now_s, self.first = 0.0, first
        self.queue = []
        self.replicas = {name: (Turnstile(TIMEOUT_S), {}) for name in range(count)}
        self.published, self.since = [], {}

    def tell(self, teller, say):
        for name, (turnstile, _) in self.replicas.items():
            if name != teller:
                say(turnstile)

    def take(self, name):
        if self.queue and name in self.replicas:
            number = self.queue.pop(0)
            turnstile, hand = self.replicas[name]
            hand[number] = "computing"
            if turnstile.arrived(CAMERA, number, self.now_s):
                self.tell(name, lambda each: each.arrived(CAMERA, number, self.now_s))

    def finish(self, name, which):
        if name in self.replicas:
            turnstile, hand = self.replicas[name]
            computing = sorted(number for number, state in hand.items() if state == "computing")
            if computing:
                number = computing[which % len(computing)]
                hand[number] = "waiting"
                self.since[name, number] = self.now_s
                turnstile.enter(CAMERA, number, number, self.now_s)

    def pass_all(self, is_heard=True):
        is_over = False
        while not is_over:
            is_over = True
            for name, (turnstile, hand) in self.replicas.items():
                for each in turnstile.passing(self.now_s):
                    is_over = False
                    assert hand.pop(each.ticket) == "waiting", "each goes through once"
                    self.published.append(each.ticket)
                    said = CAMERA, each.number, self.now_s
                    turnstile.done(*said, has_overtaken=each.has_overtaken)
                    if is_heard:
                        self.tell(name, lambda other: other.done(*said, has_overtaken=each.has_overtaken))  # noqa: B023
                    assert self.now_s - self.since.pop((name, each.ticket)) <= TIMEOUT_S + 1.0

    def die(self, name):
        if name in self.replicas and len(self.replicas) > 1:
            _, hand = self.replicas.pop(name)
            self.queue = [*sorted(hand), *self.queue]

    def beat(self):
        for name, (turnstile, _) in self.replicas.items():
            for stream, at in turnstile.known():
                self.tell(name, lambda other: other.told(stream, at, self.now_s))  # noqa: B023

    def second(self, seconds=1.0):
        self.now_s += seconds
        self.beat()
        self.pass_all()

    def step(self, what, number):
        acts = {"take": self.take, "die": self.die, "finish": lambda name: self.finish(name, number)}
        if what in acts:
            acts[what](number % 3)
        elif what == "second":
            self.second()
        else:
            self.pass_all(is_heard=what == "pass")

    def finish_everything(self, seconds):
        while self.queue or any(hand for _, hand in self.replicas.values()):
            for name in self.replicas:
                self.take(name)
                self.finish(name, 0)
            self.second(seconds)


STEPS = st.lists(
    st.tuples(
        st.sampled_from(["take", "take", "finish", "finish", "pass", "deaf", "die", "second"]), st.integers(0, 3)
    ),
    max_size=120,
)


@pytest.mark.fuzz
@given(STEPS, st.integers(1, 30), st.sampled_from([1, 1, 57]))
def test_every_event_goes_through_once_and_none_waits_too_long_whatever_dies(steps, count, first):
    group = Group(3, first)
    group.queue = list(range(first, first + count))
    for what, number in steps:
        group.step(what, number)
    group.finish_everything(1.0)
    assert sorted(group.published) == list(range(first, first + count))


@pytest.mark.slow
@pytest.mark.fuzz
@given(STEPS, st.integers(1, 30), st.sampled_from([1, 1, 57]))
def test_the_order_is_kept_when_nothing_takes_longer_than_its_time(steps, count, first):
    # Deaths and lost words are allowed: what a dead replica had is delivered again in time. What it had done, and had
    # not said before it died, nobody could know, and all would wait for it as long as they may.
    group = Group(3, first)
    group.queue = list(range(first, first + count))
    left_s = 4
    for what, number in steps:
        left_s -= what == "second"
        if what == "die":
            group.beat()
        if what != "second" or left_s >= 0:
            group.step(what, number)
    group.finish_everything(0.01)
    assert group.published == list(range(first, first + count))


@pytest.mark.parametrize("numbers", [[2, 4, 6], [10, 11, 13]])
def test_numbers_that_nobody_has_cost_no_more_than_their_time(numbers):
    turnstile = Turnstile(TIMEOUT_S)
    for number in numbers:
        turnstile.enter(CAMERA, number, "", 0.0)
    assert passed(turnstile, TIMEOUT_S) == numbers
