"""Many inputs: maps, sweeps, checks and optimisation, on threads, processes or a cluster."""
