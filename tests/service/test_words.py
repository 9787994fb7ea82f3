from __future__ import annotations

import os

from epypes.service.standard_error import Words

TIMEOUT_S = 60.0


def read_until(reader, end):
    data = b""
    while not data.endswith(end):
        data += os.read(reader, 65536)
    return data


def test_what_nobody_reads_is_dropped_and_counted_and_what_comes_later_is_written_again():
    reader, writer = os.pipe()
    words = Words(writer, most_bytes=200_000)
    for number in range(300):
        words.write(f"{number:03} " + "x" * 1000 + "\n")
    data = read_until(reader, b"x\n")
    while not words.wait(0.01):
        data += os.read(reader, 65536)
    words.write("the last\n")
    data += read_until(reader, b"the last\n")
    lines = data.decode().splitlines()
    written = [line for line in lines if line.endswith("x")]
    assert [line[:3] for line in written] == [f"{number:03}" for number in range(len(written))]
    (told,) = (line for line in lines if "nobody read" in line)
    assert told.startswith(f"{300 - len(written)} times nothing was written")
    assert lines[-1] == "the last"
    assert words.wait(TIMEOUT_S)
    os.close(reader)
    words.write("to nobody\n")
    assert words.wait(TIMEOUT_S)
    os.close(writer)
