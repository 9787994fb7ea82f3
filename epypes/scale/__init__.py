"""Many inputs: maps, sweeps, checks and optimisation, on threads, processes or a cluster."""

from epypes.scale.mapping import MapResult
from epypes.scale.mapping import map_images as map  # noqa: A004 - as in ep.map(runner, images)

__all__ = ["MapResult", "map"]
