"""The adapters of a bundle: an event becomes a payload (f_in), and a run becomes an answer (f_out).

The answers of a user's own f_out are recorded beside the samples, where two runs give the same answer: an Envelope with
the same parts, or the same bytes. A replay compares them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.compare import Difference, difference, differences, first_difference
from epypes.errors import MessageError
from epypes.pipeline import EventView
from epypes.pipeline.answering import FOut
from epypes.pipeline.stamps import Stamps
from epypes.run import Run
from epypes.run.guard import is_array

if TYPE_CHECKING:
    from epypes.bundle.load import Bundle
    from epypes.wire import Envelope

REQUEST: Final = "epypes.request"
RESULT: Final = "epypes.result"


def payload_of(inputs: Sequence[str], rgb: Collection[str] = ()) -> Callable[[Any], Mapping[str, Any]]:
    """Return an f_in: it takes the parts of an Envelope that are named like the input tokens.

    Images arrive in the order of their tokens' colours: RGB for those named in ``rgb``, BGR for all others.
    The f_in raises MessageError for anything but an Envelope, and for one whose parts are not the inputs.
    """

    def f_in(event: Any) -> Mapping[str, Any]:
        from epypes.wire import Envelope

        if not isinstance(event, Envelope):
            raise MessageError("not an envelope", f"The event is a {type(event).__name__}, not an epypes.v1 Envelope.")
        missing = [token for token in inputs if token not in event.parts]
        unknown = [name for name in event.parts if name not in inputs]
        if missing or unknown:
            got = ", ".join(map(repr, event.parts)) or "none"
            text = f"The event must have the parts {', '.join(map(repr, inputs))}; it has {got}."
            raise MessageError("wrong parts", text)
        return in_order(event, rgb)

    return f_in


def in_order(envelope: Envelope, rgb: Collection[str]) -> dict[str, Any]:
    """Return the parts of an envelope; images that came in another order than their token's are converted, once."""
    from epypes.wire.arrays import exchange_colours

    return {
        token: value if (token in envelope.rgb) == (token in rgb) else exchange_colours(value)
        for token, value in envelope.parts.items()
    }


def answer_with(
    outputs: Sequence[str], bundle_digest: str, rgb: Collection[str] = (), *, detach: bool = True
) -> Callable[[EventView], Envelope]:
    """Return an f_out: an Envelope with the output tokens and the times, which answers the event by its id.

    The arrays are copies, since a function may use the memory of its result again for the next event before this one
    is sent. What can't be sent raises MessageError here, where it becomes the event's failure. A worker passes
    ``detach=False``: it encodes each answer when the pipeline puts it, before the next event, so that neither a copy
    nor a check is needed. Images of the tokens named in ``rgb`` are sent as RGB.
    """

    def f_out(view: EventView) -> Envelope:
        from epypes.wire import Envelope, encode

        event, report = view.event if isinstance(view.event, Envelope) else None, view.report
        answer = Envelope(
            type=RESULT,
            parts={token: detached(view[token]) if detach else view[token] for token in outputs},
            source=view.name,
            correlation_id=event.id if event else "",
            acquired_ns=event.acquired_ns if event else 0,
            revision=view.run.revision,
            bundle_digest=bundle_digest,
            attributes={**view.attributes, "total_ns": report.total_ns, "overhead_ns": report.overhead_ns},
            timings=report.durations_ns,
            rgb=[token for token in outputs if token in rgb],
        )
        if detach:
            encode(answer)
        return answer

    return f_out


def is_usual(port: Callable[..., Any]) -> bool:
    """Whether this is the f_in or f_out of a bundle that names none."""
    return getattr(port, "__module__", None) == __name__


def detached(value: Any) -> Any:
    """Return a value whose arrays, also in tuples, lists and dicts, are copies."""
    if is_array(value):
        return value.copy()
    if type(value) in (tuple, list):
        return type(value)(map(detached, value))
    if type(value) is dict:
        return {key: detached(item) for key, item in value.items()}
    return value


ANSWERS: Final = "answers"
# How a difference of an answer is named, beside those of tokens.
ANSWER: Final = "the answer of f_out"
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
    found = difference(sample, ANSWER, differences(expected, None if got is None else dict(got)))
    if found is not None:
        yield found


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
