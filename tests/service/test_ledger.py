from __future__ import annotations

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from epypes.errors import ServiceError
from epypes.service.ledger import Ledger


def open_ledger(**options):
    ledger = Ledger(**options)
    ledger.flowing = True
    return ledger


def begin(ledger, count):
    """Accept events, each of which a slot takes."""
    for number in range(count):
        ledger.accept(number, 0)
    return [ledger.take(0) for _ in range(count)]


def released(ledger):
    return [entry.event for entry in ledger.release()]


def test_what_is_done_early_waits_for_what_came_before():
    ledger = open_ledger(slots=3)
    first, second, third = begin(ledger, 3)
    ledger.resolve(third.seq, "answered")
    ledger.resolve(second.seq, "failed")
    assert released(ledger) == []
    assert ledger.counts()["in_flight"] == 3
    ledger.resolve(first.seq, "answered")
    assert released(ledger) == [0, 1, 2]
    counts = ledger.counts()
    assert (counts["answered"], counts["failed"], counts["in_flight"]) == (2, 1, 0)


def test_an_event_of_a_broker_is_in_flight_until_its_answer_is_confirmed():
    ledger = open_ledger(slots=2, size=2, waits=True, is_confirmed=True)
    first, second = begin(ledger, 2)
    ledger.accept("third", 0)
    assert ledger.has_room
    ledger.accept("fourth", 0)
    assert not ledger.has_room, "the broker keeps the next one"
    ledger.resolve(first.seq, "answered")
    ledger.resolve(second.seq, "failed")
    assert released(ledger) == [0, 1]
    assert (ledger.counts()["in_flight"], ledger.counts()["answered"], ledger.is_empty) == (2, 0, False)
    assert ledger.confirm(first.seq, "answered")
    assert not ledger.confirm(first.seq, "answered"), "once"
    assert [entry.event for entry in ledger.give_back()] == [1, "third", "fourth"]
    assert not ledger.confirm(second.seq, "failed"), "somebody else answers it"
    counts = ledger.counts()
    assert (counts["received"], counts["answered"], counts["failed"], counts["given_back"]) == (4, 1, 0, 3)
    assert ledger.is_empty


def test_what_comes_back_to_the_ledger_after_it_was_given_back_is_ignored():
    ledger = open_ledger(slots=1, waits=True, is_confirmed=True)
    (entry,) = begin(ledger, 1)
    assert ledger.give_back() == [entry]
    assert ledger.resolve(entry.seq, "answered") is None
    assert released(ledger) == []
    assert begin(ledger, 1), "the next one is worked on"


@pytest.mark.parametrize(
    ("policy", "size", "dropped"), [("drop_oldest", 2, [1]), ("latest", 1, [1, 2]), ("fault", 2, [3])]
)
def test_a_full_mailbox_drops_what_its_policy_says(policy, size, dropped):
    ledger = open_ledger(policy=policy, size=size)
    begin(ledger, 1)
    gone = [entry.event for number in (1, 2, 3) for entry in ledger.accept(number, 0)]
    assert gone == dropped
    assert ledger.counts()["dropped"] == len(dropped)


@pytest.mark.parametrize(("policy", "size"), [("block", 8), ("nonsense", 8), ("latest", 2), ("drop_oldest", 0)])
def test_a_mailbox_that_cannot_be_is_refused(policy, size):
    with pytest.raises(ServiceError):
        Ledger(policy, size)


def test_an_event_that_kills_the_worker_alone_is_put_aside_after_its_retries():
    ledger = open_ledger(retries=2)
    for attempt in (1, 2, 3):
        if attempt == 1:
            ledger.accept("poison", 0)
        entry = ledger.take(0)
        assert (entry.event, entry.attempts) == ("poison", attempt)
        dead = ledger.worker_died()
        assert dead == ([entry] if attempt == 3 else [])
    ledger.resolve(entry.seq, "dead_letters")
    assert released(ledger) == ["poison"]
    assert ledger.counts()["retried"] == 2


def test_suspects_of_a_death_are_tried_one_at_a_time_and_only_the_culprit_is_put_aside():
    ledger = open_ledger(slots=3, retries=0)
    begin(ledger, 3)
    assert ledger.worker_died() == [], "nobody knows yet which of them it was"
    ledger.accept(3, 0)
    first = ledger.take(0)
    assert (first.event, ledger.take(0)) == (0, None), "nothing is worked on beside a suspect"
    ledger.resolve(first.seq, "answered")
    second = ledger.take(0)
    assert ledger.worker_died() == [second]
    ledger.resolve(second.seq, "dead_letters")
    third = ledger.take(0)
    ledger.resolve(third.seq, "answered")
    fourth = ledger.take(0)
    ledger.resolve(fourth.seq, "answered")
    assert released(ledger) == [0, 1, 2, 3]
    assert ledger.counts()["dead_letters"] == 1


def test_nothing_is_taken_beside_the_last_suspect_either():
    ledger = open_ledger(slots=2)
    begin(ledger, 1)
    ledger.worker_died()
    suspect = ledger.take(0)
    ledger.accept(1, 0)
    assert ledger.take(0) is None
    ledger.worker_ended()
    assert (ledger.take(0), ledger.take(0)) == (suspect, None), "ended for another reason, it stays a suspect"
    ledger.resolve(suspect.seq, "answered")
    assert ledger.take(0).event == 1


