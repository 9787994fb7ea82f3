"""ROS 2 messages as Envelopes and back, in CDR: images, compressed images, texts and numbers.

`ros_type` returns a type by its name. `RosType.to_envelope` reads what arrives on a topic of ROS 2, and
`RosType.from_envelope` makes what is published there. DDS calls the type `RosType.dds_name`, and the topic ``/image``
``rt/image``; Zenoh needs `RosType.rihs01` too. rosbags reads and writes the bytes.

A ROS message is one value with a time stamp and a frame, so this is all of an Envelope that crosses: the value of one
part, the order of its colours, ``acquired_ns`` as ``stamp``, and ``source`` as ``frame_id``. An answer has the frame of
its request. Attributes, ids, sequence numbers, timings, the revision and failures stay behind.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import InvalidValue, MessageError
from epypes.images import Order
from epypes.optional import optional_import
from epypes.wire.arrays import ENCODINGS, flat_bytes, image_encoding, view_rows
from epypes.wire.envelope import Envelope
from epypes.wire.foxglove import image_file_format
from epypes.wire.limits import DEFAULT_LIMITS, Limits

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_HEADER: Final = "std_msgs/Header header\n"
_HEADER_DEFINITION: Final = "builtin_interfaces/Time stamp\nstring frame_id\n"
# The encodings that say no order of colours, which are those of OpenCV: "32FC1".
_DEPTHS: Final = {"8U": "|u1", "8S": "|i1", "16U": "<u2", "16S": "<i2", "32S": "<i4", "32F": "<f4", "64F": "<f8"}
_DEPTH_NAMES: Final = {dtype: name for name, dtype in _DEPTHS.items()}
_CHANNELS: Final = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)C([1-9][0-9]{0,2})?")
# OpenCV's bound.
_MAX_CHANNELS: Final = 512
_SECOND_NS: Final = 10**9
_INT32: Final = range(-(2**31), 2**31)
_INT64: Final = range(-(2**63), 2**63)


@dataclass(frozen=True, slots=True)
class RosType:
    """A type of ROS 2's messages; `ros_type` returns it.

    Attributes
    ----------
    name
        ``"sensor_msgs/msg/Image"``.
    definition
        The text of its .msg file, without comments.
    part
        The name of the part that a received message becomes, unless the receiver names another.
    """

    name: str
    definition: str = field(repr=False)
    part: str = field(repr=False)
    # What a part must be, in words and as a check.
    _wanted: str = field(repr=False)
    _fits: Callable[[Any], bool] = field(repr=False)
    # From a message: the value, the order of its colours, attributes.
    _read: Callable[[Any], tuple[Any, Order, Mapping[str, Any]]] = field(repr=False)
    # The fields of a message but its header, of a value in an order.
    _fields: Callable[[Any, Order], dict[str, Any]] = field(repr=False)

    @property
    def dds_name(self) -> str:
        """Its name in DDS: ``"sensor_msgs::msg::dds_::Image_"``."""
        return dds_name(self.name)

    @property
    def rihs01(self) -> str:
        """The hash of its definition, which ROS 2 has had since Iron: ``"RIHS01_..."``."""
        return str(typestore().hash_rihs01(self.name))

    def to_envelope(self, cdr: bytes | memoryview, token: str = "", limits: Limits = DEFAULT_LIMITS) -> Envelope:
        """Return a message as an Envelope of one part.

        Parameters
        ----------
        cdr
            The message, with its encapsulation header. An image is a read-only view of it: leave it as it is.
        token
            The name of the part; by default ``"image"``, or ``"data"`` for texts and numbers.
        limits
            Its ``total_bytes`` is checked.

        Returns
        -------
        Envelope
            Its type is the type's name. An image is an array of shape (height, width) or (height, width, channel) in
            the byte order of this machine; a compressed one is the bytes of its file, with its format as an attribute.

        Raises
        ------
        MessageError
            Of reason ``"too large"``, ``"bad cdr"``, ``"bad encoding"``, ``"bad step"``, ``"size differs"`` or
            ``"bad stamp"``; and nothing else, whatever the bytes are.
        """
        with optional_import():
            from rosbags.serde import SerdeError

        raw = memoryview(cdr).cast("B").toreadonly()
        self._check_size(raw, limits)
        try:
            message: Any = typestore().deserialize_cdr(raw, self.name)
        except SerdeError as error:
            raise MessageError("bad cdr", f"The message can't be read as {self.name}: {error}") from error
        value, order, attributes = self._read(message)
        token = token or self.part
        source, acquired_ns = _frame_and_time(message.header) if self._has_header else ("", 0)
        return Envelope(
            self.name,
            {token: value},
            source=source,
            acquired_ns=acquired_ns,
            attributes=attributes,
            rgb=[token] if order == "rgb" else [],
        )

    def from_envelope(self, envelope: Envelope, token: str = "", limits: Limits = DEFAULT_LIMITS) -> memoryview:
        """Return a part of an Envelope as a message of this type.

        Parameters
        ----------
        envelope
            What is published.
        token
            The name of the part; not needed where just one part fits the type: an array of two or three axes, the
            bytes of an image's file, a text, or a number.
        limits
            Its ``total_bytes`` is kept.

        Returns
        -------
        memoryview
            The message in CDR with its encapsulation header, read-only. Pixels of a C-contiguous array are copied once.

        Raises
        ------
        MessageError
            Of reason ``"failure"``, ``"no such part"``, ``"several parts"``, ``"wrong type"``, ``"no encoding"``,
            ``"bad text"``, ``"bad stamp"`` or ``"too large"``.
        """
        name = self._part_name(envelope, token)
        fields = self._fields(envelope.parts[name], "rgb" if name in envelope.rgb else "bgr")
        types = typestore().types
        if self._has_header:
            sec, nanosec = divmod(envelope.acquired_ns, _SECOND_NS)
            if sec not in _INT32:
                raise MessageError("bad stamp", f"ROS 2's time stamps end in 2038; this is second {sec:,}.")
            frame_id = _checked_text(envelope.request_source or envelope.source)
            stamp = types["builtin_interfaces/msg/Time"](sec, nanosec)
            fields["header"] = types["std_msgs/msg/Header"](stamp, frame_id)
        cdr = typestore().serialize_cdr(types[self.name](**fields), self.name)
        self._check_size(cdr, limits)
        return cdr

    def check_kind(self, token: str, value: Any) -> None:
        """Raise MessageError for a value of another kind than a message of this type; all numbers are one kind."""
        kinds = _NUMBERS if self.name in _NUMBERS else (self.name,)
        if not any(_TYPES[kind]._fits(value) for kind in kinds):
            raise self._wrong_type(token, value)

    def _wrong_type(self, token: str, value: Any) -> MessageError:
        text = f"{token!r} is {_describe(value)}; a {self.name} must be {self._wanted}."
        return MessageError("wrong type", text)

    @property
    def _has_header(self) -> bool:
        return self.definition.startswith(_HEADER)

    def _check_size(self, cdr: memoryview, limits: Limits) -> None:
        if cdr.nbytes > limits.total_bytes:
            text = f"A {self.name} of {cdr.nbytes:,} bytes; the limit is {limits.total_bytes:,}."
            raise MessageError("too large", text)

    def _part_name(self, envelope: Envelope, token: str) -> str:
        """Return the name of the part that becomes the message."""
        failure, parts = envelope.failure, envelope.parts
        if failure is not None:
            text = f"{failure.function or 'The service'} failed, and {self.name} can't hold that: {failure.message}"
            raise MessageError("failure", text)
        if token and token not in parts:
            near = difflib.get_close_matches(token, parts, n=1)
            way_out = f"Did you mean {near[0]!r}?" if near else f"There are: {', '.join(parts) or 'none'}."
            raise MessageError("no such part", f"The message has no part {token!r} to be a {self.name}. {way_out}")
        if token and not self._fits(parts[token]):
            raise self._wrong_type(token, parts[token])
        fitting = [token] if token else [name for name, value in parts.items() if self._fits(value)]
        if len(fitting) > 1:
            text = f"Each of {', '.join(map(repr, fitting))} could be the {self.name}."
            raise MessageError("several parts", f"{text} Name one: token={fitting[0]}.")
        if not fitting:
            there = ", ".join(f"{name!r} ({_describe(value)})" for name, value in parts.items()) or "no parts"
            raise MessageError("no such part", f"A {self.name} must be {self._wanted}; the message has {there}.")
        return fitting[0]


def dds_name(name: str) -> str:
    """Return the name in DDS of a type of rosbags; those of ROS 2 have names of their own there."""
    package, folder, last = name.split("/")
    return f"{package}::msg::dds_::{last}_" if folder == "msg" else f"{package}::{folder}::{last}"


def ros_type(name: str) -> RosType:
    """Return a type by its name.

    Parameters
    ----------
    name
        ``"sensor_msgs/msg/Image"``, ``"sensor_msgs/Image"``, or as in DDS.

    Raises
    ------
    ValueError
        EPypes has no such type.

    Examples
    --------
    >>> ros_type("sensor_msgs/Image").dds_name
    'sensor_msgs::msg::dds_::Image_'
    """
    plain = name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")
    package, _, rest = plain.partition("/")
    found = _TYPES.get(f"{package}/msg/{rest.removeprefix('msg/')}")
    if found is None:
        near = difflib.get_close_matches(plain, _TYPES, n=1, cutoff=0.8)
        way_out = f"Did you mean {near[0]!r}?" if near else f"There are: {', '.join(_TYPES)}."
        raise InvalidValue(f"No type {name!r} among those of ROS 2's messages that EPypes has. {way_out}")
    return found


@cache
def typestore() -> Typestore:
    """Return rosbags' store of these types alone: one of all types of ROS 2 takes 0.8 s to make."""
    with optional_import():
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(_HEADER_DEFINITION, "std_msgs/msg/Header"))
    for name, each in _TYPES.items():
        store.register(get_types_from_msg(each.definition, name))
    return store


