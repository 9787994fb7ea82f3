"""Many inputs: maps, sweeps, checks and optimisation, on threads, processes or a cluster."""

from epypes.batch.mapping import MapResult
from epypes.batch.mapping import map_images as map  # noqa: A004 - as in ep.map(runner, images)

__all__ = ["MapResult", "map"]
