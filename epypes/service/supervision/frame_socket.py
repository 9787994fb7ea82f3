"""Messages between the front and a worker, over two socket pairs.

A `FrameSocket` carries what must stay in order: events, changes of parameters, and all messages of the worker. Its
frames are never joined: the kernel takes them where they are, and the reader allocates each once, when its size has
been checked. A `ControlSocket` carries what the worker must take while its functions run: queries of its state, and
withdrawals. When one side ends, whatever the cause, the other reads the end of both at once.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import socket
import struct
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, get_args

from epypes.errors import InvalidValue, MessageError
from epypes.service.supervision.packing import HEAD, MARK, BytesLike, table_of

MessageKind = Literal["event", "parameters", "withdraw", "query", "end", "ready", "refused", "done", "answer"]
_KINDS: Final[tuple[MessageKind, ...]] = get_args(MessageKind)
# The kind and the number of a message; its contents follow as JSON, if it has any.
_KIND_AND_NUMBER: Final = struct.Struct("<BQ")

_MAX_CONTENT_BYTES: Final = 1024**2
# Of one message: an event's answers may be several Envelopes.
_MAX_FRAMES: Final = 16_384
_MAX_BYTES: Final = 1024**3
# Shared memory does not avoid the copy: a new segment per frame takes four times as long (8 ms for 8 MB, against 2 ms
# here), and one that is used again must wait until the last array of the worker that looks into it is gone.
# Asked for; the system gives what it allows. With 4 MB a frame of 1 MB takes 0.23 ms, with 0.2 MB 0.25 to 0.4 ms.
_BUFFER_BYTES: Final = 4 * 1024**2
# Messages up to this size are read at once.
_SMALL_BYTES: Final = 64 * 1024
# The most buffers that one sendmsg takes.
_MAX_BUFFERS: Final = 1_024
# Of a control message; the system allows no larger packet.
_MAX_CONTROL_BYTES: Final = 128 * 1024

# As integers: flags of `socket` are combined in Python.
_NO_SIGNAL: Final = int(socket.MSG_NOSIGNAL)
_NO_WAITING: Final = int(socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)
_WAIT_ALL: Final = int(socket.MSG_WAITALL)

_to_json: Final = json.JSONEncoder(separators=(",", ":")).encode
_from_json: Final = json.JSONDecoder().decode


@dataclass(slots=True)
class WorkerMessage:
    """A message between the front and a worker.

    Attributes
    ----------
    kind
        What it is.
    number
        Of the event, or of the request that it makes, answers or withdraws.
    content
        What JSON takes.
    frames
        Contiguous bytes; read-only in a message that was received.
    """

    kind: MessageKind
    number: int = 0
    content: Mapping[str, Any] = field(default_factory=dict)
    frames: Sequence[BytesLike] = ()


def _encode_head(message: WorkerMessage) -> bytes:
    content = _to_json(message.content).encode() if message.content else b""
    if len(content) > _MAX_CONTENT_BYTES:
        raise MessageError("too large", f"Contents of {len(content):,} bytes; the limit is {_MAX_CONTENT_BYTES:,}.")
    return _KIND_AND_NUMBER.pack(_KINDS.index(message.kind), message.number) + content


def _decode(head: BytesLike, frames: Sequence[BytesLike] = ()) -> WorkerMessage:
    try:
        kind, number = _KIND_AND_NUMBER.unpack_from(head)
        text = str(head[_KIND_AND_NUMBER.size :], "utf-8")
        content = _from_json(text) if text else {}
        if not isinstance(content, dict):
            raise InvalidValue(f"an object is expected, not a {type(content).__name__}")
        return WorkerMessage(_KINDS[kind], number, content, frames)
    except (struct.error, IndexError, ValueError, RecursionError) as error:
        raise MessageError("no message", f"The head of a message can't be read: {error}.") from error


def buffers_of(message: WorkerMessage) -> list[memoryview]:
    """Return a message as buffers to send; raise MessageError if the reader would refuse it."""
    views = [memoryview(part).cast("B") for part in (_encode_head(message), *message.frames)]
    sizes = [*map(len, views)]
    if len(sizes) > _MAX_FRAMES or sum(sizes) > _MAX_BYTES:
        text = f"{len(sizes):,} frames of {sum(sizes):,} bytes; the limits are {_MAX_FRAMES:,} and"
        raise MessageError("too large", f"{text} {_MAX_BYTES:,}.")
    return [memoryview(table_of(sizes)), *filter(len, views)]


class FrameSocket:
    """One end of a connected pair of stream sockets, which carries messages with frames.

    Parameters
    ----------
    end
        The socket; it is closed by `close`.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(True)
        self._socket = end
        self._sending, self._receiving = threading.Lock(), threading.Lock()

    @classmethod
    def pair(cls) -> tuple[FrameSocket, socket.socket]:
        """Return one end of a new connection, and the socket for the process at its other end."""
        ours, theirs = socket.socketpair()
        for end in (ours, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        return cls(ours), theirs

    def send(self, message: WorkerMessage) -> None:
        """Send a message, from any thread; wait for as long as the other side does not read.

        When it returns, the frames' memory may be written to again.

        Raises
        ------
        EOFError
            The other side is gone.
        MessageError
            The message is larger than the reader accepts; nothing was sent.
        """
        self.send_buffers(buffers_of(message))

    def send_buffers(self, left: list[memoryview], *, is_waiting: bool = True) -> list[memoryview]:
        """Send buffers of `buffers_of`; without waiting, return those that the kernel has not taken.

        No other thread may send until these are sent too.

        Raises
        ------
        EOFError
            The other side is gone.
        """
        flags = _NO_SIGNAL if is_waiting else _NO_WAITING
        with self._sending:
            try:
                while left:
                    left = _after(left, self._socket.sendmsg(left[:_MAX_BUFFERS], (), flags))
            except BlockingIOError:
                pass
            except OSError as error:
                raise EOFError("The other side of the connection is gone.") from error
            except BaseException:
                # Half a message may be sent: what came after it could not be understood.
                self.end()
                raise
        return left

    def receive(self) -> WorkerMessage:
        """Wait for a message; its frames are read-only. Called by one thread at a time.

        Raises
        ------
        EOFError
            The other side is gone, or this one was closed.
        MessageError
            The bytes are no message. What comes after them can't be understood: close the connection.
        """
        with self._receiving:
            try:
                mark, count = HEAD.unpack(self._read(HEAD.size))
                if mark != MARK or not 0 < count <= _MAX_FRAMES:
                    raise MessageError("no frames", f"No message begins with {mark!r} and {count:,} frames.")
                sizes = struct.unpack(f"<{count}Q", self._read(8 * count))
                total = sum(sizes)
                if sizes[0] > _KIND_AND_NUMBER.size + _MAX_CONTENT_BYTES or total > _MAX_BYTES:
                    raise MessageError("too large", f"A head of {sizes[0]:,} bytes in a message of {total:,} bytes.")
                if total <= _SMALL_BYTES:
                    block, ends = memoryview(self._read(total)), [*itertools.accumulate(sizes, initial=0)]
                    frames = [*map(block.__getitem__, map(slice, ends, ends[1:]))]
                else:
                    frames = [memoryview(self._read(size)) for size in sizes]
            except OSError as error:
                raise EOFError("The connection is closed.") from error
        return _decode(frames.pop(0), frames)

    def _read(self, size: int) -> bytes:
        data = self._socket.recv(size, _WAIT_ALL)
        while len(data) < size:
            # A signal has interrupted the system call, or the other side is gone.
            more = self._socket.recv(size - len(data), _WAIT_ALL)
            if not more:
                raise EOFError("The other side of the connection is gone.")
            data += more
        return data

    def is_readable(self) -> bool:
        """Whether a message, or the end, can be read without waiting for it to begin."""
        # select() takes no descriptor above 1,023, and the worker inherits its own.
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        return bool(poll.poll(0))

    def close(self) -> None:
        """End both directions, and wake up threads that read or send; may be called twice, from any thread."""
        self.end()
        # The descriptor may be another file's once it is closed, so no thread may be in a call on it.
        with self._sending, self._receiving:
            self._socket.close()

    def end(self) -> None:
        """End both directions; what has arrived can still be read."""
        with contextlib.suppress(OSError):  # it has ended already
            self._socket.shutdown(socket.SHUT_RDWR)


def _after(buffers: list[memoryview], sent: int) -> list[memoryview]:
    """Return what is left of the buffers when so many bytes of them are sent."""
    for place, buffer in enumerate(buffers):
        if sent < len(buffer):
            return [buffer[sent:], *buffers[place + 1 :]]
        sent -= len(buffer)
    return []


class ControlSocket:
    """One end of a connected pair of packet sockets, which carries messages without frames.

    Parameters
    ----------
    end
        The socket; it is closed by `close`.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket, self._sending = end, threading.Lock()

    @classmethod
    def pair(cls) -> tuple[ControlSocket, socket.socket]:
        """Return one end of a new connection, and the socket for the process at its other end."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(ours), theirs

    def send(self, message: WorkerMessage) -> None:
        """Send a message, from any thread, without waiting; it is lost if the other side is gone, or does not read.

        Raises
        ------
        MessageError
            It is too large.
        """
        packet = _encode_head(message)
        if len(packet) > _MAX_CONTROL_BYTES:
            text = f"A query of {len(packet):,} bytes; the limit is {_MAX_CONTROL_BYTES:,}."
            raise MessageError("too large", text)
        with self._sending, contextlib.suppress(OSError):
            self._socket.send(packet, _NO_WAITING)

    def receive(self) -> WorkerMessage:
        """Wait for a message; called by one thread.

        Raises
        ------
        EOFError
            The other side is gone.
        MessageError
            The bytes are no message.
        """
        try:
            packet = self._socket.recv(_MAX_CONTROL_BYTES)
        except OSError as error:
            raise EOFError("The other side of the connection is gone.") from error
        if not packet:
            raise EOFError("The other side of the connection is gone.")
        return _decode(packet)

    def close(self) -> None:
        """Close it; may be called twice, from any thread that does not receive."""
        with self._sending:
            self._socket.close()
