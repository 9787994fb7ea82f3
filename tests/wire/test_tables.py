"""Tables of pandas travel as streams of Arrow and come back as they were; what can't is refused, and names the column."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from epypes.bundle.proof.compare import differences
from epypes.errors import MessageError
from epypes.wire import Envelope, Limits, decode, encode, load_sample, save_sample
from epypes.wire.protobuf import message_class
from tests.wire.former_tables import former_frames

FRAME = pd.DataFrame(
    {
        "count": [1, 2],
        "word": ["a", None],
        "score": [0.5, float("nan")],
        "ok": [True, False],
        "when": pd.to_datetime(["2019-01-01", None]),
        "took": pd.to_timedelta([1, None], unit="s"),
        "small": np.array([1, 2], "u1"),
        "there": pd.to_datetime(["2019-01-01", None]).tz_localize("Europe/Oslo"),
        "kind": pd.Categorical(["b", None], ["b", "a"], ordered=True),
        "maybe": pd.array([1, None], "Int64"),
        "text": pd.array(["a", None], "string"),
        "none": pd.Series([None, None], dtype=object),
    }
)
TABLES = [
    FRAME,
    FRAME.set_index("word"),
    FRAME.set_index("when")[["score"]],
    FRAME.set_index(["count", "word"]),
    FRAME.iloc[::-1],
    FRAME.iloc[:0],
    FRAME.rename_axis(index="place", columns="what"),
    FRAME["word"],
    FRAME["score"].rename(None),
    FRAME["kind"].rename((1, "a")),
    pd.DataFrame(np.eye(3)),
    pd.DataFrame(),
    pd.DataFrame(index=["a", "b"]),
]


def same(one, other):
    equal = pd.testing.assert_frame_equal if one.ndim == 2 else pd.testing.assert_series_equal
    equal(one, other)
    assert type(one.index) is type(other.index)
    return True


@pytest.mark.parametrize("inline_below", [0, 8192])
@pytest.mark.parametrize("table", TABLES)
def test_tables_come_back_with_labels_and_types(table, inline_below, tmp_path):
    frames = [bytes(frame) for frame in encode(Envelope("", {"value": table}), inline_below=inline_below)]
    save_sample(tmp_path / "s.npz", {"value": table}, {})
    for back in (decode(frames).parts["value"], load_sample(tmp_path / "s.npz")[0]["value"]):
        assert same(back, table)
        assert not [*differences(table, back)], "a replay finds no difference"


def test_a_replay_finds_other_categories_and_other_names_of_an_index():
    other = FRAME.assign(kind=FRAME["kind"].cat.set_categories(["b", "c"], ordered=True))
    (found,) = differences(FRAME, other)
    assert found.text.startswith("['kind'].dtype expected")
    one, two = FRAME.set_index(["count", "small"]), FRAME.set_index(["count", "small"]).rename_axis(["count", "s"])
    assert len([*differences(one, two)]) == 1


def test_any_reader_of_arrow_reads_a_table():
    frames = encode(Envelope("", {"value": FRAME[["count", "word"]]}), inline_below=0)
    assert pa.ipc.open_stream(frames[2]).read_all().to_pydict() == {"count": [1, 2], "word": ["a", None]}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (pd.DataFrame({"what": [{"k": 1.0}]}), r"column 'what' is of Arrow's type struct.*to_dict"),
        (pd.DataFrame({"what": [[1, 2]]}), "column 'what' is of Arrow's type list"),
        (pd.DataFrame({"what": [1, "a"]}), "column what with type object.*to_dict"),
        (
            pd.DataFrame({"what": pd.Series([1, 2], dtype=object)}),
            r"'what' of dtype object .* as int64.*astype\('int64'\)",
        ),
        (pd.DataFrame({"wave": [1 + 2j]}), "column wave with type complex128.*to_dict"),
        (pd.DataFrame([[1, 2]], columns=["same", "same"]), "labels are not texts that all differ"),
        (pd.DataFrame({(1, "a"): [1.0], None: ["x"]}), "labels are not texts that all differ"),
        (pd.DataFrame({1: [1.0]}), "labels are not texts that all differ"),
        (pd.DataFrame({"a": [1]}, index=pd.Index([5], name=3)), "index called 3"),
    ],
)
def test_what_arrow_would_change_is_named_with_a_way_out(table, words):
    with pytest.raises(MessageError, match=words) as caught:
        encode(Envelope("", {"v": table}))
    assert caught.value.reason == "no codec"
    assert "\n" not in str(caught.value)


def test_a_table_with_attrs_is_refused():
    table = FRAME.copy()
    table.attrs = {"unit": "px"}
    with pytest.raises(MessageError, match=r"attrs = \{\}"):
        encode(Envelope("", {"v": table}))


# -- what was written before ------------------------------------------------------------------------------------------

FORMER = FRAME[["count", "word", "score", "ok", "when", "small"]]


@pytest.mark.parametrize(
    "table",
    [
        FORMER,
        FORMER.set_index("word"),
        FORMER.set_index("when")[["score"]],
        FORMER.iloc[::-1],
        FORMER.iloc[:0],
        FORMER["word"],
        FORMER["score"].rename(None),
        pd.DataFrame(np.eye(3)),
        pd.DataFrame(),
        pd.DataFrame(index=["a", "b"]),
        pd.DataFrame([[1, 2]], columns=["same", "same"]),
        pd.DataFrame({(1, "a"): [1.0], None: ["x"]}),
    ],
)
def test_tables_that_were_written_before_are_read(table):
    assert same(decode(former_frames(v=table)).parts["v"], table)


def test_objects_in_tables_that_were_written_before_are_read():
    cells = pd.DataFrame({"what": pd.Series([{"k": (1, 2)}, None, float("nan")], dtype=object)})
    back = decode(former_frames(v=cells)).parts["v"]
    assert repr(back["what"].tolist()) == "[{'k': (1, 2)}, None, nan]"


def test_tables_within_the_labels_of_tables_are_refused_beyond_the_depth():
    message = message_class("epypes.v1.Envelope")()
    value = message.parts.add(name="v").value
    for _ in range(Limits().depth + 2):
        value = value.table.index.values
    value.none = True
    with pytest.raises(MessageError) as caught:
        decode([b"/", message.SerializeToString()])
    assert caught.value.reason == "too deep"


# -- what is not trusted ----------------------------------------------------------------------------------------------


def received(table, *, compression=None, series=False, limits=None, change=bytes):
    """Return what is read of a message with a table of Arrow."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as stream:
        stream.write_table(table)
    message = message_class("epypes.v1.Envelope")()
    content = message.parts.add(name="v").value.arrow_table
    content.inline, content.series = change(sink.getvalue().to_pybytes()), series
    if series:
        content.name.none = True
    return decode([b"/", message.SerializeToString()], limits or Limits()).parts["v"]


