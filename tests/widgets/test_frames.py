"""Does the last frame arrive, whatever happens to acknowledgements?"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import epypes as ep
from epypes_widgets.frames import Frame, FrameSender, make_frame, plain
from tests.colours import red_image, red_runner


def frame(seq: int) -> Frame:
    return Frame(seq, {"seq": seq})


def sent_by(steps: Sequence[tuple[str, int]]) -> tuple[list[int], FrameSender]:
    """Play steps on a sender; return what it sent."""
    sent: list[int] = []
    sender = FrameSender(lambda frame: sent.append(frame.seq))
    for step, seq in steps:
        if step == "offer":
            sender.offer(frame(seq))
        elif step == "painted":
            sender.painted(seq)
        else:
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
    sender = FrameSender(lambda frame: sent.append(frame.seq))
    offered = 0
    for step in ["ready", *steps]:
        before = len(sent)
        if step == "offer":
            offered += 1
            sender.offer(frame(offered))
        elif step == "ready":
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
    sender = FrameSender(lambda frame: arrived.put(frame.seq))
    sender.ready()

    def front_end() -> None:
        while not complete.is_set():
            seq = arrived.get(timeout=10)
            seen.append(seq)
            for answer in (seq - 1, seq, seq, seq + 1):
                sender.painted(answer)
            if seq == last:
                complete.set()

    thread = threading.Thread(target=front_end, daemon=True)
    thread.start()
    for seq in range(1, last + 1):
        sender.offer(frame(seq))
    assert complete.wait(10)
    thread.join(10)
    assert seen == sorted(seen)


def test_an_answer_from_within_sending_is_allowed() -> None:
    seen: list[int] = []

    def send(frame: Frame) -> None:
        seen.append(frame.seq)
        sender.painted(frame.seq)

    sender = FrameSender(send)
    sender.ready()
    sender.offer(frame(1))
    sender.offer(frame(2))
    assert (seen, sender.in_flight) == ([1, 2], None)


def test_a_frame_carries_the_values_that_it_was_computed_with(runner: ep.CompGraphRunner) -> None:
    made = make_frame(runner.rerun(threshold=50), "mask", 3)
    assert (made.content["seq"], made.content["values"]) == (3, {"gain": 2, "threshold": 50})
    assert (made.content["media_type"], made.data[1:4]) == ("image/png", b"PNG")
    assert (made.content["ran"], made.content["reused"]) == (1, 1)
    assert (made.content["width"], made.content["height"]) == (64, 48)


def test_a_token_that_is_no_image_goes_as_short_text() -> None:
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: "a" * x}, {"f": ("x", "y")}))
    content = make_frame(runner.run(x=10_000), "y", 1).content
    assert content["media_type"] == "text/plain"
    assert len(content["text"]) < 500


def test_values_can_always_be_written_as_json() -> None:
    values = [1, np.int64(2), 0.5, float("nan"), float("inf"), None, True, "a", (1, 2), object(), np.zeros(3)]
    assert json.loads(json.dumps([plain(value) for value in values], allow_nan=False))[:3] == [1, 2, 0.5]


def test_the_big_picture_has_the_colours_that_the_annotations_say() -> None:
    run = red_runner().run(image=red_image())
    strongest = {}
    for token in run:
        picture = np.asarray(Image.open(io.BytesIO(make_frame(run, token, 1).data)))
        strongest[token] = int(picture.reshape(-1, 3).mean(axis=0).argmax())
    assert strongest == {"image": 0, "red": 0, "unsaid": 2}
