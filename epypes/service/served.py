"""Which bundle is served? What the front knows of one without executing any of its code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epypes.bundle.load import SETTINGS
from epypes.bundle.seal import check_seal
from epypes.bundle.settings import Settings, read_settings
from epypes.errors import BundleError
from epypes.service.parameters import read_entries


@dataclass(frozen=True, slots=True)
class Served:
    """A bundle whose seal was checked.

    Attributes
    ----------
    path
        Its folder.
    digest
        Which state of it.
    settings
        What its pipeline.toml says.
    entries
        The hyperparameters there, with their ranges.
    """

    path: Path
    digest: str
    settings: Settings
    entries: Mapping[str, Mapping[str, Any]]


def read_served(path: str | Path) -> Served:
    """Read what the front must know of a bundle.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    folder = Path(path).resolve()
    digest = check_seal(folder)
    served = Served(folder, digest, read_settings(folder / SETTINGS), read_entries(folder / SETTINGS))
    # A promotion may have put another folder in its place meanwhile.
    if check_seal(folder) != digest:
        raise BundleError(folder, f"{folder} was promoted anew while it was read. Try again.")
    return served


def differing_ports(before: Settings, after: Settings) -> list[str]:
    """Return what a bundle has otherwise than the one whose place it shall take: its peers would not understand it."""
    found = []
    for what in ("inputs", "outputs", "rgb"):
        had, has = sorted(getattr(before, what)), sorted(getattr(after, what))
        if had != has:
            told = f"its {what} are [{', '.join(has)}]; those of the bundle that is served are [{', '.join(had)}]"
            found.append(f"The bundle has other ports: {told}. Serve it as a service of its own.")
    return found
