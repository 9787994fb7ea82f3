from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.errors import MessageError
from epypes.service.group.membership import Heard, Member
from epypes.service.group.notices import Beat, Begun, Done, Left, Lost, read_notice, read_proposal, written
from epypes.service.group.order import place_in_stream
from epypes.service.group.revisions import Proposal
from epypes.wire import Envelope

NOTICES = [
    Beat(Member("a1", "1", "host", 7, "READY", "", "d1", 3, 4, {"answered": 5}, "http://127.0.0.1:1"), [(("s", 9), 4)]),
    Left("a1"),
    Done("a1", ["e1", "e2"], [(("camera", 17), 3, False), (("camera", 17), 5, True)]),
    Begun("a1", [(("", 0), 7)]),
    Lost(Heard(Member("a1", "1", "host", 7, counts={"answered": 5}), 12.345)),
]


@pytest.mark.parametrize("notice", NOTICES, ids=lambda notice: type(notice).__name__)
def test_what_is_said_is_understood(notice):
    assert read_notice(memoryview(written(notice))) == notice


def test_an_entry_of_the_log_is_understood():
    proposal = Proposal("p1", "d1", 3, 4, {"sigma": {"value": 1.5, "kind": "numpy"}}, is_restated=True)
    assert read_proposal(written(proposal)) == proposal


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello",
        b"[]",
        b"{}",
        b'{"v":2,"kind":"left","from":"a"}',
        b'{"v":1,"kind":"party"}',
        b'{"v":1,"kind":["left"],"from":"a"}',
        b'{"v":1,"kind":"left","from":7}',
        b'{"v":1,"kind":"done","from":"a","ids":[7],"numbers":[]}',
        b'{"v":1,"kind":"done","from":"a","ids":[],"numbers":[["s",1]]}',
        b'{"v":1,"kind":"done","from":"a","ids":[],"numbers":[["s",1,-1,false]]}',
        b'{"v":1,"kind":"beat","member":{"id":"a"},"known":[]}',
        b'{"v":1,"kind":"lost","member":{"id":"a"},"heard_ms":1}',
        b'{"v":1,"kind":"done","from":"a","ids":"abc","numbers":[]}',
        b'{"v":1,"kind":"done","from":"a","numbers":[],"ids":["a"' + b',"a"' * 1_000 + b"]}",
        b"[" * 100_000,
        b'{"v":1,"kind":"left","from":"' + b"a" * 2_000_000 + b'"}',
    ],
    ids=lambda data: data[:40].decode(),
)
def test_what_another_program_says_is_refused(data):
    with pytest.raises(MessageError):
        read_notice(data)
    with pytest.raises(MessageError):
        read_proposal(data)


@pytest.mark.fuzz
@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_anything_that_comes_is_understood_or_refused(data):
    for read in (read_notice, read_proposal):
        try:
            read(data)
        except MessageError:
            continue


def test_what_a_replica_says_of_itself_gives_no_orders_to_a_terminal():
    odd = "a\x1b[2J\u202eb\ud800\nc"
    member = read_notice(written(Beat(Member("id", odd, odd, reason=odd, trouble=odd, counts={odd: 1})))).member
    shown = "a [2J b  c"
    assert (member.replica, member.host, member.reason, member.trouble) == (shown,) * 4
    assert member.counts == {shown: 1}


def test_a_reason_of_whatever_length_does_not_keep_a_replica_from_being_heard():
    member = read_notice(written(Beat(Member("id", "1", trouble="very " * 1_000)))).member
    assert member.trouble.startswith("very very")
    assert len(member.trouble) == 2_000


def test_a_stream_of_whatever_source_and_numbers_can_be_told_of():
    most = 2**64 - 1
    places = [place_in_stream(Envelope("x", source=10_000 * end, epoch=most, sequence=most)) for end in "ab"]
    assert places[0] != places[1]
    assert place_in_stream(Envelope("x", source="cam", epoch=3, sequence=4)) == (("cam", 3), 4)
    done = Done("id", ["e"], [(*each, False) for each in places if each is not None])
    assert read_notice(written(done)) == done
    beat = Beat(Member("id", "1"), [(("cam", -(2**63)), most + 1), *(each for each in places if each is not None)])
    assert read_notice(written(beat)) == beat
