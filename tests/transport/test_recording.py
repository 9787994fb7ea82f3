"""A recording holds what was published, and a player sends what was recorded, whatever happens to disk and process."""

from __future__ import annotations

import gc
import os
import queue
import random
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import Counter

import cv2
import numpy as np
import pytest
import zmq

from epypes.errors import AddressError, RecordingError, StillRunning
from epypes.transport import Player, Recorder, ZMQPublisher, ZMQSubscriber, make_keys, recording_info
from epypes.transport.mcap import RecordingCounts, RecordingWriter, messages
from epypes.wire import Envelope, JustBytes, decode, encode
from epypes.wire.foxglove import foxglove_images
from epypes.wire.protobuf import message_class
from tests.transport.peers import wait_until

LOCAL = "tcp://127.0.0.1:*"
WAIT_S = 60.0
HOUR_NS = 3_600 * 10**9


def written(path, recorded) -> None:
    """Write a recording of (time, frames)."""
    writer = RecordingWriter(path, {"address": "by hand"}, force=True)
    for time_ns, frames in recorded:
        writer.append(time_ns, frames)
    writer.flush()
    writer.finish(RecordingCounts(len(recorded), len(recorded)))


def read_until_error(path) -> tuple[list[list[bytes]], str]:
    """Return the frames of a file up to the error that it must end with, and its text."""
    found = []
    try:
        for message in messages(path):
            found.append(list(map(bytes, message.frames)))  # noqa: PERF401  what came before the error is wanted
    except RecordingError as error:
        return found, str(error)
    raise AssertionError("it was read to its end")


def frames_of(path) -> list[list[bytes]]:
    return [list(map(bytes, message.frames)) for message in messages(path)]


def still_there(path) -> int:
    """How many messages can be read from a file that is being written, or was left."""
    try:
        return recording_info(path).messages
    except RecordingError:
        return 0


IMAGE = np.arange(100 * 100 * 3, dtype=np.uint8).reshape(100, 100, 3)
TRAFFIC = [
    [bytes(frame) for frame in encode(Envelope("a", {"image": IMAGE}, source="s", epoch=7, sequence=41), "cam1")],
    [JustBytes(contents=b"\0\1", id="7").SerializeToString()],
    [bytes(frame) for frame in encode(Envelope("b", {"n": 1}, source="s", epoch=7, sequence=43), "cam1/left")],
    [b""],
    [b"/", b""],
    [b"\xfe topic that is no text", b"", b"x" * 100_000, b""],
    [b"many"] + [b"frames"] * 500,
]


def test_what_is_played_is_byte_for_byte_what_was_published(peer, tmp_path):
    source, sink = peer(zmq.XPUB), peer(zmq.SUB)
    with Recorder(LOCAL, tmp_path / "a.mcap", bind=True) as recorder:
        source.connect(recorder.address)
        assert source.recv() == b"\x01"
        for frames in TRAFFIC:
            source.send_multipart(frames)
        wait_until(lambda: recorder.counts.received == len(TRAFFIC))
    assert frames_of(tmp_path / "a.mcap") == TRAFFIC
    with Player(tmp_path / "a.mcap") as player:
        sink.subscribe(b"")
        sink.connect(player.address)
        assert [sink.recv_multipart() for _ in TRAFFIC] == TRAFFIC
        assert player.wait(WAIT_S)
    assert player.sent == len(TRAFFIC)


def test_the_times_and_topics_of_the_messages_are_kept(tmp_path):
    out, path = queue.SimpleQueue(), tmp_path / "a.mcap"
    with ZMQPublisher(LOCAL, out, "cam1") as pub, Recorder(pub.address, path) as recorder:
        assert recorder.wait_joined(WAIT_S)
        before = time.time_ns()
        for number in range(3):
            out.put(Envelope("x"))
            out.put(b"no topic")
            wait_until(lambda number=number: recorder.counts.received == 2 * number + 2)
        after = time.time_ns()
        address = pub.address
    times = [message.time_ns for message in messages(path)]
    assert times == sorted(times)
    # Two clocks are read: a hundredth of a second is more than they can be apart.
    assert before - 10**7 <= times[0] < times[-1] <= after + 10**7
    found = recording_info(path)
    assert found.topics == {"cam1": 3, "": 3}
    assert (found.first_ns, found.last_ns) == (times[0], times[-1])
    assert found.about == {"address": address, "topic": ""}
    assert found.counts == RecordingCounts(6, 6)


