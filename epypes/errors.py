"""The errors that EPypes raises, and what each one carries.

Everything an error's text mentions is an attribute of it::

    EpypesError
    +-- InvalidValue            an argument has a value that can't be used; also a ValueError
    +-- InvalidType             an argument is of another type than it must be; also a TypeError
    +-- UnknownAttribute        a module or an object has no such attribute; also an AttributeError
    +-- GraphError              a graph can't be built; .findings lists every problem
    +-- UnknownName             no such token, function, output ...; .name, .known
    +-- NotComputed             a token has no value yet; .token
    |   +-- StaleToken          a token's value is out of date; .token
    +-- PayloadError            run() was given too little or the wrong tokens; .tokens
    +-- HyperparameterError     a token can't be set, frozen or unfrozen; .token
    +-- IteratorRefused         a value can be read only once; .token, .function
    +-- InputMutated            a function has changed its input in place; .function, .token
    +-- PlaceholderNeeded       a function is still to be written; .functions
    +-- OutputArityError        a function returned another number of values; .function
    +-- StateChanged            a bundle's function changed what outlives its call; .function, .changed
    +-- ContractBroken          a value is not the image that an annotation says; .function, .token
    +-- StillRunning            something did not stop in time; .name, .functions, .timeout_s
    +-- MailboxOverflow         a mailbox with policy "fault" is full; .size
    +-- MissingPackage          a package that an extra brings is not installed; .package, .extra
    +-- SourceRefused           a graph can't be written as one function; .reasons
    +-- LayoutUnavailable       no Graphviz engine answers; .tried
    +-- ImageFileError          an image file can't be read or written; .path
    +-- CameraUnavailable       a camera gives no frame just now; .camera .is_gone
    +-- FrameUnavailable        no frame is near enough to a time; .requested_ns, .oldest_ns, .newest_ns
    +-- MessageError            a message can't be made or understood; .reason
    +-- AddressError            an address can't be bound or connected to; .address
    |   +-- BrokerError         a broker can't be reached, or refuses; .address, without the password
    +-- KeysError               keys can't be made, read or used; .path
    +-- RecordingError          a recording of messages can't be written or read; .path
    +-- SettingsError           settings of hyperparameters can't be written or read; .path, .reasons
    +-- BundleError             a bundle is not what it says; .path
    |   +-- BundleChanged       a bundle's files are not those of its manifest; .path
    |   +-- PromotionRefused    a graph can't become a bundle; .reasons
    |   +-- ReplayDiffers       a bundle computes something else; .report
    +-- ExperimentError         the paper's experiment can't begin or go on; .name
    +-- ServiceError            a service can't start or can't be called; .path
    |   +-- RemoteFailure       a function failed in the service; .function, .message
    |   +-- RevisionConflict    another client has changed the parameters meanwhile; .current
    |   +-- ParametersRefused   a running service does not take new values; .problems
    |   +-- DeployRefused       a running service does not take a bundle; .reasons
    +-- ScaleError              a set of images or settings can't be run
    |   +-- ExecutorBroken      the workers of an executor are gone; .done
    +-- StoreError              a database can't be opened, read or written; .place
    +-- FailureNotKept          a failure of a service, or its event, can't be had; .id, .path

The user's own exceptions are never wrapped: they keep their type and traceback and get a note.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from epypes.deprecation import OldNames
from epypes.tracebacks import render
from epypes.wording import keep_as_state

if TYPE_CHECKING:
    from epypes.bundle.proof.replay import ReplayReport
    from epypes.images import Image
    from epypes.service.parameters import Parameters


class EpypesError(Exception):
    """Every error of EPypes; catch it to catch them all."""

    def __str__(self) -> str:
        # KeyError shows the repr of its argument; a sentence should be shown as it is.
        return str(self.args[0]) if self.args else type(self).__name__

    def _render_traceback_(self) -> list[str]:
        """Return the lines that IPython shows: they end at the user's own line."""
        return render(self, is_own=True)


class InvalidValue(EpypesError, ValueError):
    """An argument has a value that can't be used."""


class InvalidType(EpypesError, TypeError):
    """An argument is of another type than it must be."""


class UnknownAttribute(EpypesError, AttributeError):
    """A module or an object has no such attribute."""


class _PathError(EpypesError):
    """An error about what a path or a URL names; ``path`` is that."""

    def __init__(self, path: object, text: str) -> None:
        self.path = str(path)
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem of a graph.

    Attributes
    ----------
    kind
        ``"cycle"``, ``"two producers"``, ``"no io"``, ``"no function"``, ``"bad io"``, ``"arity"``, ``"not callable"``,
        ``"selector"``, ``"used up"``, ``"types"`` or ``"colour"``; where a graph is made of functions or of graphs also
        ``"no name"``, ``"no signature"``, ``"two functions"``, ``"one name"``, ``"defaults"``, ``"not a placeholder"``.
    text
        What is wrong and the way out, as a sentence.
    names
        The functions and tokens concerned.
    """

    kind: str
    text: str
    names: tuple[str, ...]


class GraphError(EpypesError, ValueError):
    """A graph can't be built; ``findings`` holds every problem that was found."""

    def __init__(self, findings: Sequence[Finding]) -> None:
        self.findings = tuple(findings)
        super().__init__("\n".join(finding.text for finding in self.findings))


def nearest(name: object, known: Iterable[str]) -> str:
    """Return the known name that is most like this one; empty if none is."""
    return next(iter(difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.6)), "")


class UnknownName(EpypesError, KeyError):
    """A name that is not there, with the nearest one that is, or with other ``advice``."""

    def __init__(
        self, kind: str, name: object, known: Iterable[str], where: str = "in this graph", *, advice: str = ""
    ) -> None:
        self.kind, self.name, self.known, self.where = kind, name, tuple(known), where
        super().__init__(f"No {kind} {name!r} {where}.{advice or self._hint()}")

    def _hint(self) -> str:
        near = nearest(self.name, self.known)
        if near:
            return f" Did you mean {near!r}?"
        if not self.known:
            return " There is none."
        some = ", ".join(self.known[:12])
        return f" There are: {some}{', ...' if len(self.known) > 12 else ''}."


class NotComputed(EpypesError, KeyError):
    """A token that has no value: it was not computed, or the function that makes it failed."""

    def __init__(self, token: str, text: str) -> None:
        self.token = token
        super().__init__(text)


class StaleToken(NotComputed):
    """A token whose value is out of date, since something it depends on has changed."""

    def __init__(self, token: str) -> None:
        text = f"Token {token!r} is stale: something it depends on has changed."
        super().__init__(token, f"{text} Call rerun() first, or rerun({token!r}) for it alone.")


def require_mapping(what: str, given: object, of: str) -> None:
    """Raise TypeError unless this is a mapping; ``of`` says of what, as ``"by function name"``."""
    if not isinstance(given, Mapping):
        raise InvalidType(f"{what} must be a mapping {of}, such as a dict, not {type(given).__name__!r}.")


def run_call(tokens: Iterable[str]) -> str:
    """Return the call that gives these tokens as payload, for the way out of an error: ``run(image=...)``."""
    return f"run({', '.join(f'{token}=...' for token in tokens)})"


class PayloadError(OldNames, EpypesError, TypeError):
    """``run()`` was called with missing or with wrong tokens; ``tokens`` names them."""

    def __init__(self, tokens: Iterable[str], text: str) -> None:
        self.tokens = tuple(tokens)
        super().__init__(text)


class HyperparameterError(EpypesError, TypeError):
    """A token that can't be set as a hyperparameter."""

    def __init__(self, token: str, text: str) -> None:
        self.token = token
        super().__init__(text)


class IteratorRefused(EpypesError, TypeError):
    """A token's value is an iterator, which can be read only once; ``function`` made it, None if it was given."""

    def __init__(self, token: str, function: str | None, value: object) -> None:
        self.token, self.function = token, function
        kind = type(value)
        origin = f"made by function {function!r}" if function is not None else "which was given"
        way_out = f"Make it a list: list({token})." if token.isidentifier() else "Make it a list."
        if hasattr(kind, "read"):
            way_out = f"{way_out} Of a file, give the path, or the content."
        super().__init__(
            f"Token {token!r}, {origin}, is an iterator ({kind.__name__}). An iterator can be read only once, "
            f"but reruns and several functions read a token. {way_out}"
        )


class InputMutated(EpypesError, RuntimeError):
    """A function has changed an object inside its input, which ``check_mutation`` has found and put back.

    It can't put an iterator back that was read.
    """

    def __init__(self, function: str, token: str, *, has_read_iterator: bool = False) -> None:
        self.function, self.token = function, token
        if has_read_iterator:
            text = (
                f"Function {function!r} has read an iterator inside its input {token!r}, which can be read only once, "
                "but other functions and reruns read it. Make it a list where it is made."
            )
        else:
            text = (
                f"Function {function!r} has changed its input {token!r} in place, which other functions and reruns "
                "read. What it had changed was put back. Let it work on a copy, made with copy.deepcopy."
            )
        super().__init__(text)


class PlaceholderNeeded(EpypesError, NotImplementedError):
    """Functions that are placeholders would have to run; ``functions`` names them."""

    def __init__(self, functions: Iterable[str]) -> None:
        self.functions = tuple(functions)
        names = ", ".join(map(repr, self.functions))
        if len(self.functions) == 1:
            text = f"Function {names} is a placeholder. Give it: "
        else:
            text = (
                f"Functions {names} are placeholders. Give them: "
                if names
                else "A placeholder can't be called. Give it: "
            )
        first = repr(self.functions[0]) if self.functions else "name"
        super().__init__(f"{text}ep.extend(cg, {{{first}: ...}}).")


class OutputArityError(EpypesError, ValueError):
    """A function with n output tokens returned something else than n values."""

    def __init__(self, function: str, outputs: Sequence[str], got: str) -> None:
        self.function, self.outputs, self.got = function, tuple(outputs), got
        wanted = f"{len(self.outputs)} value{'s' if len(self.outputs) != 1 else ''} ({', '.join(self.outputs)})"
        super().__init__(f"Function {function!r} must return a tuple or list of {wanted}, but it returned {got}.")


class StateChanged(EpypesError, RuntimeError):
    """A function of a bundle changed an object, or a setting, that outlives the call; ``changed`` names it."""

    def __init__(self, function: str, changed: str, is_restored: bool, *, is_setting: bool = False) -> None:
        self.function, self.changed, self.is_restored = function, changed, is_restored
        became = (
            "It has been put back, so that no later event depends on it"
            if is_restored
            else "It can't be put back, so that every later event fails until the bundle is loaded again"
        )
        way_out = f"Change a copy of it. {keep_as_state(changed, is_object=not is_restored)}"
        if is_setting:
            way_out = "Have the function set it back before it returns, in a 'with' statement or in 'finally'"
        super().__init__(f"Function {function!r} changed {changed!r}, which outlives the call. {became}. {way_out}.")


class ContractBroken(EpypesError, ValueError):
    """A value is not the image that the annotation of a function says; ``made`` tells an output from an input."""

    def __init__(self, function: str, token: str, contract: Image, found: str, *, made: bool = False) -> None:
        self.function, self.token, self.contract, self.found, self.made = function, token, contract, found, made
        verb = "makes" if made else "takes"
        super().__init__(
            f"Function {function!r} {verb} token {token!r} as {contract}, but it is {found}. "
            "Convert it, or change the annotation."
        )


