"""Videos for tests, written by OpenCV from an image of scikit-image, whose frames can be told apart."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import cv2
from skimage import data

WIDTH, HEIGHT = 160, 120
_BITS, _SIDE = 8, 16


@cache
def _photograph() -> Any:
    return cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)


def picture(number: int) -> Any:
    """The frame of a number: a part of a photograph that moves, and the number in black and white squares."""
    image = _photograph()[100 : 100 + HEIGHT, number % 200 : number % 200 + WIDTH].copy()
    for bit in range(_BITS):
        image[:_SIDE, bit * _SIDE : (bit + 1) * _SIDE] = 255 * (number >> bit & 1)
    return image


def number_in(image: Any) -> int:
    """The number that a frame shows."""
    squares = (image[4:12, bit * _SIDE + 4 : bit * _SIDE + 12] for bit in range(_BITS))
    return sum(1 << bit for bit, square in enumerate(squares) if square.mean() > 128)


def write_video(path: Path, count: int = 40, codec: str = "mp4v", fps: float = 25) -> Path:
    """Write a video of so many frames."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for number in range(count):
        writer.write(picture(number))
    writer.release()
    return path


def with_durations(path: Path, durations: list[int]) -> Path:
    """Give the frames of an .mp4 whose index is at its end durations of their own, in its units: a variable frame rate."""
    content = path.read_bytes()
    at = content.index(b"stts") - 4
    old = int.from_bytes(content[at : at + 4])
    entries = b"".join(struct.pack(">II", 1, duration) for duration in durations)
    table = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(durations)) + entries
    content = content[:at] + table + content[at + old :]
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        size_at = content.index(box) - 4
        size = int.from_bytes(content[size_at : size_at + 4]) + len(table) - old
        content = content[:size_at] + struct.pack(">I", size) + content[size_at + 4 :]
    # Without its edit list, which says how long the video is.
    path.write_bytes(content.replace(b"edts", b"free", 1))
    return path


def with_damage(path: Path, number: int) -> Path:
    """Zero the bytes of a frame of an .avi."""
    content = bytearray(path.read_bytes())
    at = content.index(b"movi")
    for _ in range(number + 1):
        at = content.index(b"00dc", at + 1)
    size = int.from_bytes(content[at + 4 : at + 8], "little")
    content[at + 8 : at + 8 + size] = bytes(size)
    path.write_bytes(content)
    return path