def _frame_and_time(header: Any) -> tuple[str, int]:
    """Return the frame and the time stamp in nanoseconds of a message's header."""
    if header.stamp.sec < 0:
        raise MessageError("bad stamp", f"The message has a time stamp before 1970: second {header.stamp.sec:,}.")
    return header.frame_id, header.stamp.sec * _SECOND_NS + header.stamp.nanosec


def _is_image(value: Any) -> bool:
    import numpy as np

    return type(value) is np.ndarray and value.ndim in (2, 3)


def _read_image(message: Any) -> tuple[Any, Order, Mapping[str, Any]]:
    import numpy as np

    encoding, size = message.encoding, (message.height, message.width)
    channels, dtype_text = _channels_and_dtype(encoding)
    dtype = np.dtype(dtype_text).newbyteorder(">" if message.is_bigendian else "<")
    image = view_rows(message.data.data, size, channels, dtype, message.step, f"An image, {encoding},")
    if not dtype.isnative:
        image = image.astype(dtype.newbyteorder("="))
    return image, "rgb" if encoding.startswith("rgb") else "bgr", {}


def _channels_and_dtype(encoding: str) -> tuple[int, str]:
    if encoding in ENCODINGS:
        return ENCODINGS[encoding]
    match = _CHANNELS.fullmatch(encoding)
    if match is not None and (channels := int(match[2] or 1)) <= _MAX_CHANNELS:
        return channels, _DEPTHS[match[1]]
    known = f"{', '.join(ENCODINGS)}, and 8UC3, 32FC1 and their like"
    raise MessageError("bad encoding", f"An image has encoding {encoding[:40]!r}; known are {known}.")