def test_events_that_the_worker_was_ended_beside_are_no_suspects():
    ledger = open_ledger(slots=2, retries=0)
    begin(ledger, 2)
    ledger.worker_ended()
    assert [ledger.take(0).event, ledger.take(0).event] == [0, 1], "side by side again"
    assert ledger.worker_died() == []


def test_what_is_done_ahead_of_a_slow_event_is_bounded():
    ledger = open_ledger(slots=2, size=1000)
    for number in range(200):
        ledger.accept(number, 0)
    slow = ledger.take(0)
    ahead = 0
    while (entry := ledger.take(0)) is not None:
        ledger.resolve(entry.seq, "answered")
        ahead += 1
    assert 2 <= ahead <= 20
    ledger.resolve(slow.seq, "answered")
    assert released(ledger) == list(range(ahead + 1))
    assert ledger.take(0) is not None


def test_a_word_on_an_event_that_is_not_worked_on_changes_nothing():
    ledger = open_ledger()
    (entry,) = begin(ledger, 1)
    ledger.resolve(entry.seq, "answered")
    assert ledger.resolve(entry.seq, "failed") is None
    assert ledger.resolve(99, "failed") is None
    assert released(ledger) == [0]
    assert ledger.counts()["failed"] == 0


class Everything(RuleBasedStateMachine):
    """Whatever happens: nothing is lost, nothing comes twice, the order is kept, the counts add up."""

    def __init__(self):
        super().__init__()
        self.now = 0
        self.accepted, self.out, self.dropped = [], [], []
        self.deaths = {}

    @initialize(
        policy=st.sampled_from(["drop_oldest", "latest", "fault"]),
        size=st.integers(1, 4),
        slots=st.integers(1, 3),
        retries=st.integers(0, 2),
    )
    def begin(self, policy, size, slots, retries):
        self.ledger = Ledger(policy, 1 if policy == "latest" else size, slots, retries)

    def take_all(self):
        while (entry := self.ledger.take(self.now)) is not None:
            assert entry.started_ns == self.now
            assert len(self.ledger.running()) <= self.ledger.slots
            if any(self.deaths.get(other.event, 0) for other in self.ledger.running()):
                assert len(self.ledger.running()) == 1, "a suspect is alone"

    def gather(self):
        self.out += [(entry.event, entry.outcome) for entry in self.ledger.release()]
        self.take_all()

    @rule()
    def accept(self):
        self.now += 1
        event = len(self.accepted)
        self.accepted.append(event)
        self.dropped += [entry.event for entry in self.ledger.accept(event, self.now)]
        self.take_all()

    @rule(flowing=st.booleans())
    def flow(self, flowing):
        self.ledger.flowing = flowing
        self.take_all()

    @precondition(lambda self: self.ledger.running())
    @rule(which=st.integers(0, 5), outcome=st.sampled_from(["answered", "failed"]))
    def done(self, which, outcome):
        running = self.ledger.running()
        entry = running[which % len(running)]
        assert self.ledger.resolve(entry.seq, outcome) is entry
        self.deaths.pop(entry.event, None)
        self.gather()

    @rule()
    def die(self):
        self.ledger.flowing = False
        running = self.ledger.running()
        dead = self.ledger.worker_died()
        if len(running) != 1:
            assert dead == [], "nobody is put aside who was not alone"
        for entry in dead:
            assert entry.deaths == self.ledger.retries + 1
            self.ledger.resolve(entry.seq, "dead_letters")
        for entry in running:
            self.deaths[entry.event] = 1
        for entry in dead:
            del self.deaths[entry.event]
        self.gather()

    @rule()
    def end(self):
        self.ledger.flowing = False
        self.ledger.worker_ended()
        self.gather()

    @rule()
    def give_up(self):
        waiting, begun = self.ledger.give_up()
        self.dropped += [entry.event for entry in waiting]
        for entry in begun:
            self.deaths.pop(entry.event, None)
            self.ledger.resolve(entry.seq, "failed")
        self.gather()
        assert self.ledger.is_empty

    @invariant()
    def holds(self):
        if not hasattr(self, "ledger"):
            return
        counts = self.ledger.counts()
        parts = ("answered", "failed", "dropped", "dead_letters", "waiting", "in_flight")
        assert counts["received"] == len(self.accepted) == sum(counts[part] for part in parts)
        events = [event for event, _ in self.out]
        assert events == sorted(events), "the order of acceptance"
        resolved = events + self.dropped
        assert len(set(resolved)) == len(resolved), "nothing comes twice"
        assert counts["waiting"] + counts["in_flight"] == len(self.accepted) - len(resolved), "nothing is lost"
        for outcome in ("answered", "failed", "dead_letters"):
            assert counts[outcome] == sum(found == outcome for _, found in self.out)

    def teardown(self):
        """Whatever has happened, all of it ends well once a worker stays."""
        if not hasattr(self, "ledger"):
            return
        self.ledger.flowing = True
        self.take_all()
        for _ in range(10_000):
            if self.ledger.is_empty:
                break
            for entry in self.ledger.running():
                self.ledger.resolve(entry.seq, "answered")
            self.gather()
        assert self.ledger.is_empty
        assert sorted([event for event, _ in self.out] + self.dropped) == self.accepted


TestEverything = pytest.mark.slow(pytest.mark.fuzz(Everything.TestCase))
