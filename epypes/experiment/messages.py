"""The messages between the three nodes: requests, pairs of images, answers.

Requests and answers are messages of 2019: an Event, a JustBytes. A pair is a tuple of two arrays in a process, and an
Envelope between processes. Attributes are doubles, in seconds.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import MessageError
from epypes.wire import Envelope, Event, attributes, parsed

if TYPE_CHECKING:
    from epypes.experiment.graph import Array

REQUEST: Final = "vision_request"
PAIR: Final = "epypes.experiment.pair"
T_VREQ: Final = "t_vreq"
_IMAGES: Final = ("image_1", "image_2")


class Request(bytes):
    """The bytes of an Event, parsed when it is first read."""

    @cached_property
    def message(self) -> Event:
        """The Event; MessageError is raised if these bytes are none."""
        return parsed(Event, self)

    @property
    def id(self) -> str:
        """The id of the Event; empty if these are no Event's bytes."""
        try:
            return self.message.id
        except MessageError:
            return ""

    @property
    def t_vreq(self) -> float:
        """The time whose images are wanted: Unix time in seconds.

        Raises
        ------
        MessageError
            These are no Event's bytes, or it has no attribute ``t_vreq``.
        """
        found = attributes(self.message).get(T_VREQ)
        if not isinstance(found, float):
            raise MessageError("no time", f"A request needs the attribute {T_VREQ!r}: Unix time in seconds, a double.")
        return found


class StereoPair(tuple[Any, ...]):
    """A tuple of two images, with the id of the request that it answers, and attributes, which may be added to."""

    id: str
    attributes: dict[str, float]

    def __new__(cls, images: Iterable[Any], request_id: str, attributes: Mapping[str, float]) -> Self:
        """Make a pair of two images.

        Raises
        ------
        ValueError
            There are not two.
        """
        pair = super().__new__(cls, images)
        if len(pair) != len(_IMAGES):
            raise ValueError(f"A stereo pair has two images, not {len(pair)}. Give two cameras.")
        pair.id, pair.attributes = request_id, dict(attributes)
        return pair

    @classmethod
    def from_envelope(cls, envelope: Any) -> Self:
        """Return the pair that another process has sent.

        Raises
        ------
        MessageError
            Of reason ``"no pair"`` if it is something else.
        """
        is_envelope = isinstance(envelope, Envelope)
        if not is_envelope or envelope.type != PAIR or any(name not in envelope.parts for name in _IMAGES):
            what = repr(envelope) if is_envelope else f"a {type(envelope).__name__}"
            raise MessageError("no pair", f"Vision takes pairs of images, not {what}.")
        return cls((envelope.parts[name] for name in _IMAGES), envelope.id, envelope.attributes)

    def to_envelope(self) -> Envelope:
        """Return the message that carries the pair to another process."""
        parts = dict(zip(_IMAGES, self, strict=True))
        return Envelope(type=PAIR, parts=parts, id=self.id, source="acquisition", attributes=self.attributes)

    def __repr__(self) -> str:
        return f"<StereoPair {self.id:.40}: {len(self.attributes)} attributes>"


def encode_keypoints(keypoints: Array, *, unsafe_pickle: bool = False) -> bytes:
    """Return matched coordinates, (rows, 4), as the contents of an answer: float32, little-endian, row after row.

    With ``unsafe_pickle``, as the pickle that a peer of 2019 reads.
    """
    if unsafe_pickle:
        # Protocol 2, and the module's name of that time: NumPy 2 has moved it, and can still read both.
        return pickle.dumps(keypoints, 2).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n", 1)
    return keypoints.astype("<f4", copy=False).tobytes()


def decode_keypoints(contents: bytes, *, unsafe_pickle: bool = False) -> Array:
    """Return the matched coordinates in the contents of an answer.

    Parameters
    ----------
    unsafe_pickle
        Whether the contents are a pickle, as a peer of 2019 sends them. The sender of a pickle can run any code in this
        process.

    Raises
    ------
    MessageError
        Of reason ``"pickle"`` if they are a pickle and ``unsafe_pickle`` is not set, ``"bad contents"`` if they can't
        be read.
    """
    import numpy as np

    # Every pickle ends with this byte; as the last byte of a float32 it would be a coordinate of 1e-10 pixels.
    if contents.endswith(pickle.STOP) and not unsafe_pickle:
        raise MessageError("pickle", "The contents are a pickle, which is read with unsafe_pickle=True alone.")
    try:
        if unsafe_pickle:
            found: Array = np.asarray(pickle.loads(contents))  # noqa: S301 - under the option named unsafe
        else:
            found = np.frombuffer(contents, "<f4").reshape(-1, 4)
    except Exception as error:  # broken bytes make pickle raise anything
        raise MessageError("bad contents", f"The contents can't be read: {error}") from error
    return found
