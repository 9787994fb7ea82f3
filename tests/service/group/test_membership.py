from __future__ import annotations

from epypes.service.group.membership import Member, Membership, summary


def names(present):
    return [each.member.replica for each in present]


def test_who_is_heard_of_lives():
    members = Membership()
    assert members.heard(Member("b", "10"), 0.0) is True
    assert members.heard(Member("a", "2"), 1.0) is True
    assert members.heard(Member("b", "10", state="READY"), 2.0) is False
    present = members.present(3.0)
    assert names(present) == ["2", "10"], "as people count"
    assert [each.heard_s for each in present] == [2.0, 1.0]
    assert present[1].member.state == "READY"


def test_who_is_not_heard_of_any_more_is_gone():
    members = Membership()
    members.heard(Member("a", "1"), 0.0)
    assert names(members.present(3.5)) == ["1"]
    assert names(members.present(3.6)) == []
    assert members.heard(Member("a", "1"), 9.0) is True, "it is back"


def test_who_says_that_it_ends_is_gone_at_once():
    members = Membership()
    members.heard(Member("a", "1"), 0.0)
    members.left("a")
    members.left("nobody")
    assert names(members.present(0.1)) == []


def test_a_group_is_summed_up():
    members = Membership()
    members.heard(Member("a", "1", state="READY", digest="d", revision=2, counts={"answered": 3}), 0.0)
    members.heard(Member("b", "2", state="LOADING", digest="d", revision=2, counts={"answered": 4, "failed": 1}), 0.0)
    told = summary(members.present(1.0))
    assert told == {"replicas": 2, "ready": 1, "counts": {"answered": 7, "failed": 1}, "agree": True}
    members.heard(Member("b", "2", digest="d", revision=3), 1.0)
    assert summary(members.present(1.0))["agree"] is False


def test_however_many_replicas_are_made_up_there_is_room_for_this_one():
    members = Membership()
    for number in range(2_000):
        members.heard(Member(f"made up {number}", "x"), 0.0)
    assert members.heard(Member("other", "2"), 0.0) is False
    assert members.heard(Member("own", "1"), 0.0, is_self=True) is True
    assert "1" in names(members.present(0.0))
    assert "2" not in names(members.present(0.0))
