"""Failures are kept and read again, whatever the disk, a storm of failures or another service does."""

from __future__ import annotations

import json
import os
import resource
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from time import monotonic, time_ns

import numpy as np
import pytest

from epypes.errors import FailureNotKept, UnknownName
from epypes.service.failures.record import FailedEvent
from epypes.service.failures.store import FailureStore, failures_folder
from epypes.wire import Envelope

FAILED = FailedEvent(
    event_id="77",
    function="blur",
    tokens=("image", "blurred"),
    exception="ValueError",
    message="no rows",
    trace=("Traceback", "ValueError: no rows"),
    hyperparameters={"k": {"value": 11}, "mask": {"kind": "none"}},
    digest="ab" * 32,
    revision=3,
)


@pytest.fixture
def store(tmp_path):
    return FailureStore(tmp_path / "failures")


def kept(store, *events, record=FAILED):
    """Keep a failure for each event; return their records."""
    records = [store.keep(record, event) for event in events]
    assert store.flush(10)
    return records


def test_a_failure_is_kept_with_its_event_and_had_again_after_a_restart(store):
    image = np.arange(300, dtype=np.uint8).reshape(10, 10, 3)
    (record,) = kept(store, Envelope("request", {"image": image}, id="77"))
    again = FailureStore(store.folder)
    assert again.record(record.id) == replace(record, has_event=True)
    assert again.records() == [again.record(record.id)]
    event = again.event(record.id)
    assert event.id == "77"
    assert np.array_equal(event.parts["image"], image)


def test_a_message_of_2019_is_kept_as_its_bytes(store):
    (record,) = kept(store, b"\x0a\x03abc")
    assert bytes(store.event(record.id)) == b"\x0a\x03abc"


def test_records_come_newest_first_and_as_many_as_asked_for(store):
    records = kept(store, *[b"x"] * 5)
    ids = [record.id for record in records]
    assert [record.id for record in store.records()] == ids[::-1]
    assert [record.id for record in store.records(2)] == ids[:2:-1]
    assert sorted(ids) == ids


@pytest.fixture
def held_disk(store):
    """A disk that writes nothing until the returned function is called: the part of the first file is a named pipe."""
    first = FailureStore(store.folder.parent / "ids").keep(FAILED)
    store.folder.mkdir(parents=True)
    # To open a named pipe for writing waits until it is read.
    pipe = store.folder / f".{first.id}.failure.{os.getpid()}.part"
    os.mkfifo(pipe)
    store.keep(first, b"held")
    readers = []
    yield lambda: readers.append(os.open(pipe, os.O_RDONLY))
    for reader in readers:
        os.close(reader)


def test_handing_over_waits_for_no_disk(store, held_disk):
    store.keep(FAILED, b"waits")
    assert not store.flush(0.2), "the disk answers nobody"
    held_disk()
    assert store.flush(60)


def test_a_storm_keeps_its_first_failures_and_counts_the_others(store):
    records = [store.keep(FAILED, b"%d" % number) for number in range(500)]
    odd = store.keep(replace(FAILED, kind="killed", exception=""), b"odd")
    assert store.flush(20)
    found = [record.id for record in reversed(store.records())]
    assert found[:10] == [record.id for record in records[:10]]
    assert found[-1] == odd.id, "another cause is not pushed out"
    counts = store.counts()
    assert counts["kept"] == len(found)
    assert counts["kept"] + counts["skipped"] == 501


def test_no_more_are_kept_than_asked_for_and_how_a_storm_began_can_be_seen(tmp_path):
    store = FailureStore(tmp_path, most=8, burst=50)
    other = kept(store, b"other", record=replace(FAILED, function="canny"))
    storm = kept(store, *[b"x"] * 20)
    found = [record.id for record in reversed(store.records())]
    assert found == [record.id for record in (*other, *storm[:3], *storm[-4:])]
    assert store.counts()["removed"] == 13


