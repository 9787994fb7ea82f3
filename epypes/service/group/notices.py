"""What do replicas say to each other on the wire? JSON, one object a message, checked when it comes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, TypeVar

from epypes.errors import MessageError
from epypes.service.group.membership import Heard, Member
from epypes.service.group.revisions import Proposal
from epypes.service.group.turnstile import Stream

VERSION: Final = 1
_MOST_BYTES: Final = 1024**2
_MOST_TEXT: Final = 2_000
# What is done between two words is said in pieces of this size.
MOST_IDS: Final = 500
# Ids of more bytes are not said: they are told apart where they are delivered, and by their numbers.
MOST_ID: Final = 256
# Nobody of us says more at once of anything else.
_MOST_ROWS: Final = 1_000
# The number after the largest that an event may have.
_MOST_WHOLE: Final = 2**64

_T = TypeVar("_T")
_Rows = TypeVar("_Rows", list[Any], dict[str, Any])


@dataclass(frozen=True, slots=True)
class Beat:
    """A replica lives, and so far it knows the streams of events: all below a number are done."""

    member: Member
    known: Sequence[tuple[Stream, int]] = ()


@dataclass(frozen=True, slots=True)
class Left:
    """A replica ends."""

    member_id: str


@dataclass(frozen=True, slots=True)
class Done:
    """A replica is done with events.

    Attributes
    ----------
    member_id
        Its own.
    ids
        Of the events.
    numbers
        Their places in their streams, and whether they have overtaken others.
    """

    member_id: str
    ids: Sequence[str]
    numbers: Sequence[tuple[Stream, int, bool]] = ()


@dataclass(frozen=True, slots=True)
class Begun:
    """A replica has been given events of streams whose beginning it does not know."""

    member_id: str
    numbers: Sequence[tuple[Stream, int]]


@dataclass(frozen=True, slots=True)
class Lost:
    """A replica has gone without a word; said to those who came later."""

    heard: Heard


Notice = Beat | Left | Done | Begun | Lost


def written(notice: Notice | Proposal) -> bytes:
    """Return a notice, or an entry of the log, as it is sent."""
    return json.dumps({"v": VERSION, **_WRITERS[type(notice)](notice)}, separators=(",", ":")).encode()


def read_notice(data: bytes | memoryview) -> Notice:
    """Return a notice that has come.

    Raises
    ------
    MessageError
        It is none.
    """
    said = _said(data)
    return _read(lambda: _READERS[_text(said, "kind")](said))


def read_proposal(data: bytes | memoryview) -> Proposal:
    """Return an entry of the log that has come.

    Raises
    ------
    MessageError
        It is none.
    """
    said = _said(data)
    return _read(lambda: _proposal(said))


def _said(data: bytes | memoryview) -> Mapping[str, Any]:
    if len(data) > _MOST_BYTES:
        raise MessageError("too large", f"A replica says {len(data):,} bytes at once; the limit is {_MOST_BYTES:,}.")
    said = _read(lambda: json.loads(bytes(data)))
    if not isinstance(said, dict) or said.get("v") != VERSION:
        raise MessageError("no notice", f"It is nothing that a replica of this version ({VERSION}) says.")
    return said


def _read(read: Callable[[], _T]) -> _T:
    try:
        return read()
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError("no notice", f"It is nothing that a replica says: {error!r:.200}.") from error


# -- as they are written ----------------------------------------------------------------------------------------------


def _written_member(member: Member) -> dict[str, Any]:
    return {name: part[:_MOST_TEXT] if isinstance(part, str) else part for name, part in asdict(member).items()}


def _written_beat(beat: Beat) -> dict[str, Any]:
    known = [[*stream, at] for stream, at in beat.known]
    return {"kind": "beat", "member": _written_member(beat.member), "known": known}


def _written_lost(lost: Lost) -> dict[str, Any]:
    return {"kind": "lost", "member": _written_member(lost.heard.member), "heard_ms": round(lost.heard.heard_s * 1e3)}


def _written_done(done: Done) -> dict[str, Any]:
    numbers = [[*stream, number, has_overtaken] for stream, number, has_overtaken in done.numbers]
    return {"kind": "done", "from": done.member_id, "ids": list(done.ids), "numbers": numbers}


def _written_begun(begun: Begun) -> dict[str, Any]:
    numbers = [[*stream, number] for stream, number in begun.numbers]
    return {"kind": "begun", "from": begun.member_id, "numbers": numbers}


_WRITERS: Final[Mapping[type, Callable[[Any], dict[str, Any]]]] = {
    Beat: _written_beat,
    Done: _written_done,
    Begun: _written_begun,
    Left: lambda left: {"kind": "left", "from": left.member_id},
    Lost: _written_lost,
    Proposal: asdict,
}


# -- as they are read -------------------------------------------------------------------------------------------------


def _member(told: Mapping[str, Any]) -> Member:
    return Member(**{field.name: _FIELDS[str(field.type)](told, field.name) for field in fields(Member)})


def _beat(said: Mapping[str, Any]) -> Beat:
    return Beat(_member(said["member"]), [(_stream(row), _whole(row[2])) for row in _rows(said["known"])])


def _done(said: Mapping[str, Any]) -> Done:
    ids = [_short(each) for each in _rows(said["ids"])]
    numbers = [(_stream(row), _whole(row[2]), bool(row[3])) for row in _rows(said["numbers"])]
    return Done(_text(said, "from"), ids, numbers)


def _begun(said: Mapping[str, Any]) -> Begun:
    return Begun(_text(said, "from"), [(_stream(row), _whole(row[2])) for row in _rows(said["numbers"])])


def _proposal(said: Mapping[str, Any]) -> Proposal:
    if not isinstance(said["values"], dict) or not all(isinstance(each, dict) for each in said["values"].values()):
        raise TypeError("values")
    texts, numbers = (_text(said, "id"), _text(said, "digest")), (_whole(said["base"]), _whole(said["revision"]))
    return Proposal(*texts, *numbers, said["values"], said["is_restated"] is True)


_READERS: Final[Mapping[str, Callable[[Mapping[str, Any]], Notice]]] = {
    "beat": _beat,
    "done": _done,
    "begun": _begun,
    "left": lambda said: Left(_text(said, "from")),
    "lost": lambda said: Lost(Heard(_member(said["member"]), _whole(said["heard_ms"]) / 1e3)),
}


def _short(value: object) -> str:
    if not isinstance(value, str) or len(value) > _MOST_TEXT:
        raise TypeError(f"{value!r:.40} is no short text")
    return value


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _MOST_WHOLE:
        raise TypeError(f"{value!r:.40} is no whole number")
    return value


def _epoch(value: object) -> int:
    # Whoever sends events may call its start what it likes.
    return -_whole(-value) if isinstance(value, int) and value < 0 else _whole(value)


def _text(said: Mapping[str, Any], name: str) -> str:
    return _short(said[name])


def _shown(said: Mapping[str, Any], name: str) -> str:
    return _printable(_text(said, name))


def _printable(text: str) -> str:
    # It is shown in terminals, which take orders in text, and can't show half a character.
    return "".join(each if each.isprintable() else " " for each in text)


def _counts(said: Mapping[str, Any], name: str) -> dict[str, int]:
    return {_printable(_short(key)): _whole(count) for key, count in _rows(said[name]).items()}


def _rows(said: _Rows) -> _Rows:
    if not isinstance(said, list | dict) or len(said) > _MOST_ROWS:
        raise TypeError(f"{said!r:.40} is not so many things")
    return said


def _stream(row: Sequence[Any]) -> Stream:
    return _short(row[0]), _epoch(row[1])


_FIELDS: Final[Mapping[str, Callable[[Mapping[str, Any], str], Any]]] = {
    "str": _shown,
    "int": lambda said, name: _whole(said[name]),
    "bool": lambda said, name: said[name] is True,
    "Mapping[str, int]": _counts,
}
