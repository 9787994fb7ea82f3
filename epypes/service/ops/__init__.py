"""Tools around a running service: calling it, checking a machine, and exporting a unit or a container."""
