"""May others talk to this socket? What an address, keys and a list of allowed keys mean together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from epypes.errors import KeysError
from epypes.transport.addresses import check_bind
from epypes.transport.gate import Gate
from epypes.transport.keys import Keys, Options, PublicKey, client_options, public_keys, read_keys, server_options


@dataclass(frozen=True, slots=True)
class Security:
    """What a publisher or subscriber knows of itself and its peers.

    Attributes
    ----------
    keys
        Its own pair; None to go without.
    allowed
        Public keys of its peers: those that may connect if it is bound, the one that it connects to otherwise.
    bind
        Whether it is bound.
    refused
        How often peers were refused, by their public key.
    """

    keys: Keys | None
    allowed: frozenset[str]
    bind: bool
    refused: Counter[str] = field(default_factory=Counter)

    def gate(self) -> Gate | None:
        """Return a new gate for a socket that is bound with keys."""
        return Gate(self.allowed, self.refused) if self.bind and self.keys is not None else None

    def options(self, gate: Gate | None) -> Options:
        """Return ZeroMQ's options for a socket."""
        if self.keys is None:
            return ()
        if gate is not None:
            return server_options(self.keys, gate.domain)
        (server,) = self.allowed
        return client_options(self.keys, server)


def security(
    address: str,
    bind: bool,
    insecure: bool,
    keys: Keys | str | Path | None,
    allow: PublicKey | Collection[PublicKey] | None,
) -> Security:
    """Return what was asked for, if it can be.

    Raises
    ------
    AddressError
        If an address that other machines can reach is to be bound without keys, and not ``insecure``.
    KeysError
        If keys can't be read, or nobody is allowed.
    """
    if bind:
        check_bind(address, insecure or keys is not None)
    if keys is None:
        if allow is not None:
            raise KeysError(
                "", f"allow= was given for {address}, but no keys. Give keys= as well: make_keys makes them."
            )
        return Security(None, frozenset(), bind)
    own = keys if isinstance(keys, Keys) else read_keys(keys)
    if allow is None:
        raise KeysError(
            "", f"Keys were given for {address}, but not whose are allowed. Give the peers' .key files: allow="
        )
    allowed = public_keys(allow)
    if not bind and len(allowed) != 1:
        text = f"{address} is connected to, so allow= must be the public key of the one that is bound there."
        raise KeysError("", f"{text} {len(allowed)} were given.")
    return Security(own, allowed, bind)
