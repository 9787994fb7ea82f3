from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.acquisition import Frame, Ring
from epypes.errors import FrameUnavailable

TIMES = st.integers(0, 10**9)


def ring_of(*times_ns: int, size: int = 8) -> Ring:
    ring = Ring(size)
    for number, time_ns in enumerate(times_ns, start=1):
        ring.append(Frame(np.full((2, 3), number, np.uint8), time_ns, number))
    return ring


def test_the_frame_nearest_to_a_time_is_found():
    ring = ring_of(100, 200, 300)
    assert [ring.nearest(time_ns).number for time_ns in (100, 140, 160, 240, 260, 300, 999)] == [1, 1, 2, 2, 3, 3, 3]


@pytest.mark.fuzz
@given(st.lists(TIMES, min_size=1, max_size=20), TIMES, st.integers(1, 12))
def test_nearest_is_the_minimum_over_the_frames_that_are_kept(times_ns, wanted_ns, size):
    ring = ring_of(*times_ns, size=size)
    kept = list(enumerate(times_ns, start=1))[-size:]
    if wanted_ns < min(time_ns for _, time_ns in kept):
        with pytest.raises(FrameUnavailable):
            ring.nearest(wanted_ns)
        return
    number, captured_ns = min(kept, key=lambda pair: abs(pair[1] - wanted_ns))
    found = ring.nearest(wanted_ns)
    assert (found.number, found.captured_ns) == (number, captured_ns)


@pytest.mark.fuzz
@given(TIMES, TIMES, st.integers(1, 10**9))
def test_no_frame_is_given_that_is_too_far_from_the_time(captured_ns, wanted_ns, away_ns):
    ring = ring_of(captured_ns)
    if 0 <= wanted_ns - captured_ns <= away_ns:
        assert ring.nearest(wanted_ns, away_ns / 1e9).captured_ns == captured_ns
    else:
        with pytest.raises(FrameUnavailable):
            ring.nearest(wanted_ns, away_ns / 1e9)


def test_a_request_older_than_the_ring_is_refused_with_the_times():
    with pytest.raises(
        FrameUnavailable, match=r"keeps nothing of that time, which is 2\.000 s before its oldest frame"
    ) as info:
        ring_of(1 * 10**9, 4 * 10**9, 5 * 10**9, size=2).nearest(2 * 10**9)
    error = info.value
    assert (error.requested_ns, error.oldest_ns, error.newest_ns) == (2 * 10**9, 4 * 10**9, 5 * 10**9)


def test_a_ring_without_frames_says_so():
    with pytest.raises(FrameUnavailable, match="has no frame yet") as info:
        Ring().nearest(7)
    assert (info.value.requested_ns, info.value.oldest_ns, info.value.newest_ns) == (7, None, None)


def test_a_clock_that_is_set_back_confuses_nobody():
    ring = ring_of(5_000, 6_000, 1_000, 2_000)
    assert [ring.nearest(time_ns).number for time_ns in (1_100, 2_100, 5_900)] == [3, 4, 2]


@pytest.mark.parametrize("time_ns", [1.5, 1_700_000_000.25, "now", None, float("nan")])
def test_a_time_in_seconds_is_refused_rather_than_misunderstood(time_ns):
    with pytest.raises(TypeError, match=r"an integer as from time\.time_ns\(\)"):
        ring_of(100).nearest(time_ns)


def test_a_time_may_be_an_integer_of_numpy():
    assert ring_of(100, 200).nearest(np.int64(190)).number == 2


@pytest.mark.parametrize("size", [0, -1])
def test_a_ring_keeps_at_least_one_frame(size):
    with pytest.raises(ValueError, match=f"can't keep {size} frames"):
        Ring(size)


def test_a_ring_never_holds_more_than_its_size_while_others_ask():
    ring = ring_of(0, size=3)
    found, done = [], threading.Event()

    def ask():
        while not done.is_set():
            found.append(ring.nearest(10**9).number)

    asking = threading.Thread(target=ask)
    asking.start()
    for number in range(2, 5_000):
        ring.append(Frame(None, number, number))
        assert len(ring) <= 3
    done.set()
    asking.join(60)
    assert found == sorted(found), "a newer frame is never followed by an older one"


def test_reprs_are_short():
    assert repr(ring_of(1, 2)) == "<Ring: 2 of 8 frames>"
    assert repr(ring_of(1).nearest(1)) == "<Frame 1: (2, 3) uint8>"
