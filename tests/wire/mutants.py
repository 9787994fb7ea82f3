"""Mutations of messages: of their frames, their bytes, their descriptions."""

from __future__ import annotations

import random

from epypes.wire.protobuf import message_class


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if changed:
            changed[rng.randrange(len(changed))] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
    what = rng.randrange(5)
    if what == 0:
        del changed[rng.randrange(len(changed) + 1) :]
    elif what == 1:
        place = rng.randrange(len(changed) + 1)
        changed[place:place] = rng.randbytes(rng.randint(1, 12))
    return bytes(changed)


def mutate_frames(frames: list[bytes], rng: random.Random) -> list[bytes]:
    frames = list(frames)
    what = rng.randrange(8)
    place = rng.randrange(len(frames))
    if what == 0:
        del frames[place]
    elif what == 1:
        frames.insert(place, frames[rng.randrange(len(frames))])
    elif what == 2:
        frames[place] = frames[place][: rng.randrange(len(frames[place]) + 1)]
    elif what == 3:
        rng.shuffle(frames)
    else:
        # Most of the meaning is in the header.
        place = 1 if what > 4 else place
        frames[place] = mutate_bytes(frames[place], rng)
    return frames


def mutate_description(frames: list[bytes], rng: random.Random) -> list[bytes]:
    message = message_class("epypes.v1.Envelope").FromString(frames[1])
    value = rng.choice(message.parts).value
    numbers = [0, 1, 2, 3, 17, 2**16, 2**31, 2**32 - 1]
    if value.HasField("image"):
        setattr(value.image, rng.choice(["width", "height", "step", "frame"]), rng.choice(numbers))
        value.image.encoding = rng.choice(["mono8", "bgr8", "bgra16", "rgb16", "", "jpeg"])
    elif value.HasField("tensor"):
        value.tensor.dtype = rng.choice(["<f4", "|O8", "O", "<U3", "|S0", "|V8", ">c32", "<U999999999", "b1", "f"])
        value.tensor.shape.append(rng.choice([-1, 0, 2**62, -(2**63), 2**63 - 1, *numbers]))
        value.tensor.scalar = rng.random() < 0.5
    elif value.HasField("records"):
        records = value.records
        records.type = rng.choice(["KeyPoint", "DMatch", "KeyPoint", "UMat", "imread", ""])
        records.outer, records.inner = rng.randrange(4), rng.randrange(4)
        records.counts.extend(rng.choices(numbers, k=rng.randrange(3)))
        records.rows.dtype = rng.choice(["<f8", "<f8", "<i8", "|u1"])
        if rng.random() < 0.5:
            records.rows.shape[:] = rng.choice([(30, 7), (0, 7), (7, 30), (2**61, 7), (), (210,)])
    elif value.HasField("arrow_table"):
        table = value.arrow_table
        table.series, table.numbered = rng.random() < 0.3, rng.random() < 0.3
        table.inline = mutate_bytes(table.inline, rng)
    elif value.HasField("table"):
        table = value.table
        column = rng.choice([table.index, table.columns, *table.data])
        column.dtype = rng.choice(
            ["range", "object", "str", "float64", "datetime64[ns]", "datetime64[Y]", "O", "Int64"]
        )
        table.series = rng.random() < 0.3
        if rng.random() < 0.5:
            column.values.Clear()
            for number in rng.choices([*numbers, -1, 2**62, -(2**63)], k=rng.randrange(5)):
                column.values.list.items.add().integer = number
    else:
        value.tensor.frame = rng.choice(numbers)
    return [frames[0], message.SerializeToString(), *frames[2:]]