def test_any_reader_of_mcap_finds_topics_times_and_messages(tmp_path):
    from mcap.reader import make_reader

    written(tmp_path / "a.mcap", [(1_000 * number, [b"a/" if number % 2 else b"b/", b"x"]) for number in range(100)])
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 100
        assert {channel.topic for channel in summary.channels.values()} == {"a", "b"}
        found = list(reader.iter_messages(topics=["a"], starting_at=90_000))
        assert [message.log_time for _, _, message in found] == [91_000, 93_000, 95_000, 97_000, 99_000]
        assert {record.name: record.metadata for record in reader.iter_metadata()} == {
            "epypes.recording": {"address": "by hand"},
            "epypes.counts": {"received": "100", "written": "100"},
        }


GREY, RED = IMAGE[:, :, 0].copy(), np.full((90, 120, 3), (0, 0, 255), np.uint8)
PICTURES = [
    (
        "cam1",
        Envelope("a", {"left": IMAGE, "n": 3, "right": GREY}, source="robot", acquired_ns=1_500_000_000_000_000_007),
    ),
    ("", Envelope("b", {"photo": RED}, rgb=["photo"])),
    ("cam1", Envelope("c", {"left": IMAGE[::-1].copy(), "small": IMAGE[:4, :4], "deep": GREY.astype("<f4")})),
    (
        "cam1",
        Envelope(
            "d", {"file": cv2.imencode(".png", RED)[1].tobytes(), "big": cv2.imencode(".jpg", IMAGE)[1].tobytes()}
        ),
    ),
    ("cam1", Envelope("e", {"wide": RED.astype("<u2"), "text": "none"})),
]


