"""``epypes record`` and ``epypes play`` report what they did, and each error in one line."""

from __future__ import annotations

import os
import queue
import re
import threading
import time

import pytest

from epypes.transport import ZMQPublisher, ZMQSubscriber, recording_info
from epypes.transport.mcap import RecordingCounts, RecordingWriter
from epypes.wire import Envelope

LOCAL = "tcp://127.0.0.1:*"
WAIT_S = 60.0


@pytest.fixture
def recording(tmp_path):
    """A file with three messages of a topic and one without."""
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, {"address": "tcp://127.0.0.1:5555", "topic": ""}, force=False)
    for number in range(3):
        writer.append(10**18 + number * 10**6, [b"cam1/", b"%d" % number])
    writer.append(10**18 + 25 * 10**8, [b"2019"])
    writer.flush()
    writer.finish(RecordingCounts(5, 4, {"disk too slow": 1}))
    return path


def one_line(done) -> str:
    """Return the output of a failing command: one line, no traceback, exit status 1."""
    assert done.returncode == 1, done
    assert done.stderr.startswith("epypes: ")
    assert len(done.stderr.strip().splitlines()) == 1
    return done.stderr


def test_record_takes_the_given_number_of_messages_and_reports_the_counts(epypes, tmp_path):
    out, path = queue.SimpleQueue(), tmp_path / "[a].mcap"

    def publish() -> None:
        assert pub.wait_for_subscriber(WAIT_S)
        for number in range(10):
            out.put(Envelope("x", {"n": number}))

    with ZMQPublisher(LOCAL, out, "cam1") as pub:
        thread = threading.Thread(target=publish)
        thread.start()
        address = pub.address
        done = epypes("record", address, path, "--messages", 3, "--topic", "cam1")
        thread.join(WAIT_S)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"RECORDING {address} to {path}. Ctrl+C ends it.",
        f"RECORDED {path}: received 3, written 3, dropped 0.",
    ]
    assert recording_info(path).topics == {"cam1": 3}


@pytest.mark.slow
def test_record_ends_after_the_given_time(epypes, tmp_path):
    before = time.monotonic()
    done = epypes("record", f"bind:{LOCAL}", tmp_path / "a.mcap", "--seconds", 0.1)
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - before >= 0.1
    assert re.search(r"RECORDING tcp://127\.0\.0\.1:\d+ \(no publisher has confirmed yet\)", done.stdout)
    assert recording_info(tmp_path / "a.mcap").messages == 0


def test_play_sends_and_reports_how_many(epypes, recording):
    into = queue.SimpleQueue()
    with ZMQSubscriber(LOCAL, into, bind=True, undecoded=True) as sub:
        done = epypes("play", recording, f"connect:{sub.address}", "--speed", 0, "--loop", 2)
        frames = [list(map(bytes, into.get(timeout=WAIT_S).frames)) for _ in range(8)]
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == f"PLAYED {recording}: sent 8."
    assert frames == [[b"cam1/", b"0"], [b"cam1/", b"1"], [b"cam1/", b"2"], [b"2019"]] * 2


def test_play_can_send_without_a_subscriber(epypes, recording):
    done = epypes("play", recording, "--no-wait", "--speed", 0)
    assert done.returncode == 0, done.stderr
    assert re.search(r"PLAYING .* at tcp://127\.0\.0\.1:\d+\. Ctrl\+C ends it", done.stdout)
    assert done.stdout.endswith("sent 4.\n")


def test_info_prints_the_content_of_the_file_and_sends_nothing(epypes, recording, monkeypatch):
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    done = epypes("play", "--info", recording)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{recording}: 4 messages from tcp://127.0.0.1:5555 in 2.500 s",
        "first message on 2001-09-09 at 01:46:40 +0000",
        "received 5, written 4, dropped 1 (disk too slow 1)",
        "  (no topic): 1 message",
        "  cam1: 3 messages",
    ]


def test_a_recording_that_breaks_off_is_played_and_then_reported(epypes, recording):
    os.truncate(recording, recording.read_bytes().index(b"epypes.counts"))
    assert "did not finish it" in epypes("play", "--info", recording).stdout
    done = epypes("play", recording, "--no-wait", "--speed", 0)
    assert "sent 4." in done.stdout
    assert "breaks off" in one_line(done)


def test_what_can_not_be_recorded_is_one_line(epypes, recording, tmp_path):
    assert "is there already" in one_line(epypes("record", LOCAL.replace("*", "5555"), recording))
    assert "can't be written" in one_line(epypes("record", "tcp://127.0.0.1:5555", tmp_path / "no" / "a.mcap"))
    assert "is not the beginning of an address" in one_line(epypes("record", "bind:nonsense", tmp_path / "b.mcap"))
    one_line(epypes("record", "nonsense", tmp_path / "b.mcap"))
    assert "insecure=True" in one_line(epypes("record", "bind:tcp://*:5555", tmp_path / "b.mcap"))
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.slow
def test_what_can_not_be_played_is_one_line(epypes, recording, tmp_path):
    (tmp_path / "text.mcap").write_text("no recording")
    for name, words in (("text.mcap", "is no MCAP file"), ("nothing.mcap", "can't be read")):
        assert words in one_line(epypes("play", tmp_path / name))
        assert words in one_line(epypes("play", "--info", tmp_path / name))
    with ZMQPublisher(LOCAL, queue.SimpleQueue()) as pub:
        assert "is in use" in one_line(epypes("play", recording, pub.address))
    assert "insecure=True" in one_line(epypes("play", recording, "tcp://0.0.0.0:5555"))
    assert epypes("play", recording, "--speed", -1).returncode == 2


@pytest.mark.parametrize("seconds", ["1e300", "inf"])
def test_a_time_that_no_clock_can_wait_for_is_refused_in_one_line(epypes, tmp_path, seconds):
    done = epypes("record", f"bind:{LOCAL}", tmp_path / "a.mcap", "--seconds", seconds)
    assert "is too long" in one_line(done)
    assert not (tmp_path / "a.mcap").exists()


def test_an_endless_speed_is_refused_in_one_line(epypes, recording):
    assert "0 is as fast as possible" in one_line(epypes("play", recording, "--speed", "inf"))
