"""Recorded values in a file: an .npz archive that numpy alone can open.

Every array is an entry of its own with a readable name (``inputs.image``, ``outputs.keypoints.0``); the entry
``description`` holds the rest as JSON. The same values give the same bytes, so that the manifest of a bundle and
version control see every change.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from epypes.errors import InvalidValue, MessageError
from epypes.optional import optional_import
from epypes.wire.arrays import flat_bytes
from epypes.wire.decoder import ValueReader
from epypes.wire.encoder import Payload, ValueWriter
from epypes.wire.limits import Limits
from epypes.wire.protobuf import message_class

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray

FORMAT = 1
_DESCRIPTION = "description"
# The last two are there only where a graph has state between runs.
_SIDES = ("inputs", "outputs", "state", "state_after")
# A zip entry carries a time; a fixed one makes the file depend on its values alone.
_EPOCH = (1980, 1, 1, 0, 0, 0)
# A sample is the user's own file, not a peer's message: it may hold any number of arrays and keys.
_LIMITS = Limits(frames=2**31, parts=2**31, keys=2**31)
# Errors of zipfile and numpy for broken files; RuntimeError for encryption or an unknown compression.
_BROKEN = (OSError, ValueError, TypeError, LookupError, EOFError, AttributeError, MemoryError, RuntimeError)


class Sample(NamedTuple):
    """The values of one run.

    Attributes
    ----------
    inputs, outputs
        Values by token.
    state, state_after
        What the run began with and what it left, by key of ``runner.state``; empty of a graph without delays.
    """

    inputs: dict[str, Any]
    outputs: dict[str, Any]
    state: dict[str, Any]
    state_after: dict[str, Any]


def save_sample(
    path: str | Path,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    *,
    rgb: Collection[str] = (),
    state: Mapping[str, Any] = MappingProxyType({}),
    state_after: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write the values of one run to an .npz file.

    Parameters
    ----------
    path
        The file, with its suffix; an existing one is replaced.
    inputs, outputs
        Values by token name, of the types that `epypes.wire.encode` takes.
    rgb
        Names of the tokens whose images are in RGB order; those of all others are BGR.
    state, state_after
        What the run began with and what it left, by key of ``runner.state``.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for a value of another type, with its name.
    OSError
        If the file can't be written.
    """
    import numpy as np

    with optional_import():
        from google.protobuf.json_format import MessageToDict

    writer = ValueWriter(_LIMITS, inline_below=0)
    arrays: dict[str, AnyArray] = {}
    described: dict[str, Any] = {"format": FORMAT}
    for side, values in zip(_SIDES, (inputs, outputs, state, state_after), strict=True):
        if side not in _SIDES[:2] and not values:
            continue
        described[side] = []
        for name, value in values.items():
            message = message_class("epypes.v1.Value")()
            writer.write_named(message, value, name, "rgb" if name in rgb else "bgr")
            described[side].append([name, MessageToDict(message, preserving_proto_field_name=True)])
        for payload in writer.payloads[len(arrays) :]:
            arrays[_entry_name(side, payload, arrays)] = _as_array(payload)
    described["arrays"] = list(arrays)
    text = json.dumps(described, sort_keys=True, indent=1, ensure_ascii=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in {_DESCRIPTION: np.array(text), **arrays}.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, buffer.getvalue())


def _entry_name(side: str, payload: Payload, taken: Mapping[str, object]) -> str:
    # The path, readable in any zip tool, without the characters that file systems refuse.
    name = ".".join([side, *(re.sub(r"[^\w-]+", "_", str(step))[:80] for step in payload.path)])
    unique, count = name, 1
    while unique in taken:
        count += 1
        unique = f"{name}~{count}"
    return unique


def _as_array(payload: Payload) -> AnyArray:
    import numpy as np

    if isinstance(payload.data, bytes):
        return np.frombuffer(payload.data, np.uint8)
    return np.ascontiguousarray(payload.data).reshape(payload.data.shape)


def load_sample(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the inputs and the outputs of a file that `save_sample` wrote; arrays are read-only.

    Raises
    ------
    MessageError
        As `read_sample` does.
    """
    sample = read_sample(path)
    return sample.inputs, sample.outputs


def read_sample(path: str | Path) -> Sample:
    """Return the values of a file that `save_sample` wrote, with the state; arrays are read-only.

    Raises
    ------
    MessageError
        Of reason ``"bad sample"`` if the file is missing, broken or no sample; no pickle is ever read.
    """
    try:
        # Not np.load: it leaves the file open when the archive is broken.
        with Path(path).open("rb") as file, zipfile.ZipFile(file) as archive:
            described = json.loads(str(_read_entry(archive, _DESCRIPTION)[()]))
            if described["format"] != FORMAT:
                raise InvalidValue(f"its format is {described['format']!r}, and this version reads {FORMAT}")
            views = [flat_bytes(_read_entry(archive, name)) for name in described["arrays"]]
        reader = ValueReader(views, _LIMITS)
        sides = {**dict.fromkeys(_SIDES[2:], ()), **described}
        sample = Sample(*(reader.read_named([*_parts(sides[side])], side)[0] for side in _SIDES))
        reader.check_all_used()
    except (MessageError, zipfile.BadZipFile, zlib.error, *_BROKEN) as error:
        raise MessageError("bad sample", f"{path} is no sample of EPypes: {error}") from error
    return sample


def _read_entry(archive: zipfile.ZipFile, name: str) -> AnyArray:
    import numpy as np

    with archive.open(f"{name}.npy") as entry:
        array: AnyArray = np.lib.format.read_array(entry, allow_pickle=False)
        return array


def _parts(entries: Any) -> Iterator[Any]:
    """Yield the values of a description as protobuf messages, each with its name."""
    with optional_import():
        from google.protobuf.json_format import ParseDict, ParseError

    for name, value in entries:
        try:
            yield ParseDict({"name": name, "value": value}, message_class("epypes.v1.Part")())
        except ParseError as error:
            raise MessageError("bad sample", f"the description of {name!r} is damaged: {error}") from error
