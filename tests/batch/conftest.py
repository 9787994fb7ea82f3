"""Graphs, images and executors that tests of many images share."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import cv2
import numpy as np
import pytest
from skimage import data

import epypes as ep
from tests.bundle.cells import cell

SOURCE = """
import cv2
import numpy as np


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def count(edges):
    return np.int64((edges > 0).sum())


def corners(image_gray):
    return cv2.ORB_create(20).detect(image_gray)
"""


def counting_runner() -> ep.CompGraphRunner:
    """A graph of notebook functions, whose sinks are a number and keypoints."""
    made = cell(SOURCE)
    cg = ep.CompGraph(
        {"gray": made["gray"], "canny": cv2.Canny, "count": made["count"], "corners": made["corners"]},
        {
            "gray": ("image", "image_gray"),
            "canny": (("image_gray", "canny_lo", "canny_hi"), "edges"),
            "count": ("edges", "edge_pixels"),
            "corners": ("image_gray", "keypoints"),
        },
    )
    return ep.CompGraphRunner(cg, {"canny_lo": 70, "canny_hi": 200})


def runner_of(function: Any, *tokens: str, **hyperparameters: Any) -> ep.CompGraphRunner:
    """A runner of a graph with one function, whose token is ``out``."""
    return ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": (tokens, "out")}), hyperparameters)


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    return counting_runner()


@pytest.fixture(scope="session")
def crops() -> list[np.ndarray]:
    """Twelve parts of a real photograph, (100, 150, 3) BGR, uint8."""
    photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    return [photograph[y : y + 100, x : x + 150].copy() for y in (0, 100, 200) for x in (0, 150, 300, 450)]


@pytest.fixture
def folder(tmp_path, crops):
    """A folder of twelve images, ``crop0.png`` to ``crop11.png``, and a note."""
    path = tmp_path / "images"
    path.mkdir()
    for number, crop in enumerate(crops):
        cv2.imwrite(str(path / f"crop{number}.png"), crop)
    (path / "notes.txt").write_text("not an image")
    return path


@pytest.fixture(scope="session")
def processes():
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool
