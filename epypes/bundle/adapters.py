"""The adapters of a bundle: an event becomes a payload (f_in), and a run becomes an answer (f_out).

A sample holds the answer of a user's own f_out as one more output, ANSWER: a replay compares it like a token.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError, StateChanged
from epypes.pipeline import EventView
from epypes.pipeline.reactive import FOut
from epypes.run import Run
from epypes.run.guard import is_array

if TYPE_CHECKING:
    from epypes.wire import Envelope

REQUEST: Final = "epypes.request"
RESULT: Final = "epypes.result"
# The name of a recorded answer, among the outputs of a sample.
ANSWER: Final = "the answer of f_out"

# The dict of adapters whose name is that of another function in the bundle's module.
ADAPTERS: Final = "adapters"


def own_part(module: object, name: str) -> Any:
    """Return what a bundle's module has of its own under a name; AttributeError if it has nothing."""
    others = getattr(module, ADAPTERS, {})
    return others[name] if type(others) is dict and name in others else getattr(module, name)


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


def is_usual(adapter: Callable[..., Any]) -> bool:
    """Whether this is the f_in or f_out of a bundle that names none."""
    return getattr(adapter, "__module__", None) == __name__


def detached(value: Any) -> Any:
    """Return a value whose arrays, also in tuples, lists and dicts, are copies."""
    if is_array(value):
        return value.copy()
    if type(value) in (tuple, list):
        return type(value)(map(detached, value))
    if type(value) is dict:
        return {key: detached(item) for key, item in value.items()}
    return value


def answer_of(f_out: FOut, name: str, run: Run, attributes: Mapping[str, Any]) -> dict[str, Any] | bytes | None:
    """Return what a replay compares of the answer that a user's own f_out makes of a run.

    Parameters
    ----------
    f_out
        The user's own.
    name
        The bundle's.
    run
        The run.
    attributes
        The pipeline's attributes.

    Returns
    -------
    dict, bytes or None
        The parts of an Envelope, or bytes; None for another answer, and where f_out needs the event, which a sample
        does not have.
    """
    from epypes.wire import Envelope

    try:
        answer = f_out(EventView.of_run(name, Envelope("epypes.sample", id="sample"), run, attributes))
    except StateChanged:
        raise
    except Exception:  # whatever a user's function does that misses its event
        return None
    if isinstance(answer, Envelope):
        return dict(answer.parts)
    return bytes(answer) if isinstance(answer, bytes | bytearray | memoryview) else None