class StillRunning(EpypesError, TimeoutError):
    """Something did not stop in time; the functions that had not returned are named."""

    def __init__(self, name: str, functions: Sequence[str], timeout_s: float) -> None:
        self.name, self.functions, self.timeout_s = name, tuple(functions), timeout_s
        busy = f": still in {', '.join(map(repr, self.functions))}" if self.functions else ""
        super().__init__(f"{name!r} did not stop within {timeout_s:g} s{busy}. Its thread is a daemon.")


class MailboxOverflow(EpypesError):
    """A mailbox with policy ``"fault"`` was full."""

    def __init__(self, size: int) -> None:
        self.size = size
        super().__init__(f"The mailbox is full ({size}) and its policy is 'fault'. Take faster, or drop.")


def install_command(extra: str) -> str:
    """Return the command that installs what an extra brings, beside the EPypes that is here.

    Where EPypes is installed, pip and uv leave it and add what is missing. Where it runs from a folder with its source
    and is not installed, they would fetch another version: then the command names the folder.
    """
    from importlib import metadata
    from pathlib import Path

    source = Path(__file__).parents[1]
    try:
        metadata.distribution("epypes")
    except metadata.PackageNotFoundError:
        if (source / "pyproject.toml").exists():
            return f"pip install '{source}[{extra}]'"
    return f"pip install 'epypes[{extra}]'"


class MissingPackage(EpypesError, ModuleNotFoundError):
    """A package is not installed; ``extra`` names the extra of EPypes that brings it."""

    def __init__(self, package: str, extra: str, module: str | None = None) -> None:
        self.package, self.extra = package, extra
        super().__init__(f"Package {package!r} is missing. Run: {install_command(extra)}", name=module)


class SourceRefused(EpypesError):
    """A graph that can't be written as one Python function; ``reasons`` lists all of them."""

    def __init__(self, reasons: Sequence[str]) -> None:
        self.reasons = tuple(reasons)
        super().__init__("Not written:\n" + "\n".join(f"- {reason}" for reason in self.reasons))


class LayoutUnavailable(EpypesError):
    """No Graphviz engine could lay out a graph."""

    def __init__(self, tried: Sequence[str]) -> None:
        self.tried = tuple(tried)
        super().__init__(
            "No Graphviz engine answered, so the graph is not drawn. "
            f"Run: {install_command('graphviz')}. Tried: {'; '.join(self.tried)}."
        )


class ImageFileError(_PathError, OSError):
    """An image file that can't be read or written."""


class CameraUnavailable(EpypesError, OSError):
    """A camera that gives no frame just now; raised by its ``read``, it means: try again later.

    ``is_gone`` if it is known to be unplugged or switched off.
    """

    def __init__(self, camera: str, text: str, *, is_gone: bool = False) -> None:
        self.camera, self.is_gone = camera, is_gone
        super().__init__(text)


class FrameUnavailable(EpypesError, LookupError):
    """No frame is near enough to a time; Unix times in ns, those of frames None if there are none."""

    def __init__(self, requested_ns: int, oldest_ns: int | None, newest_ns: int | None, text: str) -> None:
        self.requested_ns, self.oldest_ns, self.newest_ns = requested_ns, oldest_ns, newest_ns
        super().__init__(text)


class MessageError(EpypesError, ValueError):
    """A message that can't be made or can't be understood; ``reason`` is a short word to count by."""

    def __init__(self, reason: str, text: str) -> None:
        self.reason = reason
        super().__init__(text)


class AddressError(EpypesError, OSError):
    """An address that can't be bound or connected to."""

    def __init__(self, address: str, text: str) -> None:
        self.address = address
        super().__init__(text)


class BrokerError(AddressError):
    """A broker that can't be reached, or refuses what is asked of it."""


class KeysError(_PathError, ValueError):
    """Keys can't be made, read or used."""


