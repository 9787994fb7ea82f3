"""How do a front and its worker talk? Over a pair of sockets, a header and frames per message.

The stream is that of `packing`: a table, the header as JSON, the frames. Frames are never joined: the kernel takes
them where they are, and the reader allocates each once, when its size has been checked. When one side goes, whatever
ended it, the other reads the end of the stream at once.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import socket
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Final

from epypes.errors import MessageError
from epypes.service.packing import HEAD_BYTES, SIZE_BYTES, BlockLimits, BytesLike, count_in, sizes_in, table_of

MOST_HEADER_BYTES: Final = 1024**2
# Of one message: an event's answers may be several Envelopes.
LIMITS: Final = BlockLimits(frames=16_384, total_bytes=1024**3)
# Shared memory is no way out of copying: a new segment per frame takes four times as long (8 ms for 8 MB, against 2 ms
# here), and one that is used again must wait until the last array of the worker that looks into it is gone.
# Asked for; the system gives what it allows. With 4 MB a frame of 1 MB takes 0.23 ms, with 0.2 MB 0.25 to 0.4 ms.
_BUFFER_BYTES: Final = 4 * 1024**2
_READ_AHEAD_BYTES: Final = 64 * 1024
# The most that sendmsg takes at once.
_MOST_PIECES: Final = 1_024


def channel_pair() -> tuple[Channel, socket.socket]:
    """Return one end of a new channel, and the socket that the process at its other end is given."""
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    return Channel(ours), theirs


class Channel:
    """One end of a connected pair of stream sockets.

    Parameters
    ----------
    end
        The socket; the channel closes it.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(True)
        self._socket = end
        self._sending, self._receiving = threading.Lock(), threading.Lock()
        self._reader = io.BufferedReader(io.FileIO(end.fileno(), closefd=False), _READ_AHEAD_BYTES)

    def send(self, header: Mapping[str, Any], frames: Sequence[BytesLike] = ()) -> None:
        """Send a message, from any thread, one after another; wait for as long as the other side does not read.

        When it returns, the frames' memory may be written to again.

        Parameters
        ----------
        header
            What json takes.
        frames
            Contiguous bytes.

        Raises
        ------
        EOFError
            The other side is gone.
        MessageError
            The header or the frames are larger than what is read; nothing was sent.
        """
        head = json.dumps(header, separators=(",", ":")).encode()
        if len(head) > MOST_HEADER_BYTES:
            raise MessageError("too large", f"A header of {len(head):,} bytes; the limit is {MOST_HEADER_BYTES:,}.")
        parts = [head, *frames]
        left = [piece for part in (table_of(parts, LIMITS), *parts) if len(piece := memoryview(part).cast("B"))]
        with self._sending:
            try:
                while left:
                    sent = self._socket.sendmsg(left[:_MOST_PIECES], (), socket.MSG_NOSIGNAL)
                    left = _after(left, sent)
            except OSError as error:
                raise EOFError("The other side of the channel is gone.") from error
            except BaseException:
                # Half a message may be on its way: whatever came after it could not be understood.
                self._end()
                raise

    def receive(self) -> tuple[dict[str, Any], list[memoryview]]:
        """Wait for a message, and return its header and its frames, read-only; to be called by one thread.

        Raises
        ------
        EOFError
            The other side is gone, or this one was closed.
        MessageError
            What came is no message. Nothing that comes after it can be understood: close the channel.
        """
        with self._receiving:
            count = count_in(self._read(HEAD_BYTES), LIMITS)
            sizes = sizes_in(self._read(SIZE_BYTES * count), count, LIMITS)
            if not sizes or sizes[0] > MOST_HEADER_BYTES:
                raise MessageError(
                    "no header", f"A message begins with a header of at most {MOST_HEADER_BYTES:,} bytes."
                )
            head = self._read(sizes[0])
            frames = [memoryview(self._read(size)) for size in sizes[1:]]
        return _header(head), frames

    def _read(self, size: int) -> bytes:
        try:
            # Allocates so many bytes without filling them, and has large ones read where they stay.
            data = self._reader.read(size)
        except (OSError, ValueError) as error:
            raise EOFError("The channel is closed.") from error
        if len(data) < size:
            raise EOFError("The other side of the channel is gone.")
        return data

    def close(self) -> None:
        """End both directions, and wake up who reads or sends; may be called twice, from any thread."""
        self._end()
        # Not before nobody is in a call on it: the number could be another file's by then.
        with self._sending, self._receiving:
            self._reader.close()
            self._socket.close()

    def close_in_forks(self) -> None:
        """Let processes that are forked from this one have no part in it, or the other side would not see it end."""
        os.register_at_fork(after_in_child=self._socket.close)

    def _end(self) -> None:
        with contextlib.suppress(OSError):  # it has ended already
            self._socket.shutdown(socket.SHUT_RDWR)


def _after(pieces: list[memoryview], sent: int) -> list[memoryview]:
    """Return what is left of the pieces when so many bytes of them are gone."""
    for place, piece in enumerate(pieces):
        if sent < len(piece):
            return [piece[sent:], *pieces[place + 1 :]]
        sent -= len(piece)
    return []


def _header(data: bytes) -> dict[str, Any]:
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MessageError("no header", f"The header of a message is no JSON: {error}.") from error
    if not isinstance(header, dict):
        raise MessageError("no header", f"The header of a message is an object, not a {type(header).__name__}.")
    return header
