"""What the front knows of a bundle without executing any of its code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epypes.bundle.manifest import SETTINGS, check_manifest
from epypes.bundle.settings import Settings, read_settings
from epypes.errors import BundleError
from epypes.service.parameters import entries_of


@dataclass(frozen=True, slots=True)
class BundleInfo:
    """A bundle whose manifest was checked.

    Attributes
    ----------
    path
        Its folder.
    digest
        Which state of it.
    settings
        The contents of its pipeline.toml.
    entries
        The hyperparameters there, with their ranges.
    """

    path: Path
    digest: str
    settings: Settings
    entries: Mapping[str, Mapping[str, Any]]


def read_bundle_info(path: str | Path) -> BundleInfo:
    """Read what the front must know of a bundle.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    folder = Path(path).resolve()
    digest = check_manifest(folder)
    settings = read_settings(folder / SETTINGS)
    found = BundleInfo(folder, digest, settings, entries_of(settings))
    # A promotion may have put another folder in its place meanwhile.
    if check_manifest(folder) != digest:
        raise BundleError(folder, f"{folder} was promoted anew while it was read. Try again.")
    return found


def differing_ports(before: Settings, after: Settings) -> list[str]:
    """Return the ports that differ from those of the bundle that is replaced: its peers would not understand them."""
    found = []
    for what in ("inputs", "outputs", "rgb"):
        had, has = sorted(getattr(before, what)), sorted(getattr(after, what))
        if had != has:
            text = f"its {what} are [{', '.join(has)}]; those of the bundle that is served are [{', '.join(had)}]"
            found.append(f"The bundle has other ports: {text}. Serve it as a service of its own.")
    return found
