"""Messages of ROS 2 as the events and answers of a bundle: an address with ``type=`` has one value per message.

A received value gets the name of the bundle's one input. What is published is an output that fits the type. The
samples of the bundle show whether both fit, before the service starts. A bundle with an f_in or f_out of its own may
make anything of a message, so that side is left as it is.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection
from dataclasses import replace
from urllib.parse import quote

from epypes.bundle.manifest import SAMPLES
from epypes.errors import AddressError, MessageError
from epypes.service.bundle_info import BundleInfo
from epypes.service.options import Options
from epypes.transport.address import Address, parse_address
from epypes.transport.peers.ros import ros_type_of
from epypes.wire import Envelope
from epypes.wire.samples import Sample, read_sample


def with_input_name(options: Options, bundle: BundleInfo) -> Options:
    """Return the options of a service, whose address of events names the bundle's input where it has messages of ROS 2.

    Raises
    ------
    AddressError
        The bundle has no input, several, another one or one of another kind than the messages; or the address of
        answers has messages of ROS 2 that can't hold them: its ``token`` is no output, or the outputs of no sample fit.
    """
    sub, pub, own = parse_address(options.sub), parse_address(options.pub), bundle.settings.own
    if "type" in pub.options and "f_out" not in own:
        _check_answers(pub, bundle)
    if "type" not in sub.options or "f_in" in own:
        return options
    inputs, token = bundle.settings.inputs, sub.options.get("token", "")
    if len(inputs) != 1:
        text = (
            f"{sub}: a message of ROS 2 is one value, and an event of {bundle.settings.name} has "
            f"{', '.join(map(repr, inputs)) or 'none'}. Send envelopes, over an address without type=; or promote the "
            "graph with an f_in that makes its inputs of one value."
        )
        raise AddressError(str(sub), text)
    _check_name(sub, token, inputs, "input")
    _check_events(sub, bundle)
    return options if token else replace(options, sub=f"{options.sub}&token={quote(inputs[0], safe='')}")


def _check_events(sub: Address, bundle: BundleInfo) -> None:
    ros, (token,) = ros_type_of(sub), bundle.settings.inputs

    def check(sample: Sample) -> None:
        ros.check_kind(token, sample.inputs[token])

    _check_samples(check, bundle, sub, "can't be the events")


def _check_answers(pub: Address, bundle: BundleInfo) -> None:
    token, outputs, rgb = pub.options.get("token", ""), bundle.settings.outputs, bundle.settings.rgb
    ros = ros_type_of(pub)
    _check_name(pub, token, outputs, "output")

    def check(sample: Sample) -> None:
        parts = {name: sample.outputs[name] for name in outputs if name in sample.outputs}
        ros.from_envelope(Envelope("answer", parts, rgb=[name for name in rgb if name in parts]), token)

    _check_samples(check, bundle, pub, "can't publish the answers")


def _check_samples(check: Callable[[Sample], object], bundle: BundleInfo, address: Address, wrong: str) -> None:
    """Raise AddressError if no sample fits; another one may be without a result."""
    refusal: MessageError | None = None
    for path in sorted((bundle.path / SAMPLES).glob("*.npz")):
        try:
            check(read_sample(path))
        except MessageError as error:
            refusal = refusal or error
        else:
            return
    if refusal is not None:
        text = f"{address} {wrong} of {bundle.settings.name}, by its samples: {refusal}"
        raise AddressError(str(address), text) from refusal


def _check_name(address: Address, token: str, names: Collection[str], kind: str) -> None:
    """Raise AddressError if an address names a token that is not among the bundle's inputs or outputs."""
    if token and token not in names:
        near = difflib.get_close_matches(token, names, n=1)
        way_out = f"Did you mean token={near[0]}?" if near else f"Write token={next(iter(names), '')}."
        raise AddressError(str(address), f"{address}: the bundle has no {kind} {token!r}. {way_out}")