def test_images_are_shown_by_readers_of_foxglove_s_schemas_and_are_in_the_file_once(tmp_path):
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    sent = [
        (number + 1, [bytes(frame) for frame in encode(each, topic)]) for number, (topic, each) in enumerate(PICTURES)
    ]
    written(tmp_path / "a.mcap", sent)
    assert frames_of(tmp_path / "a.mcap") == [frames for _, frames in sent], "what is played is what was recorded"
    whole = sum(len(frame) for _, frames in sent for frame in frames)
    assert (tmp_path / "a.mcap").stat().st_size < whole + IMAGE.nbytes
    assert recording_info(tmp_path / "a.mcap").topics == {"cam1": 4, "": 1}
    found = []
    with (tmp_path / "a.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.message_encoding == "protobuf":
                image = DecoderFactory().decoder_for("protobuf", schema)(message.data)
                found.append((message.log_time, channel.topic, schema.name, image))

    def pixels(image):
        if image.DESCRIPTOR.name == "CompressedImage":
            return cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
        flat = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
        return flat.reshape((image.height, image.width, 3) if image.encoding != "mono8" else flat.shape)

    wanted = {
        (1, "cam1/left", "foxglove.RawImage", "bgr8"): IMAGE,
        (1, "cam1/right", "foxglove.RawImage", "mono8"): GREY,
        (2, "photo", "foxglove.RawImage", "rgb8"): RED,
        (3, "cam1/left", "foxglove.RawImage", "bgr8"): IMAGE[::-1],
        (3, "cam1/small", "foxglove.RawImage", "bgr8"): IMAGE[:4, :4],
        (4, "cam1/file", "foxglove.CompressedImage", "png"): RED,
        (4, "cam1/big", "foxglove.CompressedImage", "jpeg"): cv2.imdecode(cv2.imencode(".jpg", IMAGE)[1], 1),
    }
    got = {(*each[:3], getattr(each[3], "encoding", "") or each[3].format): pixels(each[3]) for each in found}
    assert got.keys() == wanted.keys()
    for key, image in wanted.items():
        assert np.array_equal(got[key], image), key
    first = found[0][3]
    assert (first.timestamp.ToNanoseconds(), first.frame_id) == (1_500_000_000_000_000_007, "robot")
    assert found[2][3].timestamp.ToNanoseconds() == 2, "without a time of acquisition, that of its arrival"


def test_a_file_of_images_that_is_no_recording_is_refused_and_a_missing_image_is_named(tmp_path):
    from mcap_protobuf.writer import Writer

    (image,) = foxglove_images(encode(Envelope("a", {"left": IMAGE})), 1)
    with (tmp_path / "a.mcap").open("wb") as file, Writer(file) as writer:
        writer.write_message("/camera", image.message)
    assert read_until_error(tmp_path / "a.mcap")[1].endswith(
        "is an MCAP file, but no recording of EPypes: it has images alone. Play it with the program that wrote it."
    )
    frames = [bytes(frame) for frame in encode(Envelope("a", {"left": IMAGE}), "cam")]
    written(tmp_path / "b.mcap", [(1, frames)])
    damaged = tmp_path / "c.mcap"
    with damaged.open("wb") as file:
        copy_without_images(tmp_path / "b.mcap", file)
    assert "an image of a message is missing" in read_until_error(damaged)[1]


def test_a_frame_that_many_parts_name_is_one_image():
    frames = encode(Envelope("a", {"left": IMAGE}))
    message = message_class("epypes.v1.Envelope").FromString(frames[1])
    for number in range(1_000):
        message.parts.add(name=f"copy {number}").CopyFrom(message.parts[0])
    assert len([*foxglove_images([frames[0], message.SerializeToString(), frames[2]], 1)]) == 1


@pytest.mark.parametrize("lie", [{"width": 2**31}, {"width": 0}, {"height": 1}, {"step": 0}, {"encoding": "bgra8"}])
def test_an_image_that_declares_another_size_than_it_has_is_not_shown(lie):
    frames = encode(Envelope("a", {"left": IMAGE}))
    message = message_class("epypes.v1.Envelope").FromString(frames[1])
    for name, value in lie.items():
        setattr(message.parts[0].value.image, name, value)
    assert not [*foxglove_images([frames[0], message.SerializeToString(), frames[2]], 1)]


def copy_without_images(path, file) -> None:
    """Write what a filter of topics leaves of a recording."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    writer = Writer(file)
    writer.start()
    with path.open("rb") as source:
        for _, channel, message in make_reader(source).iter_messages():
            if channel.message_encoding != "protobuf":
                number = writer.register_channel(channel.topic, channel.message_encoding, schema_id=0)
                writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()


def test_one_topic_can_be_recorded_alone(tmp_path):
    left, right = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        Recorder(LOCAL, tmp_path / "a.mcap", "cam1", bind=True) as recorder,
        ZMQPublisher(recorder.address, left, "cam1", bind=False),
        ZMQPublisher(recorder.address, right, "cam10", bind=False) as ten,
    ):
        assert recorder.wait_joined(WAIT_S, publishers=2)
        right.put(Envelope("ten"))
        wait_until(lambda: ten.sent == 1)
        left.put(Envelope("one"))
        wait_until(lambda: recorder.counts.received == 1)
    assert recording_info(tmp_path / "a.mcap").topics == {"cam1": 1}


@pytest.mark.slow
def test_topics_that_are_invented_without_end_do_not_use_up_the_channels(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"t%d/" % number, b"x"]) for number in range(3_000)])
    found = recording_info(tmp_path / "a.mcap")
    assert len(found.topics) == 1_025
    assert found.topics["(other topics)"] == 3_000 - 1_024
    assert frames_of(tmp_path / "a.mcap")[-1] == [b"t2999/", b"x"]


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "least_s"), [(2.0, 0.04), (0.5, 0.16)])
def test_the_distances_in_time_are_kept_and_can_be_changed(tmp_path, speed, least_s):
    start = time.time_ns()
    written(tmp_path / "a.mcap", [(start + number * 2 * 10**7, [b"%d" % number]) for number in range(5)])
    into = queue.SimpleQueue()
    before = time.monotonic()
    with Player(tmp_path / "a.mcap", speed=speed) as player, ZMQSubscriber(player.address, into):
        assert [into.get(timeout=WAIT_S) for _ in range(5)] == [b"%d" % number for number in range(5)]
    assert time.monotonic() - before >= least_s


def test_it_plays_as_often_as_loop_says_and_at_speed_0_without_waiting_for_the_times(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"a"]), (HOUR_NS, [b"b"])])
    into = queue.SimpleQueue()
    with Player(tmp_path / "a.mcap", loop=3, speed=0) as player, ZMQSubscriber(player.address, into):
        assert player.wait(WAIT_S)
        assert [into.get(timeout=WAIT_S) for _ in range(6)] == [b"a", b"b"] * 3
    with Player(tmp_path / "a.mcap", loop=0, speed=0) as player, ZMQSubscriber(player.address, into):
        assert [into.get(timeout=WAIT_S) for _ in range(100)] == [b"a", b"b"] * 50
        assert not player.wait(0.0)


def test_another_subscriber_may_join_while_it_plays(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"t/", bytes(1_000)]), (2, [b"x"])])
    first, second = queue.SimpleQueue(), queue.SimpleQueue()
    with (
        Player(tmp_path / "a.mcap", speed=0, loop=0) as player,
        ZMQSubscriber(player.address, first, undecoded=True),
    ):
        first.get(timeout=WAIT_S)
        for _ in range(3):
            with ZMQSubscriber(player.address, second, "t", undecoded=True) as other:
                assert other.wait_joined(WAIT_S)
                assert bytes(second.get(timeout=WAIT_S).frames[0]) == b"t/"


@pytest.mark.slow
def test_nothing_is_sent_before_there_is_a_subscriber_unless_wait_is_false(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"x"])])
    into = queue.SimpleQueue()
    with Player(tmp_path / "a.mcap") as player:
        assert not player.wait_for_subscriber(0.0)
        # Otherwise it would come too late for what is sent once.
        with ZMQSubscriber(player.address, into):
            assert into.get(timeout=WAIT_S) == b"x"
        assert player.wait(WAIT_S)
        assert player.sent == 1
    with Player(tmp_path / "a.mcap", wait=False) as player:
        assert player.wait(WAIT_S)
        assert player.sent == 1


@pytest.mark.parametrize("wait", [True, False])
def test_a_player_stops_at_once_whatever_it_waits_for(tmp_path, wait):
    written(tmp_path / "a.mcap", [(1, [b"x"]), (HOUR_NS, [b"y"])])
    player = Player(tmp_path / "a.mcap", wait=wait).start()
    wait_until(lambda: wait or player.sent == 1)
    before = time.perf_counter()
    player.stop()
    assert time.perf_counter() - before < WAIT_S
    assert "stopped" in repr(player)


def test_starts_and_stops_leave_nothing_for_the_garbage_collector(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"x"])])
    for kind in (Player(tmp_path / "a.mcap"), Recorder(LOCAL, tmp_path / "b.mcap", bind=True, force=True)):
        before = weakref.getweakrefcount(kind)
        for _ in range(3):
            kind.start()
            kind.stop()
        assert weakref.getweakrefcount(kind) == before


def test_a_recording_is_finished_also_if_the_socket_can_not_be_closed_in_time(tmp_path):
    class Held:
        def __init__(self):
            self.began, self.go_on = threading.Event(), threading.Event()

        def put(self, item, *, block):
            self.began.set()
            assert self.go_on.wait(WAIT_S)

    held, out = Held(), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, ZMQSubscriber(pub.address, held) as sub:
        recorder = Recorder(LOCAL, tmp_path / "a.mcap", bind=True).start()
        assert sub.wait_joined(WAIT_S)
        # It holds up the thread of all sockets.
        out.put(b"x")
        assert held.began.wait(WAIT_S)
        try:
            with pytest.raises(StillRunning):
                recorder.stop(0.1)
            assert recorder.wait(WAIT_S)
        finally:
            held.go_on.set()


@pytest.mark.slow
def test_nothing_is_lost_on_the_way_to_a_subscriber_that_reads_late(peer, tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"%d" % number, bytes(10_000)]) for number in range(3_000)])
    sink = peer(zmq.SUB, rcvhwm=1)
    with Player(tmp_path / "a.mcap", speed=0) as player:
        sink.subscribe(b"")
        sink.connect(player.address)
        assert sink.recv_multipart()[0] == b"0"
        # It is held up by what is not read: far from all of it fits into sockets. Meanwhile another one plays it all.
        into = queue.SimpleQueue()
        with Player(tmp_path / "a.mcap", speed=0) as other, ZMQSubscriber(other.address, into, undecoded=True):
            for _ in range(3_000):
                into.get(timeout=WAIT_S)
        assert player.sent < 3_000
        assert [int(sink.recv_multipart()[0]) for _ in range(2_999)] == list(range(1, 3_000))
        assert player.wait(WAIT_S)


@pytest.mark.slow
def test_a_subscriber_that_does_not_read_does_not_keep_a_player_from_stopping(peer, tmp_path):
    written(tmp_path / "a.mcap", [(1, [bytes(100_000)])] * 300)
    sink = peer(zmq.SUB, rcvhwm=1)
    with Player(tmp_path / "a.mcap", speed=0, loop=0) as player:
        sink.subscribe(b"")
        sink.connect(player.address)
        assert sink.recv_multipart()
        before = time.perf_counter()
    assert time.perf_counter() - before < WAIT_S


@pytest.mark.slow
def test_what_came_can_be_played_a_second_later_while_it_still_records(tmp_path):
    out = queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub, Recorder(pub.address, tmp_path / "a.mcap") as recorder:
        assert recorder.wait_joined(WAIT_S)
        out.put(b"x")
        wait_until(lambda: recorder.counts.written == 1)
        assert recording_info(tmp_path / "a.mcap").messages == 1
        assert recording_info(tmp_path / "a.mcap").counts is None, "not finished"


# -- stopping and dying -----------------------------------------------------------------------------------------------


def record(address: str, path, *options: str, code: str = "") -> subprocess.Popen[str]:
    """Start ``epypes record`` as a process, after some code."""
    arguments = ["record", address, str(path), *options]
    process = subprocess.Popen(
        [sys.executable, "-c", f"{code}\nfrom epypes.cli import main\nmain({arguments!r})"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline().startswith("RECORDING ")
    return process


@pytest.mark.slow
def test_ctrl_c_finishes_the_file(tmp_path):
    out, path = queue.SimpleQueue(), tmp_path / "a.mcap"
    with ZMQPublisher(LOCAL, out, "t") as pub:
        process = record(pub.address, path)
        for _ in range(50):
            out.put(Envelope("x", {"image": IMAGE}))
        wait_until(lambda: still_there(path) > 0)
        pub.stop()
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert output == f"RECORDED {path}: received 50, written 50, dropped 0.\n"
    assert recording_info(path).counts == RecordingCounts(50, 50)
    assert recording_info(path).messages == 50


@pytest.mark.slow
def test_a_recorder_that_is_killed_leaves_a_file_that_plays(tmp_path):
    out, path, into = queue.SimpleQueue(), tmp_path / "a.mcap", queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out, "t") as pub:
        process = record(pub.address, path)
        for number in range(200):
            out.put(Envelope("x", {"n": number, "image": IMAGE}))
        wait_until(lambda: still_there(path) >= 100, timeout_s=60)
        process.kill()
        process.communicate(timeout=60)
    found = recording_info(path)
    assert found.counts is None
    player = Player(path, speed=0).start()
    with ZMQSubscriber(player.address, into):
        assert player.wait(WAIT_S)
        numbers = [into.get(timeout=WAIT_S).parts["n"] for _ in range(found.messages)]
    assert numbers == list(range(found.messages))
    with pytest.raises(RecordingError, match=r"a\.mcap breaks off: its recorder was killed"):
        player.stop()
    player.stop()


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_keeps_what_was_written(tmp_path):
    out, path = queue.SimpleQueue(), tmp_path / "a.mcap"
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (5_000_000, 5_000_000))"
    with ZMQPublisher(LOCAL, out, "t") as pub:
        process = record(pub.address, path, code=limit)
        for number in range(300):
            out.put(Envelope("x", {"n": number, "image": IMAGE}))
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors == f"epypes: {path} can't be written: File too large.\n"
    received, kept, dropped = map(int, re.findall(r"(?:received|written|disk failed) (\d+)", output))
    assert received == kept + dropped
    found = recording_info(path)
    assert found.counts is None
    assert 100 < found.messages == kept < 200
    readable, text = read_until_error(path)
    assert [decode(frames).parts["n"] for frames in readable] == list(range(kept))
    assert "breaks off" in text
    assert path.stat().st_size < 5_000_000, "the part of a chunk that the disk took is cut off"


class SlowDisk:
    """A named pipe in place of a file: it takes 64 kB, and more only when it is read."""

    def __init__(self, path) -> None:
        os.mkfifo(path)
        self._end = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.content = b""

    def read_all(self) -> None:
        """Take what is written until the writer closes."""
        os.set_blocking(self._end, True)
        while data := os.read(self._end, 1 << 20):
            self.content += data
        os.close(self._end)


def test_what_a_slow_disk_does_not_take_is_dropped_and_counted(tmp_path):
    disk, out = SlowDisk(tmp_path / "pipe"), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub:
        recorder = Recorder(pub.address, tmp_path / "pipe", force=True, backlog_bytes=1_000_000).start()
        assert recorder.wait_joined(WAIT_S)
        for _ in range(10):
            out.put(bytes(1_500_000))
        wait_until(lambda: recorder.counts.received == 10)
        assert recorder.counts.dropped["disk too slow"] >= 7
        reader = threading.Thread(target=disk.read_all)
        reader.start()
        recorder.stop()
        reader.join(WAIT_S)
    counts = recorder.counts
    assert counts.received == counts.written + counts.dropped["disk too slow"] == 10
    assert counts.written >= 1
    (tmp_path / "a.mcap").write_bytes(disk.content)
    found = recording_info(tmp_path / "a.mcap")
    assert found.counts == counts
    assert found.messages == counts.written


@pytest.mark.slow
def test_a_write_that_never_returns_is_named(tmp_path):
    disk, out = SlowDisk(tmp_path / "pipe"), queue.SimpleQueue()
    with ZMQPublisher(LOCAL, out) as pub:
        recorder = Recorder(pub.address, tmp_path / "pipe", force=True).start()
        assert recorder.wait_joined(WAIT_S)
        out.put(bytes(3_000_000))
        out.put(bytes(3_000_000))
        wait_until(lambda: recorder.counts.received == 2)
        with pytest.raises(StillRunning, match="pipe.*write"):
            recorder.stop(timeout_s=0.1)
        disk.read_all()
        recorder.stop()
    assert recorder.counts == RecordingCounts(2, 1, Counter({"disk too slow": 1})), "the time for what waited was over"


def threads_of_recording() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("epypes-")]


def test_stop_works_before_start_and_twice_and_start_works_again(tmp_path):
    recorder = Recorder(LOCAL, tmp_path / "a.mcap", bind=True)
    recorder.stop()
    recorder.start().start()
    assert recorder.address != LOCAL
    assert not recorder.wait(0.0)
    recorder.stop()
    recorder.stop()
    with pytest.raises(RecordingError, match="is there already"):
        recorder.start()
    again = Recorder(LOCAL, tmp_path / "a.mcap", bind=True, force=True)
    for _ in range(2):
        with again:
            assert "running" in repr(again)
        assert "stopped" in repr(again)
    written(tmp_path / "a.mcap", [(1, [b"x"])])
    player = Player(tmp_path / "a.mcap")
    player.stop()
    for _ in range(2):
        player.start().start()
        assert player.address != LOCAL
        player.stop()
        player.stop()
    assert threads_of_recording() == []


def test_on_end_may_stop_what_has_ended(tmp_path):
    ended = queue.SimpleQueue()

    def end() -> None:
        both[0].stop()
        ended.put(None)

    both = [Recorder(LOCAL, tmp_path / "a.mcap", bind=True, on_end=end)]
    both[0].start().stop()
    ended.get(timeout=WAIT_S)
    written(tmp_path / "b.mcap", [(1, [b"x"])])
    both = [Player(tmp_path / "b.mcap", wait=False, on_end=end)]
    both[0].start()
    ended.get(timeout=WAIT_S)
    both[0].stop()


@pytest.mark.slow
def test_a_player_or_recorder_that_becomes_garbage_gives_a_warning_and_ends(tmp_path):
    written(tmp_path / "a.mcap", [(1, [b"x"])])
    player = Player(tmp_path / "a.mcap").start()
    with pytest.warns(ResourceWarning, match="Player .* left running"):  # noqa: PT031  the last reference goes inside
        del player
        gc.collect()
    recorder = Recorder(LOCAL, tmp_path / "b.mcap", bind=True).start()
    with pytest.warns(ResourceWarning, match="left running"):  # noqa: PT031
        del recorder
        gc.collect()
    wait_until(lambda: threads_of_recording() == [])
    assert recording_info(tmp_path / "b.mcap").counts == RecordingCounts()


# -- what is refused --------------------------------------------------------------------------------------------------


def test_an_existing_file_is_kept_unless_force_is_given(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecordingError, match="is there already.*--force"):
        Recorder(LOCAL, path, bind=True).start()
    assert path.read_bytes() == b"precious"
    with ZMQPublisher(LOCAL, queue.SimpleQueue()) as pub, pytest.raises(AddressError, match="in use"):
        Recorder(pub.address, path, bind=True, force=True).start()
    assert path.read_bytes() == b"precious", "nothing is replaced by a recording that can't begin"
    with Recorder(LOCAL, path, bind=True, force=True):
        pass
    assert recording_info(path).messages == 0
    assert threads_of_recording() == []


def test_the_queue_of_a_broker_is_neither_recorded_nor_played_to(tmp_path):
    address, refused = "nats://me:secret@127.0.0.1/events", "^nats://me@127.0.0.1:4222/events is an address of a broker"
    with pytest.raises(AddressError, match=f"{refused}: .*messages from other consumers. Give one of ZeroMQ"):
        Recorder(address, tmp_path / "a.mcap")
    with pytest.raises(AddressError, match=f"{refused}: no recording is played to it"):
        Player(tmp_path / "a.mcap", address)


def test_a_place_that_can_not_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    for place in (tmp_path / "no" / "a.mcap", tmp_path / "file" / "a.mcap"):
        with pytest.raises(RecordingError, match=r"a\.mcap can't be written: (No such|Not a)"):
            Recorder(LOCAL, place, bind=True).start()
    with pytest.raises(RecordingError, match="directory"):
        Recorder(LOCAL, tmp_path, bind=True, force=True).start()
    assert threads_of_recording() == []


def foreign(path) -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/camera", "cdr", 0)
        writer.add_message(channel, log_time=1, data=b"x", publish_time=1)
        writer.finish()


def spoilt(path) -> None:
    written(path, [(1, [bytes(1_000)])])
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


REFUSED = {
    "is no MCAP file": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100)),
    "no MCAP file, or an empty one": lambda path: path.touch(),
    "no recording of EPypes: its topic '/camera' has messages of encoding 'cdr'": foreign,
    "is damaged: crc": spoilt,
    "breaks off": lambda path: (written(path, [(1, [b"x"])]), os.truncate(path, 60)),
    "holds no message": lambda path: written(path, []),
    "can't be read: No such file": lambda path: None,
    "can't be read: Is a directory": lambda path: path.mkdir(),
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_no_recording_is_refused_before_a_socket_is_opened(tmp_path, text):
    REFUSED[text](tmp_path / "a.mcap")
    with pytest.raises(RecordingError, match=re.escape(text)) as caught:
        Player(tmp_path / "a.mcap").start()
    assert caught.value.path == str(tmp_path / "a.mcap")
    assert "\n" not in str(caught.value)
    assert threads_of_recording() == []


@pytest.mark.slow
def test_a_file_cut_anywhere_gives_what_is_whole_and_one_error(tmp_path):
    whole, part = tmp_path / "a.mcap", tmp_path / "b.mcap"
    writer = RecordingWriter(whole, {}, force=False)
    for number in range(10):
        writer.append(number, [b"t/", b"%d" % number, bytes(50)])
        writer.flush()
    writer.finish(RecordingCounts(10, 10))
    content, counts = whole.read_bytes(), set()
    for length in range(0, content.index(b"epypes.counts"), 7):
        part.write_bytes(content[:length])
        numbers = [int(frames[1]) for frames in read_until_error(part)[0]]
        assert numbers == list(range(len(numbers)))
        counts.add(len(numbers))
    assert counts == set(range(11))
    part.write_bytes(content[:-20])
    assert len(frames_of(part)) == 10, "only the index at its end is missing, which a player does not need"


@pytest.mark.slow
@pytest.mark.parametrize("count", [150, pytest.param(20_000, marks=pytest.mark.soak)])
def test_a_damaged_file_never_gives_anything_but_a_recording_error(tmp_path, count):
    path = tmp_path / "a.mcap"
    written(path, [(number, [b"t/", b"%d" % number]) for number in range(20)])
    content, refused = path.read_bytes(), 0
    rng = random.Random(2019)
    for _ in range(count):
        changed = bytearray(content)
        for _ in range(rng.randint(1, 3)):
            changed[rng.randrange(len(changed))] = rng.choice([0, 1, 0x7F, 0x80, 0xFF])
        path.write_bytes(changed)
        try:
            frames = frames_of(path)
            recording_info(path)
        except RecordingError:
            refused += 1
        else:
            assert len(frames) <= 20
    assert refused > count // 4


@pytest.mark.parametrize("options", [{"speed": -1}, {"speed": float("nan")}, {"speed": float("inf")}, {"loop": -1}])
def test_a_speed_that_makes_no_sense_is_refused(tmp_path, options):
    with pytest.raises(ValueError, match="give"):
        Player(tmp_path / "a.mcap", **options)


@pytest.mark.slow
def test_keys_keep_strangers_from_what_is_recorded_and_played(tmp_path):
    robot, known, stranger = (make_keys(tmp_path / name) for name in ("robot", "known", "stranger"))
    written(tmp_path / "a.mcap", [(1, [b"t/", b"secret"])])
    with (
        Player(tmp_path / "a.mcap", keys=robot, allow=known) as player,
        Recorder(player.address, tmp_path / "b.mcap", keys=stranger, allow=robot) as enemy,
    ):
        assert not enemy.wait_joined(0.3)
        assert player.sent == 0
        with Recorder(player.address, tmp_path / "c.mcap", keys=known, allow=robot, messages=1) as recorder:
            assert recorder.wait(WAIT_S)
    assert frames_of(tmp_path / "b.mcap") == []
    assert frames_of(tmp_path / "c.mcap") == [[b"t/", b"secret"]]
