"""The table and the images that tests of the experiment share."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import pandas as pd
import pytest


@pytest.fixture
def measured() -> pd.DataFrame:
    """A table as the experiment's, of 3 experiments with 100 requests each, drawn by lot."""
    lot = np.random.default_rng(2019)
    table = pd.DataFrame({"experiment": np.repeat([0, 1, 2], 100), "request": np.tile(np.arange(100), 3)})
    table["id"] = [f"{row.experiment}-{row.request}" for row in table.itertuples()]

    def times(median: float) -> np.ndarray:
        return median * lot.lognormal(0, 0.2, len(table))

    for part, t_p in (("vision", 18e-3), ("acquisition", 50e-6)):
        for name, median in {"t_p": t_p, "o_cg": 14e-6, "t_fin": 3e-6, "t_fout": 40e-6, "o_epypes": 6e-6}.items():
            table[f"{part}.{name}"] = times(median)
        table[f"{part}.t_rp"] = sum(table[f"{part}.{name}"] for name in ("t_p", "t_fin", "t_fout", "o_epypes"))
    table["o_network"] = times(0.4e-3)
    table["t_trip"] = table["acquisition.t_rp"] + table["vision.t_rp"] + table["o_network"]
    table["failure"] = ""
    return table


@pytest.fixture
def fail() -> Callable[..., pd.DataFrame]:
    """Give a copy of a table in which some requests failed, so that they have no times."""

    def failed(table: pd.DataFrame, *rows: int) -> pd.DataFrame:
        spoilt = table.copy()
        spoilt.loc[list(rows), "failure"] = "FrameUnavailable: the request is older than the ring"
        times = [name for name in spoilt if name not in ("experiment", "request", "id", "failure")]
        spoilt.loc[list(rows), times] = math.nan
        return spoilt

    return failed


@pytest.fixture(scope="session")
def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Two equal small images with corners, gray."""
    lot = np.random.default_rng(13)
    picture = cv2.resize(lot.integers(0, 256, (16, 20), np.uint8), (160, 128), interpolation=cv2.INTER_NEAREST)
    return picture, picture.copy()


@pytest.fixture(scope="session")
def images(pictures, tmp_path_factory) -> tuple[str, str]:
    """The files of both."""
    folder = tmp_path_factory.mktemp("images")
    files = (str(folder / "left.png"), str(folder / "right.png"))
    for file, picture in zip(files, pictures, strict=True):
        assert cv2.imwrite(file, picture)
    return files
