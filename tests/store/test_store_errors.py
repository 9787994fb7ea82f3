"""The errors of a store whose database is away, full, damaged or not to be had; none contains a password."""

from __future__ import annotations

import gc
import os
import shutil
import sqlite3
import subprocess
import sys
import traceback
from concurrent.futures import ThreadPoolExecutor
from time import monotonic

import pytest
import sqlalchemy as sa

from epypes.errors import StoreError
from epypes.store import Store
from tests.store.postgres import PASSWORD, server


def refused(place):
    """Return the error of a place where no store can be."""
    with pytest.raises(StoreError) as caught:
        Store(place)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def execute(store, statement):
    """Execute a statement as another program does."""
    engine = sa.create_engine(store.url)
    with engine.begin() as connection:
        connection.execute(sa.text(statement))
    engine.dispose()


def test_there_must_be_a_folder_for_the_file(tmp_path):
    message = refused(tmp_path / "none" / "results.sqlite")
    assert message == f"There is no folder {tmp_path}/none to store 'results.sqlite' in. Make it first."
    assert refused(tmp_path) == f"{tmp_path} is no file. Name one: 'results.sqlite'."
    assert "There is no folder" in refused(f"sqlite:///{tmp_path}/none/results.sqlite")


def test_what_is_neither_a_path_nor_a_url_is_refused_by_name():
    for wrong in (None, 3, b"results.sqlite"):
        with pytest.raises(TypeError, match=f"A store is a path or a URL, not {wrong!r}"):
            Store(wrong)


def test_what_is_no_file_is_refused_before_it_is_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place in ("/dev/null", tmp_path / "pipe", "sqlite:////dev/null"):
        assert "is no file. Name one" in refused(place)


@pytest.mark.slow
def test_a_store_that_was_closed_is_neither_read_nor_written(place):
    with Store(place) as store:
        series = store.series("map", "edges")
        series.append("a", {})
    for doing in (
        lambda: series.append("b", {}),
        lambda: series.get("a"),
        lambda: len(series),
        lambda: list(series.rows()),
        lambda: store.series("map", "edges", about={}),
        store.kinds,
    ):
        with pytest.raises(StoreError, match=r"was closed. Open it again: ep.Store"):
            doing()
    with Store(place) as store:
        assert store.series("map", "edges").keys() == {"a"}


def test_a_series_goes_on_without_a_reference_to_its_store(place):
    series = Store(place).series("map", "edges")
    series.append("a", {})
    assert series.keys() == {"a"}
    del series
    gc.collect()


@pytest.mark.parametrize(
    "place", ["", ":memory:", "sqlite://", "sqlite:///:memory:", "sqlite:///file:x?mode=memory&uri=true"]
)
def test_what_is_only_in_memory_is_refused(place):
    assert "what is in memory only is lost. Name one: 'results.sqlite'" in refused(place)


def test_a_file_that_is_no_database_is_left_alone(tmp_path):
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG" * 2_000)
    message = refused(path)
    assert message.startswith(f"{path} is no SQLite file, or a damaged one:")
    assert path.read_bytes() == b"\x89PNG" * 2_000


def test_a_file_that_was_damaged_is_reported(tmp_path):
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        store.series("map", "edges").append_all((f"{number}", {"text": "x" * 500}) for number in range(200))
    data = bytearray(path.read_bytes())
    data[8192:-4096] = b"\xff" * (len(data) - 8192 - 4096)
    path.write_bytes(data)
    with pytest.raises(StoreError, match="a damaged one"), Store(path) as store:
        list(store.series("map", "edges").rows())


def test_a_row_that_was_written_by_another_program_is_reported_with_its_key(store):
    series = store.series("map", "edges")
    series.append("mine", {"x": 1})
    execute(store, "UPDATE epypes_rows SET data = '{half'")
    with pytest.raises(StoreError, match="Row 'mine' of map 'edges' in .* is damaged"):
        series.get("mine")


_WITHOUT_ROOM = """
import sys, signal, resource
from epypes.errors import StoreError
from epypes.store import Store

with Store(sys.argv[1]) as store:
    series = store.series("map", "edges")
    series.append("small", {"x": 1})
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, -1))
    try:
        series.append_all([("first", {"x": 2}), ("large", {"text": "x" * 3_000_000})])
    except StoreError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
    print(sorted(series.keys()))
    series.append("later", {"x": 3})
    print(sorted(series.keys()))
"""


