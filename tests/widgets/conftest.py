"""Which runner do the panels of these tests have?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes_widgets import Panel, tune
from tests.calls import Calls


def brighten(image: Any, gain: int) -> Any:
    return np.clip(image.astype(np.int32) * gain, 0, 255).astype(np.uint8)


def above(image_bright: Any, threshold: int) -> Any:
    if threshold == 13:
        raise ValueError("13 is not a threshold")
    return np.where(image_bright > threshold, 255, 0).astype(np.uint8)


@pytest.fixture
def calls() -> Calls:
    return Calls()


@pytest.fixture
def image() -> Any:
    return np.arange(64 * 48, dtype=np.uint32).reshape(48, 64).astype(np.uint8)


@pytest.fixture
def runner(calls: Calls, image: Any) -> ep.CompGraphRunner:
    """gain -> brighten -> threshold -> above -> mask, run once."""
    cg = ep.CompGraph(
        {"brighten": calls.of(brighten), "above": calls.of(above)},
        {"brighten": (("image", "gain"), "image_bright"), "above": (("image_bright", "threshold"), "mask")},
    )
    runner = ep.CompGraphRunner(cg, {"gain": 2, "threshold": 100})
    runner.run(image=image)
    calls.clear()
    return runner


@pytest.fixture
def panel(runner: ep.CompGraphRunner) -> Iterator[Panel]:
    panel = tune(runner, gain=(1, 5), threshold=(0, 255))
    yield panel
    panel.close(10)
