"""Tables of pandas as EPypes wrote them into messages before it wrote Arrow's streams: they are still read."""

from __future__ import annotations

from epypes.wire.encoder import ValueWriter
from epypes.wire.protobuf import message_class


def former_frames(**tables):
    """Return the frames of a message with these tables as its parts."""
    message = message_class("epypes.v1.Envelope")()
    writer = ValueWriter()
    for name, table in tables.items():
        write(writer, message.parts.add(name=name).value.table, table)
    return [b"/", message.SerializeToString()]


def write(writer, content, table):
    write_column(writer, content.index, table.index)
    content.series = table.ndim == 1
    if content.series:
        write_column(writer, content.data.add(), table)
        return
    write_column(writer, content.columns, table.columns)
    for position in range(table.shape[1]):
        write_column(writer, content.data.add(), table.iloc[:, position])


def write_column(writer, message, column):
    writer.write(message.name, column.name, ("name",))
    message.dtype = str(column.dtype)
    if type(column).__name__ == "RangeIndex":
        message.dtype, values = "range", [column.start, column.stop, column.step]
    elif message.dtype in {"str", "string"}:
        values = [None if missing else text for text, missing in zip(column, column.isna(), strict=True)]
    elif message.dtype.startswith(("datetime64", "timedelta64")):
        values = column.to_numpy().view("<i8")
    else:
        values = column.tolist() if message.dtype == "object" else column.to_numpy()
    writer.write(message.values, values, ("values",))