class RecordingError(_PathError, OSError):
    """A file of recorded messages that can't be written, or is not what it should be."""


class SettingsError(EpypesError):
    """Settings of hyperparameters that can't be written to a file or read from one; ``reasons`` lists all of them."""

    def __init__(self, path: object, reasons: Sequence[str]) -> None:
        self.path, self.reasons = str(path), tuple(reasons)
        listed = "".join(f"\n- {reason}" for reason in self.reasons)
        super().__init__(self.reasons[0] if len(self.reasons) == 1 else f"{path}:{listed}")


class BundleError(_PathError):
    """A bundle that is not what it says it is."""


class BundleChanged(BundleError):
    """A bundle with files that are not those of its manifest; all of them are named."""


class PromotionRefused(BundleError):
    """A graph that can't become a bundle; ``reasons`` lists all of them."""

    def __init__(self, path: object, reasons: Sequence[str]) -> None:
        self.reasons = tuple(reasons)
        super().__init__(path, "Not promoted:\n" + "\n".join(f"- {reason}" for reason in self.reasons))


class ReplayDiffers(BundleError):
    """A bundle that does not compute what was recorded; ``report`` has every difference."""

    def __init__(self, path: object, report: ReplayReport) -> None:
        self.report = report
        super().__init__(path, f"{path} does not compute what was recorded:\n{report}")


class ExperimentError(EpypesError):
    """The paper's experiment can't begin or go on; ``name`` is that of the node, the process or the option.

    ``printed`` is what a process that ended had written to its standard error.
    """

    def __init__(self, name: str, text: str, printed: str = "") -> None:
        self.name, self.printed = name, printed
        super().__init__(text)


class ServiceError(_PathError):
    """A service that can't be started or can't be called."""


class RemoteFailure(ServiceError):
    """A function, f_in or f_out that failed in the service while it worked on this call's event."""

    def __init__(self, path: object, function: str, exception: str, message: str) -> None:
        self.function, self.exception, self.message = function, exception, message
        super().__init__(path, f"Function {function!r} failed in the service: {exception}: {message}")


class RevisionConflict(ServiceError):
    """Parameters of a service that another client has changed meanwhile; ``current`` is what they are now."""

    def __init__(self, path: object, current: Parameters) -> None:
        self.current = current
        text = f"The parameters have been changed meanwhile: they have revision {current.revision} now."
        super().__init__(path, f"{text} Look at them, and change them again.")


class ParametersRefused(ServiceError):
    """Values that a running service does not take; none was changed. ``problems`` has a reason by token."""

    def __init__(self, path: object, problems: Mapping[str, str]) -> None:
        self.problems = dict(problems)
        super().__init__(path, "Nothing was changed. " + " ".join(self.problems.values()))


class DeployRefused(ServiceError):
    """A bundle that does not take the place of the one that is served, which goes on; ``reasons`` lists all of them."""

    def __init__(self, path: object, reasons: Sequence[str]) -> None:
        self.reasons = tuple(reasons)
        super().__init__(path, f"{path} is not deployed: {' '.join(self.reasons)}")


class ScaleError(EpypesError):
    """A set of images, settings or cases that can't be run as it was given."""


class ExecutorBroken(ScaleError):
    """An executor that can't do its jobs any more; ``done`` is how many outcomes had come."""

    def __init__(self, done: int, text: str) -> None:
        self.done = done
        super().__init__(text)


class StoreError(EpypesError):
    """A database that can't be opened, read or written; ``place`` is its path, or its URL without the password."""

    def __init__(self, place: str, text: str) -> None:
        self.place = place
        super().__init__(text)


class FailureNotKept(EpypesError):
    """A failure of a service, or the event that failed, can't be had any more, or was never kept."""

    def __init__(self, id: str, path: object, text: str) -> None:  # noqa: A002 - that is what it is called everywhere
        self.id, self.path = id, str(path)
        super().__init__(text)