@pytest.mark.slow
def test_a_full_disk_is_reported_and_nothing_is_half_written(tmp_path):
    path = tmp_path / "results.sqlite"
    done = subprocess.run([sys.executable, "-c", _WITHOUT_ROOM, path], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    message, *keys = done.stdout.splitlines()
    assert message.startswith(f"{path} can't be written:")
    assert message.endswith("Make room on the disk.")
    assert keys == ["['small']", "['later', 'small']"]


_AS_NOBODY = """
import os, sys
if os.geteuid() == 0:
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
from epypes.errors import StoreError
from epypes.store import Store
try:
    with Store(sys.argv[1]) as store:
        store.series("map", "edges").append("a", {})
except StoreError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_file_that_may_not_be_written_is_reported(tmp_path_factory):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        path = folder / "results.sqlite"
        Store(path).close()
        path.chmod(0o444)
        folder.chmod(0o555)
        # Packages may be where nobody else can read them: they are loaded before it is not root any more.
        code = "import sqlite3, sqlalchemy.dialects.sqlite, epypes.store.database\n" + _AS_NOBODY
        done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60)
        folder.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{path} can't be opened or written:")
    assert "Check the permissions" in done.stdout


@pytest.mark.slow
def test_a_file_that_another_process_holds_is_waited_for_and_then_reported(tmp_path, monkeypatch):
    monkeypatch.setattr("epypes.store.database._BUSY_S", 0.2)
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        series = store.series("map", "edges")
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="is locked by another process"):
            series.append("a", {})
        assert series.keys() == frozenset(), "a reader does not wait"
        other.execute("ROLLBACK")
        other.close()
        series.append("a", {})
        assert series.keys() == {"a"}


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("nosuch://u:s3cr3t@host/db", "SQLAlchemy knows no 'nosuch'"),
        ("postgresql+nosuch://u:s3cr3t@host/db", "SQLAlchemy knows no 'postgresql+nosuch'"),
        ("mysql://u:s3cr3t@host/db", "module 'MySQLdb' is not installed. Install a driver of mysql"),
        ("postgresql://u:s3cr3t@host:s3cr3t@/db", "special characters of a password are written as %40"),
        ("postgresql://u:s3cr3t@:99999999/db", ""),
        ("postgresql://u:s3cr3t@127.0.0.1:1/db?password=s3cr3t", "can't be reached"),
        ("postgresql://u:s3cr3t@nosuch.invalid/db", "can't be reached"),
        ("://u:s3cr3t@host/db", ""),
    ],
)
def test_a_url_that_leads_nowhere_is_an_error_without_its_password(place, reason):
    with pytest.raises(StoreError) as caught:
        Store(place)
    whole = "".join(traceback.format_exception(caught.value))
    assert reason in str(caught.value)
    assert "s3cr3t" not in str(caught.value) + caught.value.place
    # The traceback shows this file's own lines, which name no password either.
    assert "s3cr3t" not in whole


@pytest.mark.slow
def test_a_refused_login_is_an_error_and_the_password_is_nowhere(postgres):
    with Store(postgres.url()) as store:
        shown = repr(store) + store.place
    assert PASSWORD not in shown
    assert "%40" not in shown
    for wrong in (
        postgres.url().replace("W%C3", "X").replace("epypes:", "somebody:"),
        postgres.url().replace("%2F1", "2"),
    ):
        message = refused(wrong)
        assert "does not let you in" in message
        assert "pa%40" not in message
        assert "pa@ss" not in message
    assert "is not there" in refused(postgres.url().replace("/postgres?", "/nosuch?"))


@pytest.mark.slow
def test_a_server_that_dies_is_reported_and_after_a_restart_the_same_store_works_again():
    with server() as own, Store(own.url()) as store:
        series = store.series("map", "edges")
        series.append("before", {"x": 1})
        own.stop(at_once=True)
        for doing in (lambda: series.append("lost", {"x": 2}), lambda: list(series.rows()), store.kinds):
            began_s = monotonic()
            with pytest.raises(StoreError, match=r"127.0.0.1.* can't be reached: .* Check that it runs"):
                doing()
            assert monotonic() - began_s < 20
        own.start()
        series.append("after", {"x": 3})
        own.stop(at_once=True)
        own.start()
        series.append("unnoticed", {"x": 4})
        assert sorted(series.keys()) == ["after", "before", "unnoticed"]


@pytest.mark.slow
def test_a_password_that_a_server_repeats_is_left_out(postgres):
    message = refused(postgres.url().replace("search_path%3D", "pa%40ss%3Aw%C3%B6rd%2F1%3D"))
    assert "***" in message
    assert PASSWORD not in message


# -- a file that is another one now -----------------------------------------------------------------------------


def keys_in(path):
    with Store(path) as store:
        return store.series("map", "edges").keys()


def test_a_file_that_is_deleted_is_made_anew_with_all_that_comes_then_and_logged_once(tmp_path, caplog):
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        other, series = store.series("map", "other"), store.series("map", "edges", about={"k": 3})
        series.append("before", {})
        path.unlink()
        assert series.keys() == frozenset(), "a reader sees the new file"
        assert caplog.text.count("was deleted, moved or replaced") == 1
        for number in range(3):
            series.append(f"{number}", {"n": number})
        assert path.is_file()
        assert series.keys() == keys_in(path) == {"0", "1", "2"}
        assert store.names("map") == ("edges",)
        assert store.series("map", "edges").about == {"k": 3}
        other.append("a", {})
        assert store.names("map") == ("edges", "other")
        assert caplog.text.count("was deleted, moved or replaced") == 1
        path.unlink()
        series.append("again", {})
        assert caplog.text.count("was deleted, moved or replaced") == 2
    assert keys_in(path) == {"again"}


def test_a_file_that_is_deleted_with_all_beside_it_is_made_anew(tmp_path):
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        series = store.series("map", "edges")
        for key in "ab":
            for left in tmp_path.iterdir():
                left.unlink()
            series.append(key, {})
    assert keys_in(path) == {"b"}


def test_a_file_that_is_moved_away_has_all_until_then(tmp_path):
    path, moved = tmp_path / "results.sqlite", tmp_path / "monday.sqlite"
    with Store(path) as store:
        series = store.series("map", "edges")
        series.append("before", {})
        path.rename(moved)
        series.append("after", {})
    assert keys_in(path) == {"after"}
    assert keys_in(moved) == {"before"}


def test_a_file_that_is_replaced_by_another_is_gone_on_with_and_stays_whole(tmp_path):
    path, fresh = tmp_path / "results.sqlite", tmp_path / "fresh.sqlite"
    with Store(fresh) as store:
        # Series and rows have other numbers there.
        store.series("sweep", "first").append_all((f"{number}", {"text": "x" * 500}) for number in range(50))
        store.series("map", "edges").append("theirs", {})
    with Store(path) as store:
        series = store.series("map", "edges")
        series.append_all((f"{number}", {"text": "y" * 500}) for number in range(50))
        fresh.rename(path)
        assert series.keys() == {"theirs"}
        series.append("ours", {})
        assert series.keys() == keys_in(path) == {"theirs", "ours"}
        assert len(store.series("sweep", "first")) == 50
    whole = sqlite3.connect(path)
    assert whole.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    whole.close()


def test_threads_lose_nothing_once_their_file_was_deleted(tmp_path):
    path = tmp_path / "results.sqlite"
    with Store(path) as store, ThreadPoolExecutor(4) as pool:
        series = store.series("map", "edges")
        list(pool.map(lambda number: series.append("before", {"n": number}), range(50)))
        path.unlink()
        list(pool.map(lambda number: series.append(f"{number}", {}), range(200)))
        assert len(series) == 200
    assert len(keys_in(path)) == 200


def test_two_stores_go_on_with_the_same_new_file(tmp_path):
    path = tmp_path / "results.sqlite"
    with Store(path) as one, Store(path) as other:
        ours, theirs = one.series("map", "edges"), other.series("map", "edges")
        ours.append("before", {})
        path.unlink()
        for number in range(20):
            ours.append(f"ours {number}", {})
            theirs.append(f"theirs {number}", {})
        assert len(ours.keys()) == 40
        assert ours.keys() == theirs.keys()
    assert len(keys_in(path)) == 40


def test_a_file_whose_folder_is_gone_is_reported(tmp_path):
    folder = tmp_path / "results"
    folder.mkdir()
    with Store(folder / "results.sqlite") as store:
        series = store.series("map", "edges")
        shutil.rmtree(folder)
        with pytest.raises(StoreError, match="can't be opened or written"):
            series.append("a", {})
        folder.mkdir()
        series.append("b", {})
        assert series.keys() == {"b"}


def test_a_url_of_sqlite_with_options_follows_its_file_too(tmp_path):
    path = tmp_path / "odd name.sqlite"
    with Store(f"sqlite:///file:{tmp_path}/odd%20name.sqlite?uri=true") as store:
        series = store.series("map", "edges")
        series.append("before", {})
        path.unlink()
        series.append("after", {})
        assert keys_in(path) == {"after"}


def test_a_store_without_sqlalchemy_says_what_to_install():
    code = (
        "import sys; sys.modules['sqlalchemy'] = None\n"
        "import epypes as ep\n"
        "try:\n    ep.Store('x.sqlite')\nexcept ep.errors.MissingPackage as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=os.sep)
    assert done.stdout == "Package 'sqlalchemy' is missing. Run: pip install 'epypes[store]'\n"
