# ruff: noqa: A002  the published field names shadow builtins
from collections.abc import Iterable, MutableSequence
from typing import ClassVar

from google.protobuf.message import Message

NAMES: tuple[str, ...]

class Attribute(Message):
    STRING: ClassVar[int]
    DOUBLE: ClassVar[int]
    INT: ClassVar[int]
    type: int
    key: str
    str_val: str
    double_val: float
    int_val: int
    def __init__(
        self,
        *,
        type: int | None = None,
        key: str | None = None,
        str_val: str | None = None,
        double_val: float | None = None,
        int_val: int | None = None,
    ) -> None: ...

class AttributeList(Message):
    @property
    def entries(self) -> MutableSequence[Attribute]: ...
    def __init__(self, *, entries: Iterable[Attribute] | None = None) -> None: ...

class Event(Message):
    type: str
    id: str
    @property
    def attributes(self) -> AttributeList: ...
    def __init__(
        self, *, type: str | None = None, id: str | None = None, attributes: AttributeList | None = None
    ) -> None: ...

class JustBytes(Message):
    contents: bytes
    id: str
    @property
    def attributes(self) -> AttributeList: ...
    def __init__(
        self, *, contents: bytes | None = None, id: str | None = None, attributes: AttributeList | None = None
    ) -> None: ...

class Image(Message):
    bytes: _Bytes
    id: str
    format: str
    @property
    def attributes(self) -> AttributeList: ...
    def __init__(
        self,
        *,
        bytes: _Bytes | None = None,
        id: str | None = None,
        format: str | None = None,
        attributes: AttributeList | None = None,
    ) -> None: ...

class ImagePair(Message):
    id: str
    @property
    def image1(self) -> Image: ...
    @property
    def image2(self) -> Image: ...
    @property
    def attributes(self) -> AttributeList: ...
    def __init__(
        self,
        *,
        image1: Image | None = None,
        image2: Image | None = None,
        id: str | None = None,
        attributes: AttributeList | None = None,
    ) -> None: ...

class TimeStamp(Message):
    description: str
    unixtime: float
    def __init__(self, *, description: str | None = None, unixtime: float | None = None) -> None: ...

class TimeStampList(Message):
    @property
    def entries(self) -> MutableSequence[TimeStamp]: ...
    def __init__(self, *, entries: Iterable[TimeStamp] | None = None) -> None: ...

_Bytes = bytes

def add_attribute(message: Message, key: str, value: str | float) -> None: ...
def attributes(message: Message) -> dict[str, str | float]: ...
