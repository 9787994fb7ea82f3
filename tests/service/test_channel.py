from __future__ import annotations

import json
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.errors import MessageError
from epypes.service.channel import MOST_HEADER_BYTES, Channel, channel_pair
from epypes.service.packing import pack, table_of
from tests.wire.mutants import mutate_bytes

TIMEOUT_S = 60.0


@pytest.fixture
def ends():
    """The two ends of a channel."""
    ours, theirs = channel_pair()
    other = Channel(theirs)
    yield ours, other
    ours.close()
    other.close()


def in_thread(function, *arguments):
    """Call a function in a thread; return what waits for its end and gives its result, or raises what it raised."""
    results = []

    def run():
        try:
            results.append((function(*arguments), None))
        except BaseException as error:
            results.append((None, error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()

    def result():
        thread.join(TIMEOUT_S)
        assert not thread.is_alive(), "it did not return"
        value, error = results[0]
        if error is not None:
            raise error
        return value

    return result


@pytest.mark.fuzz
@given(
    st.dictionaries(st.text(max_size=9), st.none() | st.integers() | st.text(max_size=9) | st.floats(allow_nan=False)),
    st.lists(st.binary(max_size=300), max_size=6),
)
def test_header_and_frames_arrive_as_they_were_sent(header, frames):
    ours, theirs = channel_pair()
    other = Channel(theirs)
    try:
        ours.send(header, frames)
        got, got_frames = other.receive()
        assert got == header
        assert [bytes(frame) for frame in got_frames] == frames
    finally:
        ours.close()
        other.close()


def test_messages_larger_than_all_buffers_arrive_whole_in_both_directions_at_once(ends):
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 256, size, np.uint8) for size in (9_000_000, 0, 3, 5_000_001)]
    sends = [in_thread(end.send, {"n": 1}, frames) for end in ends]
    receives = [in_thread(end.receive) for end in ends]
    for send, receive in zip(sends, receives, strict=True):
        header, got = receive()
        send()
        assert header == {"n": 1}
        assert all(
            np.array_equal(np.frombuffer(frame, np.uint8), sent) for frame, sent in zip(got, frames, strict=True)
        )
        assert all(frame.readonly for frame in got)


def test_more_frames_than_the_system_takes_at_once_arrive_whole(ends):
    frames = [bytes([number % 256]) * (number % 7) for number in range(5_000)]
    send = in_thread(ends[0].send, {}, frames)
    _, got = ends[1].receive()
    send()
    assert [bytes(frame) for frame in got] == frames


def test_a_message_arrives_whole_although_signals_interrupt_who_sends_it(ends):
    frames = [bytes([number]) * 1_000_000 for number in range(30)]
    counted = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: counted.append(number))
    signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
    try:
        receive = in_thread(lambda: [bytes(frame) for frame in (time.sleep(0.05), ends[1].receive())[1][1]])
        ends[0].send({}, frames)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert receive() == frames
    assert counted


def test_what_was_sent_may_be_written_to_again(ends):
    array = np.ones(3_000_000, np.uint8)
    receive = in_thread(ends[1].receive)
    ends[0].send({}, [array])
    array[:] = 7
    assert np.frombuffer(receive()[1][0], np.uint8).max() == 1


@pytest.mark.slow
def test_threads_that_send_at_once_do_not_mix_their_messages(ends):
    ours, other = ends
    senders = [
        in_thread(lambda kind=kind: [ours.send({"kind": kind}, [bytes([kind]) * 70_000]) for _ in range(50)])
        for kind in range(4)
    ]
    seen = [0] * 4
    for _ in range(200):
        header, (frame,) = other.receive()
        assert set(frame) == {header["kind"]}
        seen[header["kind"]] += 1
    for sender in senders:
        sender()
    assert seen == [50] * 4


