"""Does the last frame arrive, whatever happens to acknowledgements?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from epypes_widgets.picture.frames import Frame
from epypes_widgets.view import FrameSender
from epypes_widgets.worker import Worker


def frame(seq: int) -> Frame:
    return Frame(seq, {"seq": seq})


class Slots(Worker):
    """A worker without a thread: what is posted waits until it is hastened, or its delay is over."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: dict[str, tuple[Callable[[], object], float]] = {}
        self.hastened: list[str] = []

    @property
    def delay_s(self) -> float:
        """After which the frame in flight is taken for lost."""
        return self.waits["lost frame"][1]

    def post(self, key: str, request: Callable[[], object], delay_s: float = 0.0, *, is_work: bool = True) -> None:
        assert not is_work, "Panel.wait() does not wait for the browser"
        self.waits[key] = request, delay_s

    def hasten(self, key: str) -> bool:
        if key in self.waits:
            self.hastened.append(key)
        return key in self.waits

    def run(self) -> None:
        """Run what was hastened."""
        while self.hastened:
            request, _ = self.waits.pop(self.hastened.pop(0), (lambda: None, 0.0))
            request()

    def due(self) -> None:
        """Let the time of the frame in flight be over."""
        self.waits.pop("lost frame")[0]()
        self.run()


class Sending:
    """A sender, what it has sent, and its worker."""

    def __init__(self, send: Callable[[Frame], None] = lambda frame: None) -> None:
        self.sent: list[int] = []
        self.made: list[int] = []
        self.slots = Slots()

        def keep(frame: Frame) -> None:
            self.sent.append(frame.seq)
            send(frame)

        self.sender = FrameSender(keep, self.slots)

    def offer(self, seq: int) -> None:
        def make() -> Frame:
            self.made.append(seq)
            return frame(seq)

        self.sender.offer(make)
        self.slots.run()

    def painted(self, seq: int) -> None:
        self.sender.painted(seq)
        self.slots.run()

    def ready(self) -> None:
        self.sender.mount()
        self.sender.ready()
        self.slots.run()


def sent_by(steps: Sequence[tuple[str, int]]) -> tuple[list[int], Sending]:
    """Play steps on a sender; return what it sent."""
    sending = Sending()
    for step, seq in steps:
        if step == "ready":
            sending.ready()
        else:
            getattr(sending, step)(seq)
    return sending.sent, sending


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
    mounted_anew = [("ready", 0), ("offer", 1), ("offer", 2), ("ready", 0)]
    assert sent_by(mounted_anew)[0] == [1, 1]  # at once, also while the worker is busy
    assert sent_by([*mounted_anew, ("painted", 1)])[0] == [1, 1, 2]
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
    sending, offered = Sending(), 0
    for step in ["ready", *steps]:
        before = len(sending.sent)
        if step == "offer":
            offered += 1
            sending.offer(offered)
        elif step == "ready":
            sending.ready()
        elif step == "painted in flight":
            sending.painted(sending.sender.in_flight.seq if sending.sender.in_flight else 0)
        else:
            sending.painted(step[1])
        assert len(sending.sent) - before <= 1
    while sending.sender.in_flight is not None:
        sending.painted(sending.sender.in_flight.seq)
    assert sending.sent[-1:] == ([offered] if offered else [])
    assert sending.sent == sorted(sending.sent)


def test_of_frames_that_newer_ones_replace_none_is_made() -> None:
    _, sending = sent_by([("ready", 0), *(("offer", seq) for seq in range(1, 10)), ("painted", 1)])
    assert sending.made == [1, 9]


def test_a_front_end_on_another_thread_that_answers_wildly_still_gets_the_last_frame() -> None:
    arrived: SimpleQueue[int] = SimpleQueue()
    seen: list[int] = []
    complete = threading.Event()
    last = 2000
    worker = Worker()
    sender = FrameSender(lambda frame: arrived.put(frame.seq), worker)
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
        worker.post("compute", partial(sender.offer, partial(frame, seq)))
    assert complete.wait(60)
    thread.join(60)
    worker.close(60)
    assert seen == sorted(seen)


def test_an_answer_from_within_sending_is_allowed() -> None:
    sending = Sending(lambda frame: sending.sender.painted(frame.seq) and None)
    sending.ready()
    sending.offer(1)
    sending.offer(2)
    assert (sending.sent, sending.sender.in_flight) == ([1, 2], None)


def test_a_frame_or_an_answer_that_is_lost_is_made_good_with_the_newest() -> None:
    sent, sending = sent_by([("ready", 0), ("offer", 1)])
    sending.slots.due()
    assert sent == [1, 1]
    sending.offer(2)
    assert sent == [1, 1]
    sending.slots.due()
    assert sent == [1, 1, 2]
    sending.painted(2)
    sending.slots.due()
    assert sent == [1, 1, 2]


def test_a_screen_that_is_gone_is_asked_less_and_less_often() -> None:
    _, sending = sent_by([("ready", 0), ("offer", 1)])
    delays = []
    for _ in range(8):
        delays.append(sending.slots.delay_s)
        sending.slots.due()
    assert delays == [2.0, 4.0, 8.0, 16.0, 32.0, 32.0, 32.0, 32.0]
    sending.painted(1)
    sending.offer(2)
    assert sending.slots.delay_s == 2.0


def test_of_two_views_one_may_be_removed() -> None:
    sent, sending = sent_by([("ready", 0), ("ready", 0)])
    sender = sending.sender
    sender.closed()
    sending.offer(1)
    assert (sent, sender.mounted, sender.left) == ([1], True, False)
    sender.closed()
    sender.closed()
    assert (sender.mounted, sender.left) == (False, True)
    sending.ready()
    assert sent == [1, 1]


def test_nothing_is_sent_to_a_view_that_was_removed() -> None:
    sent, sending = sent_by([("ready", 0), ("offer", 1), ("offer", 2)])
    sending.sender.closed()
    sending.slots.run()
    sending.slots.due()
    sending.offer(3)
    assert (sent, sending.sender.mounted) == ([1], False)
    sending.ready()
    assert sent == [1, 3]


def test_once_the_worker_is_closed_nothing_waits() -> None:
    sent, sending = sent_by([("ready", 0), ("offer", 1)])
    sending.slots.close(60)
    sending.offer(2)
    assert sent == [1, 2]
