"""Optional imports: a package that is not installed is named, with the extra that brings it.

Every package that EPypes imports, besides what the command line stands on, is in `EXTRAS`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from epypes.errors import MissingPackage

# By imported module: the package, and the smallest extra that brings it and is whole.
EXTRAS: Final[Mapping[str, tuple[str, str]]] = {
    "IPython": ("ipython", "widgets"),
    "PIL": ("pillow", "widgets"),
    "aio_pika": ("aio-pika", "rabbitmq"),
    "anywidget": ("anywidget", "widgets"),
    "av": ("av", "vision"),
    "cv2": ("opencv-python-headless", "vision"),
    "cyclonedds": ("cyclonedds", "dds"),
    "dask": ("dask", "cluster"),
    "distributed": ("distributed", "cluster"),
    "docstring_parser": ("docstring-parser", "widgets"),
    "fastapi": ("fastapi", "serve"),
    "google": ("protobuf", "serve"),
    "graphviz": ("graphviz", "graphviz"),
    "httpx": ("httpx", "serve"),
    "httpx_sse": ("httpx-sse", "serve"),
    "ipywidgets": ("ipywidgets", "widgets"),
    "jinja2": ("jinja2", "cpp"),
    "jupyter_client": ("jupyter-client", "service"),
    "jupyter_server": ("jupyter-server", "notebook"),
    "jupyterlab": ("jupyterlab", "notebook"),
    "matplotlib": ("matplotlib", "vision"),
    "mcap": ("mcap", "record"),
    "mcap_protobuf": ("mcap-protobuf-support", "record"),
    "nats": ("nats-py", "nats"),
    "nbclient": ("nbclient", "service"),
    "nbformat": ("nbformat", "service"),
    "networkx": ("networkx", "widgets"),
    "numpy": ("numpy", "widgets"),
    "opentelemetry": ("opentelemetry-api", "otel"),
    "optuna": ("optuna", "scale"),
    "paho": ("paho-mqtt", "mqtt"),
    "pandas": ("pandas", "scale"),
    "prometheus_client": ("prometheus-client", "serve"),
    "psycopg": ("psycopg", "postgres"),
    "pyarrow": ("pyarrow", "tables"),
    "pydantic": ("pydantic", "serve"),
    "pydantic_core": ("pydantic-core", "serve"),
    "pygraphviz": ("pygraphviz", "graphviz"),
    "pypylon": ("pypylon", "basler"),
    "rosbags": ("rosbags", "dds"),
    "scipy": ("scipy", "scale"),
    "skimage": ("scikit-image", "scale"),
    "sqlalchemy": ("sqlalchemy", "store"),
    "starlette": ("starlette", "serve"),
    "tomlkit": ("tomlkit", "serve"),
    "tqdm": ("tqdm", "scale"),
    "traitlets": ("traitlets", "widgets"),
    "uvicorn": ("uvicorn", "serve"),
    "viva_genicam": ("viva-genicam", "genicam"),
    "zenoh": ("eclipse-zenoh", "zenoh"),
    "zmq": ("pyzmq", "serve"),
}

# Packages that newer versions of Python have no wheel of: the first of these versions.
NO_WHEEL_FROM: Final[Mapping[str, tuple[int, int]]] = {"cyclonedds": (3, 14)}


class LazyModule:
    """A package that is imported when one of its names is first used: it may be missing, or take long to load.

    Raises
    ------
    MissingPackage
        The package is not installed; raised where a name is used.
    """

    def __init__(self, package: str) -> None:
        self._package = package

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # asked by those who look through a module, as doctest does
            raise AttributeError(name)
        with optional_import():
            found = getattr(importlib.import_module(self._package), name)
        setattr(self, name, found)
        return found


@contextmanager
def optional_import(extra: str = "") -> Iterator[None]:
    """Import packages of an extra inside this block; a missing one is named with the way out.

    Parameters
    ----------
    extra
        The extra to name, where it is not the smallest one that brings the package.

    Raises
    ------
    MissingPackage
        A package is not installed. What else fails while a module is imported is raised as it is.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = missing_package(error, extra)
        if missing is None or missing is error:
            raise
        raise missing from error


def missing_package(error: ModuleNotFoundError, extra: str = "") -> MissingPackage | None:
    """Return which package is missing; None if it is none that an extra brings."""
    if isinstance(error, MissingPackage):
        return MissingPackage(error.package, extra, error.name) if extra else error
    package, usual = EXTRAS.get((error.name or "").partition(".")[0], ("", ""))
    return MissingPackage(package, extra or usual, error.name) if package else None
