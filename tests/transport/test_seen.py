"""Is it known which events are in hand and which are done, and is that forgotten in time?"""

from __future__ import annotations

import gc
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.transport.seen import Seen, Word


class Thing:
    pass


def test_what_arrives_first_is_in_hand_and_what_comes_again_meets_it():
    seen, first, second = Seen(), Thing(), Thing()
    assert seen.arrive("a", first) is None
    assert seen.arrive("a", second) is first
    assert seen.arrive("b", second) is None
    assert seen.in_hand == 2


def test_what_has_no_id_is_never_the_same_as_anything_else():
    seen, first, second = Seen(), Thing(), Thing()
    assert seen.arrive("", first) is seen.arrive("", second) is None
    seen.finish("")
    assert seen.word("") is None


def test_what_is_done_is_not_in_hand_and_what_was_said_is_known():
    seen, thing = Seen(), Thing()
    seen.arrive("a", thing)
    assert seen.word("a") is None
    seen.finish("a", Word("broken", 3))
    assert (seen.word("a"), seen.in_hand) == (Word("broken", 3), 0)


def test_long_ids_are_told_apart_and_take_no_more_memory_than_short_ones():
    seen, thing = Seen(), Thing()
    long = ["x" * 60_000 + str(number) for number in range(3)]
    seen.arrive(long[0], thing)
    seen.add(long)
    seen.give_back(long[0])
    assert [seen.word(known_as) is None for known_as in long] == [True, False, False]
    tracemalloc.start()
    try:
        for number in range(100):
            seen.finish("x" * 60_000 + str(number))
        assert tracemalloc.get_traced_memory()[0] < 60_000
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_what_nobody_knows_any_more_is_not_in_hand():
    seen, thing = Seen(), Thing()
    seen.arrive("a", thing)
    del thing
    gc.collect()
    newer = Thing()
    assert seen.arrive("a", newer) is None
    assert seen.arrive("a", Thing()) is newer


def test_what_was_given_back_is_new_when_it_comes_again():
    seen, thing = Seen(), Thing()
    seen.arrive("a", thing)
    seen.give_back("a")
    assert seen.word("a") is None
    assert seen.arrive("a", thing) is None


def test_what_others_have_answered_is_done_unless_it_is_in_hand_or_rejected_here():
    seen, thing = Seen(), Thing()
    seen.arrive("in hand", thing)
    seen.finish("rejected", Word("broken", 1))
    seen.add(["in hand", "rejected", "other"])
    assert seen.word("in hand") is None
    assert seen.arrive("in hand", Thing()) is thing
    assert seen.word("rejected") == Word("broken", 1)
    assert seen.word("other") == Word()


@pytest.mark.fuzz
@given(st.lists(st.sampled_from("abcdefgh")), st.integers(1, 5))
def test_the_ids_that_were_done_last_are_remembered_and_no_more(ids, most):
    seen = Seen(most)
    for known_as in ids:
        seen.finish(known_as)
    newest = list(dict.fromkeys(reversed(ids)))[:most]
    assert {known_as for known_as in "abcdefgh" if seen.word(known_as) is not None} == set(newest)
