"""Verifying a running service: it answers the samples of a bundle, and the answers are compared with what was recorded.

The service may run anywhere and be in any language. No code of the bundle is executed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.manifest import SAMPLES, SETTINGS, check_manifest, environment
from epypes.bundle.proof.compare import Difference, difference, differences
from epypes.bundle.proof.replay import ReplayReport
from epypes.bundle.settings import read_settings
from epypes.errors import BundleError, ReplayDiffers, ServiceError, UnknownName
from epypes.service.ops.client import Answer, Client
from epypes.service.parameters import entries_of
from epypes.service.remote.connection import connect
from epypes.service.state_file import running_states
from epypes.transport.address import parse_address
from epypes.wire.samples import read_sample

if TYPE_CHECKING:
    from epypes.bundle.settings import Settings

# Of a digest, as commands print it.
_DIGITS: Final = 12
_NO_TOLERANCES: Final[Mapping[str, float]] = MappingProxyType({})


def verify_service(
    path: str | Path, sub: str, pub: str, *, tolerances: Mapping[str, float] = _NO_TOLERANCES, **options: Any
) -> ReplayReport:
    """Send the samples of a bundle to a running service, and compare its answers with what was recorded.

    Parameters
    ----------
    path
        The bundle's folder.
    sub, pub
        Where the service takes events, and where it publishes answers.
    tolerances
        By token the largest difference of a number that is accepted besides the tolerance of pipeline.toml.
    options
        ``timeout_s``, ``keys`` and ``allow``, as for `Client`.

    Raises
    ------
    ReplayDiffers
        The service computes something else, or the bundle has no samples; ``report`` has every difference.
    BundleError
        A file of the bundle was changed, or its samples can't be sent to a service.
    UnknownName
        There is a tolerance for a token that is not answered.
    ServiceError
        The service can't be reached, does not answer in time, or has other tokens.
    RemoteFailure
        A function failed on a sample.
    """
    folder = Path(path).resolve()
    bundle_digest = check_manifest(folder)
    settings = read_settings(folder / SETTINGS)
    for token in tolerances:
        if token not in settings.outputs:
            raise UnknownName("output token", token, settings.outputs, "in this bundle")
    _check_sendable(folder, settings)
    samples = sorted((folder / SAMPLES).glob("*.npz"))
    found: list[Difference] = []
    within: dict[str, float] = {}
    answer: Answer | None = None
    with Client(path, sub=sub, pub=pub, **options) as client:
        for file in samples:
            sample = read_sample(file)
            answer = client.call(sample.inputs)
            tokens = answer.tokens
            if tokens.keys() != sample.outputs.keys():
                answered, recorded = (", ".join(names) or "nothing" for names in (tokens, sample.outputs))
                causes = _causes(path, bundle_digest, settings, answer, pub)
                text = f"The service at {parse_address(sub)} answers with {answered}, and {path} has recorded"
                raise ServiceError(path, " ".join([f"{text} {recorded}.", *(causes or ["Does it serve this bundle?"])]))
            for token, expected in sample.outputs.items():
                places = [*differences(expected, tokens[token], settings.tolerances.get(token))]
                accepted = [each for each in places if _is_within(each, tolerances.get(token))]
                if accepted:
                    within[token] = max(within.get(token, 0.0), *(each.largest or 0.0 for each in accepted))
                left = difference(file.stem, token, (each for each in places if each not in accepted))
                found += [] if left is None else [left]
    notes = [
        f"{token!r} differs by at most {largest:g}, which --tolerance {token}={tolerances[token]:g} accepts."
        for token, largest in within.items()
    ]
    count = len(samples) * len(settings.outputs)
    report = ReplayReport(len(samples), count, tuple(found), environment=environment(), notes=notes)
    if not report.identical:
        causes = [] if answer is None else _causes(path, bundle_digest, settings, answer, pub)
        raise ReplayDiffers(path, replace(report, causes=causes))
    return report


def _is_within(found: Difference, tolerance: float | None) -> bool:
    return tolerance is not None and found.largest is not None and found.largest <= tolerance


def _causes(path: str | Path, bundle_digest: str, settings: Settings, answer: Answer, pub: str) -> list[str]:
    """Return why the answers of a service may differ from the samples: another bundle, or changed hyperparameters."""
    found = []
    if answer.bundle_digest not in ("", bundle_digest):
        served, here = answer.bundle_digest[:_DIGITS], bundle_digest[:_DIGITS]
        found.append(f"The service serves another bundle ({served}); {path} is {here}.")
    changed = _changed_values(settings, pub) if answer.revision else []
    if changed is None:
        found.append(f"The service is at revision {answer.revision}: its hyperparameters may have been changed.")
    elif changed:
        found.append(f"The service is at revision {answer.revision}: {', '.join(changed)}.")
    return found


def _changed_values(settings: Settings, pub: str) -> list[str] | None:
    """Return the values in which a service of this user differs from the bundle; None without its HTTP control."""
    url = next((state.http for state in running_states() if state.pub == pub), "")
    if not url:
        return None
    try:
        with connect(url) as connection:
            now = connection.parameters().entries
    except ServiceError:
        return None
    return [
        f"{name} is {now[name]['value']!r:.60}, in the bundle {entry['value']!r:.60}"
        for name, entry in entries_of(settings).items()
        if name in now and now[name]["value"] != entry["value"]
    ]


def _check_sendable(folder: Path, settings: Settings) -> None:
    """Refuse a bundle whose samples are not all that an event is, or that an answer depends on."""
    if settings.states:
        states = ", ".join(map(repr, settings.states))
        text = f"{folder} has state between events ({states}): a running service goes on from its own, not from that"
        raise BundleError(folder, f"{text} of the samples. Verify the bundle itself.")
    if settings.own:
        own = ", ".join(settings.own)
        text = f"{folder} has a {own} of its own, so a sample is no event or no answer. Verify the bundle itself."
        raise BundleError(folder, text)
