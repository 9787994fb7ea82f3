"""A store gives back what was put in, whatever other processes write, in a file and in PostgreSQL alike."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import epypes as ep
from epypes.store import Store, opened_store

ODD = {
    "nan": math.nan,
    "floats": [math.inf, -math.inf, 0.1, -0.0, 1e308, 5e-324],
    "none": None,
    "truth": [True, False],
    "large": 2**80,
    "text": "grün 図 🙂 \x00 \x1f \n \" ' \\ %s :name ? {} $float",
    "half": "\udc80 file \ud83d",
    "empty": {"": [], "dict": {}, "text": ""},
    "words": {"$float": "nan"},
    "deep": [{"$dict": {"$float": 1.5}}, {"$dict": {"$float": math.inf}}, {"$float": [math.nan]}],
    "a \x00 key \udcff": 1,
}


def alike(one, other):
    return repr(one) == repr(other)


@pytest.mark.slow
def test_a_row_comes_back_as_it_was(place):
    with Store(place) as store:
        store.series("map", "edges").append("odd", ODD)
    with Store(place) as store:
        found = store.series("map", "edges").get("odd")
    assert alike(found, ODD)


def test_what_is_written_is_json_that_every_reader_understands(place):
    import sqlalchemy as sa

    with Store(place) as store:
        store.series("map", "edges").append("odd", ODD)
        engine = sa.create_engine(store.url)
        with engine.connect() as connection:
            text = connection.execute(sa.text("SELECT data FROM epypes_rows")).scalar()
        engine.dispose()
    assert json.loads(text, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))["text"] == ODD["text"]


def test_numbers_of_numpy_are_numbers(store):
    series = store.series("map", "numpy")
    series.append("a", {"i": np.int64(3), "f": np.float32(0.5), "b": np.bool_(True), "n": np.float64("nan")})
    series.append("b", {"list": [np.float32("inf")], "scalar": np.array(4)})
    assert alike(series.get("a"), {"i": 3, "f": 0.5, "b": True, "n": math.nan})
    assert alike(series.get("b"), {"list": [math.inf], "scalar": 4})


def test_names_and_keys_may_be_any_text_of_any_length(store):
    for name in ("", "grün\x00図", "\udcff.png", 'quote " and \\ backslash', "x" * 5_000):
        series = store.series("map", name)
        series.append(name, {"name": name})
        assert series.keys() == {name}
        assert series.get(name) == {"name": name}
    assert len(store.names("map")) == 5
    assert store.names("map")[1] == "grün\x00図"


def test_a_key_or_a_name_that_is_no_text_is_refused(store):
    series = store.series("map", "edges")
    for wrong in (lambda: store.series("map", 3), lambda: series.append(3, {}), lambda: series.get(None)):
        with pytest.raises(TypeError, match="keys of series are texts, not"):
            wrong()
    assert len(series) == 0


_TEXTS = st.sampled_from(["$float", "$dict", "nan", "a", "\x00", "\udc80"]) | st.text(max_size=3)
_ITEMS = st.none() | st.booleans() | st.integers() | st.floats() | _TEXTS


@settings(deadline=None)
@pytest.mark.fuzz
@given(st.recursive(_ITEMS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_TEXTS, inner, max_size=3)))
def test_whatever_json_can_say_comes_back(fuzzed, value):
    fuzzed.append("key", {"value": value})
    assert alike(fuzzed.get("key"), {"value": value})


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    with Store(tmp_path_factory.mktemp("fuzzed") / "results.sqlite") as store:
        yield store.series("map", "fuzzed")


def test_what_is_no_json_is_refused_with_its_row_and_nothing_of_the_batch_is_written(store):
    series = store.series("map", "edges")
    loop: list = []
    loop.append(loop)
    for bad in (object(), {1, 2}, np.zeros(3), loop, b"bytes"):
        with pytest.raises(TypeError, match="Row 'bad' of map 'edges' can't be stored"):
            series.append_all([("good", {"x": 1}), ("bad", {"x": bad})])
    assert len(series) == 0


def test_keys_that_are_no_texts_are_refused_before_one_takes_the_place_of_another(store):
    series = store.series("map", "edges")
    for bad in ({1: "one", "1": "text"}, {None: 1}, {True: 1}, {"deep": [{"in": {1.5: 2}}]}, {"nan": {1: math.nan}}):
        with pytest.raises(TypeError, match=r"Row 'bad' of map 'edges' can't be stored: key .* is no text"):
            series.append("bad", bad)
    assert len(series) == 0


@pytest.mark.slow
def test_a_row_of_many_megabytes_comes_back(store):
    series = store.series("map", "large")
    series.append("large", {"text": "é" * 5_000_000})
    assert series.get("large")["text"] == "é" * 5_000_000


def test_a_key_is_there_once_and_the_last_one_stays_in_its_place(store):
    series = store.series("map", "edges")
    series.append_all([("a", {"n": 1}), ("b", {"n": 2}), ("a", {"n": 3})])
    series.append("a", {"n": 4})
    series.append_all([("c", {"n": 5}), ("b", {"n": 6})])
    assert list(series.items()) == [("a", {"n": 4}), ("b", {"n": 6}), ("c", {"n": 5})]
    assert len(series) == 3
    assert "b" in series
    assert "z" not in series
    assert series.get("z") is None


@pytest.mark.slow
def test_rows_are_read_page_by_page_in_the_order_of_writing(store):
    series = store.series("map", "long")
    series.append_all((f"{number}", {"n": number}) for number in range(1_203))
    assert [row["n"] for row in series.rows()] == list(range(1_203))
    series.append_all((f"{number}", {"n": -number}) for number in range(1_203))
    assert [row["n"] for row in series.rows()] == [-number for number in range(1_203)]


def test_series_are_distinguished_by_kind_and_name(store):
    for kind, name in (("map", "b"), ("map", "a"), ("sweep", "a")):
        store.series(kind, name).append("key", {"of": [kind, name]})
    assert store.kinds() == ("map", "sweep")
    assert store.names("map") == ("b", "a")
    assert store.names("check") == ()
    assert store.series("sweep", "a").get("key") == {"of": ["sweep", "a"]}


def test_a_series_is_described_when_it_is_made(store):
    assert store.series("map", "edges", about={"k": math.inf}).about == {"k": math.inf}
    assert store.series("map", "edges", about={"k": 2}).about == {"k": math.inf}
    assert store.series("map", "other").about == {}


def test_to_look_into_a_series_does_not_make_it(store):
    looked = store.series("map", "edges")
    assert (len(looked), looked.keys(), looked.get("a"), looked.about) == (0, frozenset(), None, {})
    assert looked.to_frame().empty
    assert store.names("map") == ()
    # Its maker describes it, and a series object from before sees that.
    store.series("map", "edges", about={"k": 1}).append("a", {"n": 1})
    assert (looked.keys(), looked.about) == ({"a"}, {"k": 1})
    looked.append("b", {"n": 2})
    assert store.series("map", "edges", about={"k": 2}).about == {"k": 1}
    assert len(store.series("map", "edges")) == 2


def test_a_series_without_a_description_is_made_by_its_first_row(store):
    store.series("tuning", "edges").append("a", {"n": 1})
    assert store.names("tuning") == ("edges",)
    assert store.series("tuning", "edges", about={"k": 1}).about == {}


def test_a_series_is_a_table(store):
    series = store.series("tuning", "edges")
    assert series.to_frame().empty
    series.append("a", {"values": {"lo": 70, "hi": 200}, "total_ms": 1.5, "failure": None})
    series.append("b", {"values": {"lo": 90}, "total_ms": math.nan, "note": "x"})
    frame = series.to_frame()
    assert list(frame.columns) == ["total_ms", "failure", "values.lo", "values.hi", "note"]
    assert list(frame.index) == ["a", "b"]
    assert frame.loc["a", "values.hi"] == 200
    assert math.isnan(frame.loc["b", "total_ms"])


_CHILD = """
import sys
from epypes.store import Store