def _image_fields(image: Any, order: Order) -> dict[str, Any]:
    import numpy as np

    image = image.astype(image.dtype.newbyteorder("<"), copy=False)
    encoding = image_encoding(image, order) or _plain_encoding(image)
    height, width = image.shape[:2]
    data = np.frombuffer(flat_bytes(image), np.uint8)
    step = image.nbytes // height
    return {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": step, "data": data}


def _plain_encoding(image: Any) -> str:
    """Return the encoding of an image without an order of colours: of floats, say, or of two channels."""
    channels, depth = 1 if image.ndim == 2 else image.shape[2], _DEPTH_NAMES.get(image.dtype.str)
    if image.size and depth and channels <= _MAX_CHANNELS and max(image.shape) < 2**31:
        return f"{depth}C{channels}"
    way_out = "Return it as uint8, uint16 or float32, with at least one pixel."
    if image.dtype.kind == "b":
        way_out = "Return mask.astype('uint8') * 255."
    raise MessageError("no encoding", f"ROS 2 has no encoding for {_describe(image)}. {way_out}")


def _read_compressed(message: Any) -> tuple[Any, Order, Mapping[str, Any]]:
    return message.data.tobytes(), "bgr", {"format": message.format}


def _compressed_fields(value: bytes, order: Order) -> dict[str, Any]:
    import numpy as np

    return {"format": image_file_format(value), "data": np.frombuffer(value, np.uint8)}


def _read_data(message: Any) -> tuple[Any, Order, Mapping[str, Any]]:
    return message.data, "bgr", {}


def _text_fields(value: str, order: Order) -> dict[str, Any]:
    return {"data": _checked_text(value)}


def _number_fields(value: Any, order: Order) -> dict[str, Any]:
    # Also of numpy's scalars.
    return {"data": value.item() if hasattr(value, "item") else value}


def _checked_text(text: str) -> str:
    """Return a text that a string of ROS 2 can hold: C programs read it up to the first NUL."""
    if "\0" in text or text != text.encode(errors="replace").decode():
        raise MessageError("bad text", f"ROS 2 can't hold this text, for its NUL or lone surrogates: {text[:40]!r}.")
    return text


def _describe(value: Any) -> str:
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    return type(value).__name__ if not shape else f"{dtype} {' x '.join(map(str, shape))}"


def _is_a(kind: type, of_numpy: str) -> Callable[[Any], bool]:
    """Return the check whether a value is a number of a kind, Python's own or a scalar of numpy of a kind of dtype."""

    def check(value: Any) -> bool:
        dtype = getattr(value, "dtype", None)
        return type(value) is kind or (dtype is not None and not value.shape and dtype.kind in of_numpy)

    return check


_is_integer: Final = _is_a(int, "iu")
_NUMBERS: Final = ("std_msgs/msg/Bool", "std_msgs/msg/Int64", "std_msgs/msg/Float64")
_TYPES: Final[Mapping[str, RosType]] = {
    each.name: each
    for each in (
        RosType(
            "sensor_msgs/msg/Image",
            _HEADER + "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
            "image",
            "an array of shape (height, width) or (height, width, channel)",
            _is_image,
            _read_image,
            _image_fields,
        ),
        RosType(
            "sensor_msgs/msg/CompressedImage",
            _HEADER + "string format\nuint8[] data\n",
            "image",
            "the bytes of a JPEG, PNG or WebP file",
            lambda value: type(value) is bytes and image_file_format(value) != "",
            _read_compressed,
            _compressed_fields,
        ),
        RosType(
            "std_msgs/msg/String",
            "string data\n",
            "data",
            "a text",
            lambda value: type(value) is str,
            _read_data,
            _text_fields,
        ),
        RosType(
            "std_msgs/msg/Bool", "bool data\n", "data", "True or False", _is_a(bool, "b"), _read_data, _number_fields
        ),
        RosType(
            "std_msgs/msg/Int64",
            "int64 data\n",
            "data",
            "a whole number of 64 bits",
            lambda value: _is_integer(value) and int(value) in _INT64,
            _read_data,
            _number_fields,
        ),
        RosType(
            "std_msgs/msg/Float64", "float64 data\n", "data", "a float", _is_a(float, "f"), _read_data, _number_fields
        ),
    )
}
