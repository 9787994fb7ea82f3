"""Does the last frame arrive, whatever happens to acknowledgements?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from epypes_widgets.frames import Frame
from epypes_widgets.view import FrameSender


def frame(seq: int) -> Frame:
    return Frame(seq, {"seq": seq})


class Clock:
    """Calls what was put off when it is told to."""

    def __init__(self) -> None:
        self.delay_s = 0.0
        self.due: Callable[[], object] = lambda: None

    def __call__(self, key: str, function: Callable[[], object], delay_s: float) -> None:
        self.delay_s, self.due = delay_s, function


def never(key: str, function: object, delay_s: float) -> None:
    """Stand for a clock that has not got so far."""


def sent_by(steps: Sequence[tuple[str, int]]) -> tuple[list[int], FrameSender]:
    """Play steps on a sender; return what it sent."""
    sent: list[int] = []
    sender = FrameSender(lambda frame: sent.append(frame.seq), never)
    for step, seq in steps:
        if step == "offer":
            sender.offer(frame(seq))
        elif step == "painted":
            sender.painted(seq)
        else:
            sender.mount()
            sender.ready()
    return sent, sender


def test_nothing_is_sent_before_a_view_is_there() -> None:
    assert sent_by([("offer", 1), ("offer", 2)])[0] == []
    assert sent_by([("offer", 1), ("offer", 2), ("ready", 0)])[0] == [2]
    assert sent_by([("ready", 0)])[0] == []


def test_one_frame_is_in_flight_and_the_newest_goes_next() -> None:
    steps = [("ready", 0), ("offer", 1), ("offer", 2), ("offer", 3)]
    assert sent_by(steps)[0] == [1]
    assert sent_by([*steps, ("painted", 1)])[0] == [1, 3]
    assert sent_by([*steps, ("painted", 1), ("painted", 3)])[0] == [1, 3]


def test_acknowledgements_that_are_late_or_come_twice_change_nothing() -> None:
    steps = [("ready", 0), ("offer", 1), ("offer", 2), ("painted", 1), ("offer", 3)]
    assert sent_by([*steps, ("painted", 1), ("painted", 7)])[0] == [1, 2]


def test_a_view_that_is_mounted_anew_gets_the_newest_even_if_an_acknowledgement_was_lost() -> None:
    assert sent_by([("ready", 0), ("offer", 1), ("offer", 2), ("ready", 0)])[0] == [1, 2]
    assert sent_by([("ready", 0), ("offer", 1), ("painted", 1), ("ready", 0)])[0] == [1, 1]


_STEPS = st.lists(
    st.one_of(
        st.just("offer"),
        st.just("ready"),
        st.tuples(st.just("painted"), st.integers(0, 12)),
        st.just("painted in flight"),
    ),
    max_size=40,
)


@given(_STEPS)
def test_the_frame_offered_last_is_delivered_last_once_all_is_acknowledged(steps: list[Any]) -> None:
    sent: list[int] = []
    sender = FrameSender(lambda frame: sent.append(frame.seq), never)
    offered = 0
    for step in ["ready", *steps]:
        before = len(sent)
        if step == "offer":
            offered += 1
            sender.offer(frame(offered))
        elif step == "ready":
            sender.mount()
            sender.ready()
        elif step == "painted in flight":
            sender.painted(sender.in_flight.seq if sender.in_flight else 0)
        else:
            sender.painted(step[1])
        assert len(sent) - before <= 1
    while sender.in_flight is not None:
        sender.painted(sender.in_flight.seq)
    assert sent[-1:] == ([offered] if offered else [])
    assert sent == sorted(sent)


def test_a_front_end_on_another_thread_that_answers_wildly_still_gets_the_last_frame() -> None:
    arrived: SimpleQueue[int] = SimpleQueue()
    seen: list[int] = []
    complete = threading.Event()
    last = 2000
    sender = FrameSender(lambda frame: arrived.put(frame.seq), never)
    sender.mount()
    sender.ready()

    def front_end() -> None:
        while not complete.is_set():
            seq = arrived.get(timeout=60)
            seen.append(seq)
            for answer in (seq - 1, seq, seq, seq + 1):
                sender.painted(answer)
            if seq == last:
                complete.set()

    thread = threading.Thread(target=front_end, daemon=True)
    thread.start()
    for seq in range(1, last + 1):
        sender.offer(frame(seq))
    assert complete.wait(60)
    thread.join(60)
    assert seen == sorted(seen)


def test_an_answer_from_within_sending_is_allowed() -> None:
    seen: list[int] = []

    def send(frame: Frame) -> None:
        seen.append(frame.seq)
        sender.painted(frame.seq)

    sender = FrameSender(send, never)
    sender.mount()
    sender.ready()
    sender.offer(frame(1))
    sender.offer(frame(2))
    assert (seen, sender.in_flight) == ([1, 2], None)


def test_a_frame_or_an_answer_that_is_lost_is_made_good_with_the_newest() -> None:
    sent: list[int] = []
    clock = Clock()
    sender = FrameSender(lambda frame: sent.append(frame.seq), clock)
    sender.mount()
    sender.ready()
    sender.offer(frame(1))
    clock.due()
    assert sent == [1, 1]
    sender.offer(frame(2))
    assert sent == [1, 1]
    clock.due()
    assert sent == [1, 1, 2]
    sender.painted(2)
    clock.due()
    assert sent == [1, 1, 2]


def test_a_screen_that_is_gone_is_asked_less_and_less_often() -> None:
    clock = Clock()
    sender = FrameSender(lambda frame: None, clock)
    sender.mount()
    sender.ready()
    sender.offer(frame(1))
    delays = []
    for _ in range(8):
        delays.append(clock.delay_s)
        clock.due()
    assert delays == [2.0, 4.0, 8.0, 16.0, 32.0, 32.0, 32.0, 32.0]
    sender.painted(1)
    sender.offer(frame(2))
    assert clock.delay_s == 2.0


def test_of_two_views_one_may_be_removed() -> None:
    sent: list[int] = []
    sender = FrameSender(lambda frame: sent.append(frame.seq), never)
    for _ in range(2):
        sender.mount()
        sender.ready()
    sender.closed()
    sender.offer(frame(1))
    assert (sent, sender.mounted, sender.left) == ([1], True, False)
    sender.closed()
    sender.closed()
    assert (sender.mounted, sender.left) == (False, True)
    sender.mount()
    sender.ready()
    assert sent == [1, 1]


def test_nothing_is_sent_to_a_view_that_was_removed() -> None:
    sent: list[int] = []
    clock = Clock()
    sender = FrameSender(lambda frame: sent.append(frame.seq), clock)
    sender.mount()
    sender.ready()
    sender.offer(frame(1))
    sender.closed()
    clock.due()
    sender.offer(frame(2))
    assert (sent, sender.mounted) == ([1], False)
    sender.mount()
    sender.ready()
    assert sent == [1, 2]