place, name = sys.argv[1:]
sys.stdin.readline()
with Store(place) as store:
    series = store.series("map", "edges")
    for number in range(60):
        series.append(f"{name}-{number}", {"n": number, "by": name})
        if number < 50:
            series.append(f"shared-{number}", {"n": number, "by": name})
"""


@pytest.mark.slow
def test_processes_write_to_a_new_database_at_once_and_nothing_is_lost_or_twice(place):
    # Started before there is a database: they make its tables all at once.
    options = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    children = [subprocess.Popen([sys.executable, "-c", _CHILD, place, str(name)], **options) for name in range(4)]
    for child in children:
        child.stdin.write(b"\n")
        child.stdin.flush()
    for child in children:
        _, message = child.communicate(timeout=120)
        assert child.returncode == 0, message.decode()
    with Store(place) as store:
        assert store.names("map") == ("edges",)
        found = [key for key, _ in store.series("map", "edges").items()]
    assert len(found) == len(set(found)) == 290


@pytest.mark.slow
def test_threads_write_and_read_through_one_store(store):
    series = store.series("map", "edges")

    def write(name):
        for number in range(40):
            series.append(f"{name}-{number}", {"n": number})
            assert series.get(f"{name}-{number}") == {"n": number}

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(8)))
    assert len(series.keys()) == 320


def test_threads_that_write_the_same_keys_in_another_order_all_get_through(store):
    series = store.series("map", "edges")
    together = threading.Barrier(4)

    def write(name):
        keys = [f"{number}" for number in range(60)]
        together.wait(60)
        series.append_all((key, {"by": name}) for key in (keys if name % 2 else keys[::-1]))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    assert len(series) == 60
    assert len({row["by"] for row in series.rows()}) == 1, "a batch is written as a whole"


def test_a_path_is_a_file_and_a_store_stays_what_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for named in ("plain.sqlite", Path("path.sqlite"), "~/home.sqlite", "sqlite:///url.sqlite", "odd #?%41 name"):
        with opened_store(named) as store:
            assert store.kinds() == ()
    names = ("plain.sqlite", "path.sqlite", "home.sqlite", "url.sqlite", "odd #?%41 name")
    assert all((tmp_path / name).is_file() for name in names)
    with pytest.raises(TypeError, match="A store is a path or a URL, not 3"), opened_store(3):
        pass


def test_a_store_that_was_given_stays_open_and_one_that_was_opened_for_it_is_closed(tmp_path):
    with opened_store(None) as nothing:
        assert nothing is None
    with ep.Store(tmp_path / "given.sqlite") as given:
        with opened_store(given) as store:
            assert store is given
        given.series("map", "edges").append("a", {})
    with opened_store(tmp_path / "own.sqlite") as store:
        store.series("map", "edges").append("a", {})
    assert [path.name for path in tmp_path.glob("own*")] == ["own.sqlite"], (
        "its log is written into it when it is closed"
    )


def test_a_store_is_closed_twice_and_has_a_short_repr(store):
    assert len(repr(store)) < 100
    assert repr(store.series("map", "edges" * 50)).startswith("<Series map 'edgesedges")
    store.close()
    store.close()


def test_importing_the_store_loads_no_other_package():
    code = "import sys; import epypes.store; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert not {"sqlalchemy", "pandas", "numpy"} & set(done.stdout.split())
