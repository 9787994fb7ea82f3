"""Does the bundle's own f_out make the answer that it made in the notebook?

Recorded beside a sample, where two runs made the same answer: an Envelope with the same parts, or the same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from epypes.bundle.compare import first_difference
from epypes.bundle.load import Bundle
from epypes.errors import MessageError
from epypes.pipeline import EventView
from epypes.pipeline.answering import FOut
from epypes.pipeline.stamps import Stamps
from epypes.run import Run

ANSWERS: Final = "answers"
_BYTES: Final = "bytes"
_Parts = Mapping[str, Any]


def record_answer(path: Path, f_out: FOut, name: str, runs: tuple[Run, Run], attributes: _Parts) -> bool:
    """Write what f_out makes of a run, if it makes the same of another one of the same payload.

    Parameters
    ----------
    path
        The file.
    f_out
        The user's own.
    name
        The bundle's.
    runs
        Two runs of one payload.
    attributes
        The pipeline's attributes.
    """
    from epypes.wire.samples import save_sample

    one, other = (_parts(_answer(f_out, name, run, attributes)) for run in runs)
    if one is None or other is None or first_difference(dict(one), dict(other)) is not None:
        return False
    path.parent.mkdir(exist_ok=True)
    try:
        save_sample(path, {}, one)
    except MessageError:  # it has no codec: then it can't be sent either
        path.unlink(missing_ok=True)
        return False
    return True


def bundle_answer_difference(bundle: Bundle, sample: str, run: Run) -> str | None:
    """Return how the answer of a bundle's f_out is another one than was recorded; None if it is not, or none was."""
    from epypes.wire.samples import load_sample

    path = bundle.path / ANSWERS / f"{sample}.npz"
    if "f_out" not in bundle.own or not path.is_file():
        return None
    _, expected = load_sample(path)
    got = _parts(_answer(bundle.own["f_out"], bundle.settings.name, run, bundle.settings.attributes))
    return "f_out makes no answer" if got is None else first_difference(expected, dict(got))


def _answer(f_out: FOut, name: str, run: Run, attributes: _Parts) -> Any:
    """Return what f_out makes of a run; None if it needs the event, which is not known."""
    from epypes.wire import Envelope

    try:
        return f_out(EventView(name, Envelope("epypes.sample", id="sample"), run, attributes, Stamps()))
    except Exception:  # whatever a user's function does that misses its event
        return None


def _parts(answer: Any) -> _Parts | None:
    from epypes.wire import Envelope

    if isinstance(answer, Envelope):
        return answer.parts
    return {_BYTES: bytes(answer)} if isinstance(answer, bytes | bytearray | memoryview) else None