def test_the_folder_takes_no_more_bytes_than_asked_for(tmp_path):
    store = FailureStore(tmp_path, most_bytes=100_000, burst=50)
    records = kept(store, *[os.urandom(20_000)] * 10)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 100_000
    assert len(store.records()) == 4
    assert store.records()[0].id == records[-1].id


def test_an_event_that_is_too_large_leaves_a_record_that_says_so(tmp_path):
    store = FailureStore(tmp_path, most_bytes=1_000_000)
    (record,) = kept(store, bytes(300_000))
    found = store.record(record.id)
    assert not found.has_event
    assert "0.3 MB, more than the 0.2 MB of one event" in found.no_event
    with pytest.raises(FailureNotKept, match=r"was not kept: it has 0\.3 MB"):
        store.event(record.id)
    assert store.counts()["without_event"] == 1


def test_a_failure_without_event_says_so(store):
    (record,) = kept(store, None)
    with pytest.raises(FailureNotKept, match="the service had none to give") as error:
        store.event(record.id)
    assert error.value.id == record.id


@pytest.fixture
def small_disk():
    """Files of this process can't grow beyond 100 kB, as if the disk were full."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, before)


def test_on_a_full_disk_the_record_is_kept_without_its_event_and_no_half_of_a_file_stays(store, small_disk):
    (record,) = kept(store, bytes(1_000_000))
    assert not store.record(record.id).has_event
    assert store.record(record.id).no_event == "it could not be written"
    assert [path.name for path in store.folder.iterdir()] == [f"{record.id}.failure"]
    (record,) = kept(store, bytes(1_000))
    assert store.record(record.id).has_event


def test_a_folder_that_cannot_be_made_is_counted_and_the_next_failure_is_kept_when_it_can(tmp_path):
    place = tmp_path / "taken"
    place.write_text("a file")
    store = FailureStore(place / "failures")
    kept(store, b"x")
    assert store.counts()["unwritten"] == 1
    assert store.records() == []
    place.unlink()
    (record,) = kept(store, b"x")
    assert store.record(record.id).has_event


@pytest.mark.skipif(os.getuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_counted(store):
    store.folder.mkdir(parents=True)
    store.folder.chmod(0o500)
    kept(store, b"x")
    assert store.counts()["unwritten"] == 1


def test_the_folder_is_for_its_owner_alone(store):
    (record,) = kept(store, b"x")
    assert store.folder.stat().st_mode & 0o077 == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in store.folder.iterdir())
    assert record.id


def test_files_of_others_are_left_alone_and_damaged_ones_are_counted_and_told(tmp_path):
    store = FailureStore(tmp_path, most=4, burst=50)
    (good,) = kept(store, b"good")
    (tmp_path / "notes.json").write_text("mine")
    (tmp_path / "sub").mkdir()
    wrong = [{"id": good.id}, {"attempt": "1"}, {"tokens": "image"}, {"hyperparameters": []}, {"id": "../../etc"}]
    bad = [b"", b"{", b"[" * 100_000, b"null"]
    bad += [json.dumps(asdict(FAILED) | each).encode() for each in wrong]
    others = (good.id[:-2] + f"{number:02}" for number in range(len(bad) + 1))
    names = [name for name in others if name != good.id][: len(bad)]
    for name, text in zip(names, bad, strict=True):
        (tmp_path / f"{name}.failure").write_bytes(text)
    assert [record.id for record in store.records()] == [good.id]
    assert store.counts()["unreadable"] == len(bad)
    for name in names:
        with pytest.raises(FailureNotKept, match=f"{name}.failure can't be read"):
            store.record(name)
    newer = kept(store, b"new", b"new")
    assert [record.id for record in store.records()] == [newer[1].id, newer[0].id, good.id]
    assert (tmp_path / "notes.json").read_text() == "mine"


def test_an_event_that_was_cut_off_is_not_taken_for_the_one_that_failed(store):
    (record,) = kept(store, Envelope("request", {"image": np.zeros((4, 4), np.uint8)}))
    path = store.folder / f"{record.id}.failure"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FailureNotKept, match=r"\.failure can't be read: "):
        store.event(record.id)


def test_an_id_that_is_none_leads_nowhere_and_the_nearest_is_named(store):
    (record,) = kept(store, b"x")
    with pytest.raises(UnknownName, match=f"Did you mean {record.id!r}"):
        store.record(record.id[:-1] + ("x" if record.id[-1] != "x" else "y"))
    (store.folder.parent / "secret.failure").write_text("{}")
    for name in ("../secret", "", "x/../y", "\0"):
        with pytest.raises(UnknownName):
            store.record(name)
        with pytest.raises(UnknownName):
            store.packed_event(name)


def test_two_services_share_a_folder(tmp_path):
    stores = [FailureStore(tmp_path, most=10, burst=100) for _ in range(2)]

    def keep(store):
        for _ in range(40):
            store.keep(FAILED, b"x" * 1_000)
        return store.flush(20)

    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(keep, stores))
    assert sum(store.counts()["unwritten"] for store in stores) == 0
    (last,) = kept(stores[0], b"x")
    found = stores[1].records()
    assert len(found) == 10
    assert found[0].id == last.id
    assert not list(tmp_path.glob(".*"))


def test_what_a_killed_service_has_begun_is_removed_when_it_is_old(store):
    kept(store, b"x")
    name = "0" * 14
    old, young = (store.folder / f".{name}.failure.{pid}.part" for pid in (1, 2))
    for path in (old, young):
        path.write_bytes(b"x")
    os.utime(old, (1, 1))
    kept(store, b"x")
    assert not old.exists()
    assert young.exists()


def test_no_thread_stays_when_nothing_waits(store):
    kept(store, b"x")
    never = threading.Event()
    deadline = monotonic() + 5
    while any(thread.name == "epypes failures" for thread in threading.enumerate()):
        assert monotonic() < deadline
        never.wait(0.005)


def test_each_bundle_has_a_folder_in_the_users_state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    one, other = failures_folder(tmp_path / "a"), failures_folder(tmp_path / "b")
    assert one.parent == other.parent == tmp_path / "epypes" / "failures"
    assert one != other == failures_folder(tmp_path / "a" / ".." / "b")


def test_ids_of_many_threads_are_unique_and_rise_when_the_clock_goes_back(store):
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: store.keep(FAILED).id, range(400)))
    assert len(set(found)) == 400
    later = store.keep(replace(FAILED, when_ns=time_ns())).id
    assert later < store.keep(replace(FAILED, when_ns=1)).id
    assert store.flush(60)


def test_what_waits_in_memory_is_bounded_for_any_number_of_causes(store, held_disk):
    for number in range(400):
        store.keep(replace(FAILED, function=str(number % 40)), b"x")
    held_disk()
    assert store.flush(60)
    counts = store.counts()
    assert counts["kept"] + counts["skipped"] == 401
    assert counts["kept"] <= 40


def test_a_full_disk_writes_one_line_to_the_log_whatever_fails(tmp_path, caplog):
    (tmp_path / "taken").write_text("a file")
    store = FailureStore(tmp_path / "taken" / "failures", burst=20)
    for _ in range(20):
        store.keep(FAILED, b"x")
        assert store.flush(60)
    assert store.counts()["unwritten"] == 20
    assert caplog.text.count("can't be written") == 1


def test_a_record_is_read_as_it_was_written_and_keys_of_later_versions_are_left_out(store):
    odd = replace(FAILED, message="\ud800 half of a pair", trace=("\x00",))
    (record,) = kept(store, b"x", record=odd)
    path = store.folder / f"{record.id}.failure"
    line, _, event = path.read_bytes().partition(b"\n")
    later = {**json.loads(line), "of a later version": 1}
    path.write_bytes(json.dumps(later).encode() + b"\n" + event)
    assert store.record(record.id) == replace(record, has_event=True)


def test_long_texts_are_cut(store):
    (record,) = kept(store, b"x", record=replace(FAILED, message="x" * 10**6, trace=("y" * 10**5,) * 1_000))
    assert (store.folder / f"{record.id}.failure").stat().st_size < 500_000
    assert len(store.record(record.id).trace) == 200
