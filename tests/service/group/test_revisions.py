from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.service.group.revisions import Proposal, Revisions


def proposal(name, base, revision=None, digest="d", **values):
    return Proposal(name, digest, base, base + 1 if revision is None else revision, values or {"k": {"value": name}})


def accepted(revisions, digest="d"):
    found = revisions.accepted(digest)
    return None if found is None else (found.id, found.revision)


def test_of_two_changes_of_one_revision_the_first_is_taken():
    revisions = Revisions()
    assert revisions.take(proposal("a", 0)) == "accepted"
    assert revisions.take(proposal("b", 0)) == "refused"
    assert revisions.take(proposal("c", 1)) == "accepted"
    assert accepted(revisions) == ("c", 2)


def test_each_bundle_has_a_revision_of_its_own():
    revisions = Revisions()
    assert revisions.take(proposal("a", 0, digest="d1")) == "accepted"
    assert revisions.take(proposal("b", 0, 7, digest="d2")) == "accepted"
    assert (revisions.revision("d1"), revisions.revision("d2"), revisions.revision("d3")) == (1, 7, 0)


def test_an_entry_that_comes_twice_is_known():
    revisions = Revisions()
    revisions.take(proposal("a", 0))
    assert revisions.take(proposal("a", 0)) == "known"
    assert revisions.owed() is None


def test_a_revision_that_does_not_rise_is_refused():
    revisions = Revisions()
    assert revisions.take(proposal("a", 3, 3)) == "refused"
    assert revisions.take(proposal("a", 0, 0)) == "refused"
    assert revisions.owed() is None, "nothing was accepted, so there is nothing to say again"


def test_who_finds_the_newest_alone_goes_on_from_it():
    newcomer = Revisions()
    assert newcomer.take(proposal("f", 5)) == "accepted"
    assert newcomer.take(proposal("g", 6)) == "accepted"
    assert accepted(newcomer) == ("g", 7)


def test_a_refused_change_that_is_the_newest_is_followed_by_what_holds():
    # As in a log that keeps its newest entry alone.
    member, newcomer = Revisions(), Revisions()
    for each in (proposal("a", 0), proposal("b", 1), proposal("lost", 1)):
        member.take(each)
    newcomer.take(proposal("lost", 1))
    assert accepted(newcomer) == ("lost", 2), "it can't know better yet"
    again = member.owed()
    assert again is not None
    assert again.is_restated
    assert member.take(again) == "known"
    assert newcomer.take(again) == "accepted"
    assert accepted(newcomer) == accepted(member) == ("b", 2)
    assert member.owed() is None


def test_what_is_said_again_too_late_changes_nothing():
    member = Revisions()
    member.take(proposal("a", 0))
    again = member.restated("d")
    member.take(proposal("b", 1))
    assert member.take(again) == "refused"
    assert accepted(member) == ("b", 2)
    assert member.owed() == member.restated("d")


class Replica:
    """Proposes by what it has read of the log so far."""

    def __init__(self, log):
        self.log, self.revisions, self.read, self.verdicts = log, Revisions(), 0, []

    def read_more(self, count):
        for entry in self.log[self.read : self.read + count]:
            self.verdicts.append((entry.id, self.revisions.take(entry)))
        self.read = min(self.read + count, len(self.log))


STEPS = st.lists(
    st.tuples(st.integers(0, 3), st.sampled_from(["propose", "propose other", "restate", "read", "twice"])), max_size=60
)


@pytest.mark.slow
@pytest.mark.fuzz
@given(STEPS, st.lists(st.integers(1, 4), min_size=60, max_size=60))
def test_any_interleaving_of_proposals_gives_the_same_everywhere(steps, counts):
    log = []
    replicas = [Replica(log) for _ in range(4)]
    for (index, what), count in zip(steps, counts, strict=False):
        replica = replicas[index]
        digest = "other" if what == "propose other" else "d"
        if what.startswith("propose"):
            base = replica.revisions.revision(digest)
            log.append(proposal(f"p{len(log)}", base, digest=digest))
        elif what == "restate" and (again := replica.revisions.restated("d")) is not None:
            log.append(again)
        elif what == "twice" and log:
            log.append(log[-1])
        else:
            replica.read_more(count)
    replicas.append(Replica(log))  # one that joins late
    for replica in replicas:
        replica.read_more(len(log))
    first = replicas[0]
    for replica in replicas[1:]:
        assert replica.verdicts == first.verdicts
        assert accepted(replica.revisions) == accepted(first.revisions)
        assert accepted(replica.revisions, "other") == accepted(first.revisions, "other")
    for digest in ("d", "other"):
        taken = [entry for entry in log if entry.digest == digest and (entry.id, "accepted") in first.verdicts]
        in_order = list(dict.fromkeys((each.id, each.base, each.revision) for each in taken))
        assert [base for _, base, _ in in_order] == list(range(len(in_order))), "none is lost, none is taken twice"
        assert first.revisions.revision(digest) == len(in_order)


class NewestOnly:
    """A log that keeps its newest entry alone: who is cut off hears of what was sent meanwhile no more than that."""

    def __init__(self):
        self.replicas, self.cut, self.newest = [Revisions() for _ in range(3)], set(), []

    def send(self, entry):
        self.newest = [entry]
        for index, each in enumerate(self.replicas):
            if index not in self.cut:
                each.take(entry)

    def hear(self, index):
        if index in self.cut:
            self.cut.discard(index)
            for entry in self.newest:
                self.replicas[index].take(entry)

    def step(self, index, what, name):
        replica = self.replicas[index]
        if what == "cut":
            self.cut.add(index)
        elif what == "hear":
            self.hear(index)
        elif what == "propose":
            self.send(proposal(name, replica.revision("d")))
        elif (owed := replica.owed()) is not None:
            self.send(owed)


@pytest.mark.slow
@pytest.mark.fuzz
@given(st.lists(st.tuples(st.integers(0, 2), st.sampled_from(["propose", "cut", "hear", "restate"])), max_size=40))
def test_with_a_log_that_keeps_the_newest_alone_all_agree_in_the_end(steps):
    log = NewestOnly()
    for number, (index, what) in enumerate(steps):
        log.step(index, what, f"p{number}")
    for index in range(3):
        log.hear(index)
    # Whoever knows most says again what holds, once that it is seen that others know less.
    told = max(log.replicas, key=lambda each: each.revision("d"))
    if (again := told.restated("d")) is not None:
        log.send(again)
    assert len({accepted(each) for each in log.replicas}) == 1


def test_a_revision_after_which_none_could_be_counted_is_nobodys():
    revisions = Revisions()
    assert revisions.take(proposal("forged", 2**63 - 2)) == "refused"
    assert revisions.take(proposal("a", 0)) == "accepted"
    assert revisions.take(proposal("far", 5_000_000)) == "accepted", "where the newest alone is kept it may be so"
