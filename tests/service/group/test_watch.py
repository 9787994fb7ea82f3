from __future__ import annotations

import logging

import pytest
from epypes.service.group.membership import Heard, Member, Membership
from epypes.service.group.watch import Watch, odds

OWN = Member("own", "1", "here", name="edges", digest="d1")


class Log:
    """A group, one look a second, and what the looks have said."""

    def __init__(self):
        self.members, self.watch, self.lines = Membership(), Watch(), []

    def second(self, at_s, *others):
        for member in others:
            self.members.heard(member, at_s)
        self.lines += self.watch.look(OWN, self.members.present(at_s), at_s)

    def take(self):
        lines, self.lines = self.lines, []
        return lines


def peer(**fields):
    return Member("other", "2", "there", **{"name": "edges", "digest": "d1", **fields})


@pytest.fixture
def log():
    return Log()


def test_who_comes_and_who_leaves_is_said_once(log):
    for at_s in range(6):
        log.second(at_s, OWN, peer())
    assert log.take() == [(logging.INFO, "replica 2 at there is in the group")]
    log.members.left("other")
    log.watch.left("other")
    log.watch.left("nobody")
    for at_s in range(6, 12):
        log.second(at_s, OWN)
    assert log.take() == [(logging.INFO, "replica 2 at there has left the group")]


def test_who_is_not_heard_any_more_is_said_to_be_gone_with_the_time_since(log):
    for at_s in range(6):
        log.second(at_s, OWN, peer())
    log.take()
    for at_s in range(6, 12):
        log.second(at_s, OWN)
    text = "replica 2 at there is gone: it was heard last 4.0 s ago, and has not said that it ends"
    assert log.take() == [(logging.WARNING, text)]
    log.second(12, peer())
    assert log.take() == [(logging.INFO, "replica 2 at there is in the group")]


def lost(log, at_s):
    return [(each.member.id, round(each.heard_s, 1)) for each in log.watch.lost(at_s)]


def gone(log, *others):
    """Have some be heard for three seconds, and not for five."""
    for at_s in range(9):
        log.second(at_s, OWN, *(others if at_s < 4 else ()))


def test_who_is_gone_without_a_word_is_lost_until_he_is_back(log):
    gone(log, peer())
    assert lost(log, 8.0) == [("other", 5.0)]
    log.second(9, OWN, peer())
    assert lost(log, 9.0) == []


def test_who_says_that_it_ends_is_not_lost(log):
    for at_s in range(4):
        log.second(at_s, OWN, peer())
    log.members.left("other")
    log.watch.left("other")
    for at_s in range(4, 9):
        log.second(at_s, OWN)
    assert lost(log, 9.0) == []


def test_after_an_outage_others_have_the_time_that_a_connection_takes_to_come_back(log):
    for at_s in range(4):
        log.second(at_s, OWN, peer())
    # They try again each five seconds at most, and speak each second.
    for at_s in range(20, 29):
        log.second(at_s, OWN)
    assert lost(log, 29.0) == []
    log.second(29, OWN, peer())
    assert log.take() == [(logging.INFO, "replica 2 at there is in the group")]


def test_who_came_later_takes_the_word_of_others_for_who_is_lost(log):
    log.watch.told_of(Heard(peer(), 5.0), 10.0)
    assert lost(log, 12.0) == [("other", 7.0)]
    log.watch.told_of(Heard(peer(), 9.0), 12.0)
    assert lost(log, 12.0) == [("other", 7.0)], "the first word counts"
    log.second(13, OWN, peer())
    assert lost(log, 13.0) == []
    log.watch.told_of(Heard(peer(), 5.0), 14.0)
    assert lost(log, 14.0) == [], "it has heard him itself"
    log.watch.told_of(Heard(Member("before", "1", "here"), 5.0), 15.0)
    log.second(15, OWN)
    assert lost(log, 15.0) == [], "this one is in his place"
    assert log.take() == [(logging.INFO, "replica 2 at there is in the group")]


@pytest.mark.parametrize("is_early", [True, False])
def test_another_of_the_same_name_takes_the_place_of_a_lost_one_for_good(log, is_early):
    other, new = Member("third", "3", "there"), Member("new", "2", "there")
    for at_s in range(4):
        log.second(at_s, OWN, peer(pid=7), other)
    for at_s in range(4, 18):
        log.second(at_s, OWN, *([new, other] if is_early or at_s > 12 else [other]))
    assert lost(log, 18.0) == []
    again = "replica 2 at there has come again, in place of process 7, which has not said that it ends"
    assert ((logging.INFO, again) in log.lines) is is_early
    assert any("replica 2 at there is gone" in line for _, line in log.lines) is not is_early
    log.members.left("new")
    log.watch.left("new")
    for at_s in range(18, 24):
        log.second(at_s, OWN)
    assert lost(log, 24.0) == [("third", 7.0)]


def test_another_of_the_same_name_elsewhere_is_another(log):
    gone(log, peer())
    log.second(9, OWN, Member("new", "2", "elsewhere"))
    assert lost(log, 9.0) == [("other", 6.0)]


def test_of_who_was_lost_long_ago_and_of_more_than_a_hundred_nothing_is_said(log):
    gone(log, *(Member(f"{number}", f"{number}", "there") for number in range(120)))
    assert sorted(map(int, (key for key, _ in lost(log, 9.0)))) == list(range(20, 120))
    assert len(lost(log, 603.0)) == 100
    assert lost(log, 603.1) == []


def test_who_has_heard_nobody_says_of_nobody_that_he_is_gone(log):
    for at_s in range(6):
        log.second(at_s, OWN, peer())
    log.take()
    log.second(30, OWN)
    for at_s in range(31, 40):
        log.second(at_s, OWN, peer())
    assert log.take() == []
    log.second(60, OWN)
    for at_s in range(61, 75):
        log.second(at_s, OWN)
    assert [text[:25] for _, text in log.take()] == ["replica 2 at there is gon"], "it has not come back"


def test_what_is_odd_is_said_when_it_begins(log):
    for at_s in range(4):
        log.second(at_s, peer())
    for at_s in range(4, 8):
        log.second(at_s, peer(name="cells", digest="d2"))
    for at_s in range(8, 12):
        log.second(at_s, peer(name="cells", digest="d2", ordered=True))
    _, *odd = log.take()
    assert [level for level, _ in odd] == [logging.WARNING] * 2
    assert "replica 2 at there serves another bundle from the same queue, cells (d2), and this one" in odd[0][1]
    assert "replica 2 at there keeps the order of events, and this one does not" in odd[1][1]


def test_another_state_of_the_same_bundle_is_nothing_odd():
    assert odds(OWN, peer(digest="d2", revision=7)) == []
