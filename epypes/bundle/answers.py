"""Does the bundle's own f_out make the answer that it made in the notebook?

Recorded beside a sample, where two runs made the same answer: an Envelope with the same parts, or the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from epypes.bundle.compare import differences, first_difference
from epypes.bundle.load import SAMPLES, Bundle
from epypes.bundle.report import Difference, difference
from epypes.errors import MessageError
from epypes.pipeline import EventView
from epypes.pipeline.answering import FOut
from epypes.pipeline.stamps import Stamps
from epypes.run import CompGraphRunner, Run

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


def answer_differences(bundle: Bundle, sample: str, run: Run) -> Iterator[Difference]:
    """Give what the answer of a bundle's f_out is otherwise than was recorded; nothing if none was."""
    from epypes.wire.samples import load_sample

    path = bundle.path / ANSWERS / f"{sample}.npz"
    if "f_out" not in bundle.own or not path.is_file():
        return
    _, expected = load_sample(path)
    got = _parts(_answer(bundle.own["f_out"], bundle.settings.name, run, bundle.settings.attributes))
    found = difference(sample, "the answer of f_out", differences(expected, None if got is None else dict(got)))
    if found is not None:
        yield found


def record_answers_again(bundle: Bundle) -> None:
    """Record anew what the f_out of an unsealed bundle makes of its samples, for those whose answer was recorded."""
    from epypes.wire.samples import load_sample

    for path in (bundle.path / ANSWERS).glob("*.npz"):
        inputs, _ = load_sample(bundle.path / SAMPLES / path.name)
        one, other = (CompGraphRunner(bundle.cg, bundle.settings.hyperparameters).run(**inputs) for _ in range(2))
        path.unlink()
        settings = bundle.settings
        record_answer(path, bundle.own["f_out"], settings.name, (one, other), settings.attributes)


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