def test_a_reader_that_waits_reads_the_end_when_the_other_side_goes(ends):
    receive = in_thread(ends[1].receive)
    ends[0].close()
    with pytest.raises(EOFError):
        receive()
    with pytest.raises(EOFError):
        ends[1].send({})


def test_a_reader_that_waits_reads_the_end_when_its_own_side_is_closed(ends):
    receive = in_thread(ends[1].receive)
    ends[1].close()
    with pytest.raises(EOFError):
        receive()
    with pytest.raises(EOFError):
        ends[1].receive()
    with pytest.raises(EOFError):
        ends[1].send({})
    ends[1].close()


def test_a_message_that_is_cut_off_is_an_end_and_no_message(ends):
    ours, theirs = socket.socketpair()
    other = Channel(theirs)
    try:
        ours.sendall(pack([b"{}", b"abc"])[:-1])
        ours.close()
        with pytest.raises(EOFError):
            other.receive()
    finally:
        other.close()


def test_a_sender_that_waits_for_a_reader_ends_when_that_one_goes(ends):
    send = in_thread(ends[0].send, {}, [bytes(30_000_000)])
    ends[1].close()
    with pytest.raises(EOFError):
        send()


@pytest.mark.parametrize(
    "stream",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        table_of([]),
        table_of([b""]),
        pack([b"[1]"]),
        pack([b"{"]),
        pack([b"\xff\xfe"]),
        pack([b"[" * 100_000]),
        struct.pack("<4sI", b"EPF1", 2**31),
        struct.pack("<4sIQQ", b"EPF1", 2, 2, 2**50),
        struct.pack("<4sIQ", b"EPF1", 1, MOST_HEADER_BYTES + 1),
    ],
)
def test_what_is_no_message_is_said_to_be_none(stream):
    ours, theirs = socket.socketpair()
    other = Channel(theirs)
    try:
        ours.sendall(stream)
        with pytest.raises(MessageError):
            other.receive()
    finally:
        ours.close()
        other.close()


def test_mutants_of_a_message_are_read_or_refused_and_nothing_else_is_raised():
    rng = random.Random(3)
    message = pack([json.dumps({"kind": "event", "seq": 7, "raw": False}).encode(), b"topic/", bytes(200)])
    for _ in range(1_000):
        ours, theirs = socket.socketpair()
        other = Channel(theirs)
        try:
            ours.sendall(mutate_bytes(message, rng))
            ours.shutdown(socket.SHUT_WR)
            other.receive()
        except (EOFError, MessageError):
            continue
        finally:
            ours.close()
            other.close()


def test_a_header_that_would_not_be_read_is_not_sent(ends):
    with pytest.raises(MessageError, match="the limit is 1,048,576"):
        ends[0].send({"text": "x" * MOST_HEADER_BYTES})
    ends[0].send({"n": 1})
    assert ends[1].receive()[0] == {"n": 1}


def test_a_process_that_was_forked_does_not_keep_the_channel_open():
    """A worker whose function has forked is killed: its front reads the end although the child lives on."""
    ours, theirs = channel_pair()
    code = """
import os, signal, socket, sys
from epypes.service.channel import Channel
channel = Channel(socket.socket(fileno=int(sys.argv[1])))
channel.close_in_forks()
if os.fork() == 0:
    os.read(0, 1)
    os._exit(0)
os.kill(os.getpid(), signal.SIGKILL)
"""
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-I", "-c", code, str(theirs.fileno())], pass_fds=[theirs.fileno()], stdin=subprocess.PIPE
        )
    try:
        with pytest.raises(EOFError):
            in_thread(ours.receive)()
    finally:
        process.stdin.close()
        process.wait(TIMEOUT_S)
        ours.close()


def test_no_descriptor_is_left_open():
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        ours, theirs = channel_pair()
        other = Channel(theirs)
        ours.send({}, [b"x"])
        other.receive()
        ours.close()
        other.close()
    assert len(os.listdir("/proc/self/fd")) == before
