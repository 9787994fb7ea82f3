"""What travels between the three nodes? Requests, pairs of images, answers.

Requests and answers are messages of 2019: an Event, a JustBytes. A pair is a tuple of two arrays in a process, and an
Envelope between processes. Attributes are doubles, in seconds.
"""

from __future__ import annotations

import functools
import io
import pickle
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import MessageError
from epypes.wire import Envelope, Event, attributes, parsed

if TYPE_CHECKING:
    from epypes.experiment.graph import Array

REQUEST: Final = "vision_request"
PAIR: Final = "epypes.experiment.pair"
T_VREQ: Final = "t_vreq"
_IMAGES: Final = ("image_1", "image_2")
# The magic number of a file of numpy.save.
_NPY: Final = b"\x93NUMPY"


class Request(bytes):
    """The bytes of an Event, which are parsed once, when they are asked for something."""

    @functools.cached_property
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


class StereoPair(tuple[Any, ...]):
    """A tuple of two images, with the id of the request that it answers and attributes, which may be added to."""

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

    def __repr__(self) -> str:
        return f"<StereoPair {self.id:.40}: {len(self.attributes)} attributes>"


def envelope_of(pair: StereoPair) -> Envelope:
    """Return a pair as it travels between processes."""
    parts = dict(zip(_IMAGES, pair, strict=True))
    return Envelope(type=PAIR, parts=parts, id=pair.id, source="acquisition", attributes=pair.attributes)


def pair_of(envelope: Any) -> StereoPair:
    """Return the pair that has come from another process.

    Raises
    ------
    MessageError
        Of reason ``"no pair"`` if it is something else.
    """
    is_envelope = isinstance(envelope, Envelope)
    if not is_envelope or envelope.type != PAIR or any(name not in envelope.parts for name in _IMAGES):
        what = repr(envelope) if is_envelope else f"a {type(envelope).__name__}"
        raise MessageError("no pair", f"Vision takes pairs of images, not {what}.")
    return StereoPair((envelope.parts[name] for name in _IMAGES), envelope.id, envelope.attributes)


def read_request(event: Request) -> float:
    """Return the time that a request asks for: Unix time in seconds.

    Raises
    ------
    MessageError
        These are no Event's bytes, or it has no attribute ``t_vreq``.
    """
    found = attributes(event.message).get(T_VREQ)
    if not isinstance(found, float):
        raise MessageError("no time", f"A request needs the attribute {T_VREQ!r}: Unix time in seconds, a double.")
    return found


def contents_of(keypoints: Array, *, unsafe_pickle: bool = False) -> bytes:
    """Return an array as the contents of an answer: as numpy.save writes it, or pickled for a peer of 2019."""
    import numpy as np

    if unsafe_pickle:
        # Protocol 2, and the module's name of that time: NumPy 2 has moved it, and can still read both.
        return pickle.dumps(keypoints, 2).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n", 1)
    rows = np.ascontiguousarray(keypoints)
    return _npy_header(rows.shape, rows.dtype.str) + rows.tobytes()


@functools.lru_cache
def _npy_header(shape: tuple[int, ...], dtype: str) -> bytes:
    # Kept, since writing it takes numpy ten times as long as the rest.
    import numpy as np

    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": dtype, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def keypoints_of(contents: bytes, *, unsafe_pickle: bool = False) -> Array:
    """Return the array in the contents of an answer.

    Parameters
    ----------
    unsafe_pickle
        Whether contents that are a pickle, as a peer of 2019 sends them, are read. Whoever sends one can run any code
        in this process.

    Raises
    ------
    MessageError
        Of reason ``"pickle"`` if they are no .npy file and ``unsafe_pickle`` is not set, ``"bad contents"`` if they
        can't be read.
    """
    import numpy as np

    if not contents.startswith(_NPY) and not unsafe_pickle:
        text = "The contents are not a .npy file. A pickle of a peer of 2019 is read with unsafe_pickle=True alone."
        raise MessageError("pickle", text)
    try:
        if contents.startswith(_NPY):
            found: Array = np.load(io.BytesIO(contents), allow_pickle=False)
        else:
            found = np.asarray(pickle.loads(contents))  # noqa: S301 - under the option named unsafe
    except Exception as error:  # broken bytes make numpy and pickle raise anything
        raise MessageError("bad contents", f"The contents can't be read: {error}") from error
    return found
