"""Which bundle is served? What the front knows of one without executing any of its code."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.bundle.load import SETTINGS
from epypes.bundle.seal import check_seal
from epypes.bundle.settings import Settings, read_settings
from epypes.errors import BundleError, ServiceError
from epypes.service.parameters import read_entries

MOST_THREADS: Final = 64


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


def check_limits(path: str | Path, threads: int, job_timeout_s: float, drain_timeout_s: float) -> None:
    """Raise ServiceError for what a bundle can't be served with."""
    if not 1 <= threads <= MOST_THREADS:
        text = f"A service works on 1 to {MOST_THREADS} events at once, not on {threads}."
        raise ServiceError(path, text)
    if not (math.isfinite(job_timeout_s) and job_timeout_s > 0):
        text = f"An event may take a number of seconds above 0, not {job_timeout_s}. For one that takes long: 3600."
        raise ServiceError(path, text)
    if not (math.isfinite(drain_timeout_s) and drain_timeout_s >= 0):
        raise ServiceError(path, f"Draining takes a number of seconds from 0, not {drain_timeout_s}.")


def differing_ports(before: Settings, after: Settings) -> list[str]:
    """Return what a bundle has otherwise than the one whose place it shall take: its peers would not understand it."""
    found = []
    for what in ("inputs", "outputs", "rgb"):
        had, has = sorted(getattr(before, what)), sorted(getattr(after, what))
        if had != has:
            told = f"its {what} are [{', '.join(has)}]; those of the bundle that is served are [{', '.join(had)}]"
            found.append(f"The bundle has other ports: {told}. Serve it as a service of its own.")
    return found