BIG = pa.table({"x": np.zeros(1_000_000)})
WORDS = pa.table({"x": pa.array(["a"] * 1_000).dictionary_encode()})


def test_what_other_programs_send_as_arrow_is_read():
    assert received(pa.table({"x": [1, 2]}))["x"].tolist() == [1, 2]
    assert received(pa.table({"values": [1, 2]}), series=True).tolist() == [1, 2]


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("table", [BIG, WORDS])
def test_a_compressed_stream_is_refused_before_it_is_read(table, compression):
    before = pa.total_allocated_bytes()
    with pytest.raises(MessageError, match="compressed batch") as caught:
        received(table, compression=compression)
    assert caught.value.reason == "bad table"
    assert pa.total_allocated_bytes() - before < 1_000_000


@pytest.mark.parametrize(
    "table",
    [
        pa.table({"x": [[1]]}),
        pa.table({"x": pa.RunEndEncodedArray.from_arrays([2**30], [1])}),
        pa.table({"x": [1]}).replace_schema_metadata({"pandas": "{"}),
    ],
)
def test_what_pandas_does_not_make_is_refused(table):
    with pytest.raises(MessageError) as caught:
        received(table)
    assert caught.value.reason == "bad table"


@pytest.mark.parametrize("table", [pa.table({"x": pa.nulls(2_000)}), pa.table({"x": ["a"] * 2_000}), WORDS])
def test_values_that_are_objects_are_counted(table):
    with pytest.raises(MessageError) as caught:
        received(table, limits=Limits(values=500))
    assert caught.value.reason == "too many values"


@pytest.mark.parametrize("count", [2**20 + 1, 2**60])
def test_categories_without_bytes_are_counted(count):
    table = pa.table({"x": pa.DictionaryArray.from_arrays(pa.array([0], pa.int8()), pa.nulls(1_234_567))})
    with pytest.raises(MessageError) as caught:
        received(table, change=lambda data: data.replace(struct.pack("<q", 1_234_567), struct.pack("<q", count)))
    assert caught.value.reason == "too many values"


def test_categories_are_counted_where_they_are_written():
    labels = pd.DataFrame({"x": pd.Categorical(["a"], [f"{number}" for number in range(600)] + ["a"])})
    with pytest.raises(MessageError, match="more than 600 values"):
        encode(Envelope("", {"v": labels}), limits=Limits(values=600))


def test_a_text_that_is_not_unicode_is_named_in_an_error_that_can_be_printed():
    with pytest.raises(MessageError, match=r"can't encode character '\\ud800'") as caught:
        encode(Envelope("", {"v": pd.DataFrame({"what": pd.Series(["\ud800"], dtype=object)})}))
    assert str(caught.value).encode()


def test_where_pandas_or_pyarrow_is_missing_the_error_says_so(monkeypatch):
    table = encode(Envelope("", {"v": FRAME}))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for asked in (lambda: decode(table), lambda: encode(Envelope("", {"v": FRAME}))):
        with pytest.raises(MessageError, match=r"pip install 'epypes\[tables\]'"):
            asked()
    assert same(decode(former_frames(v=FORMER)).parts["v"], FORMER)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MessageError, match="pip install pandas"):
        decode(table)
