"""A bundle has the values that a notebook has set inside pipelines, and computes what the notebook computed."""

from __future__ import annotations

import tomllib
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction

import numpy as np
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.errors import PromotionRefused
from tests.bundle.test_slicer import notebook

CELL = """
import epypes as ep
import numpy as np
from typing import Annotated

def find(image, quality):
    return np.argwhere(image > quality)

def ransac(points, threshold: Annotated[float, ep.Param(0.1, 500)]):
    return points[np.abs(points - np.median(points, axis=0)).max(axis=1) < threshold]

def scale(inliers, camera):
    return inliers @ camera

inner = ep.CompGraph(
    {"find": find, "ransac": ransac, "scale": scale},
    {"find": (("image", "quality"), "points"), "ransac": (("points", "threshold"), "inliers"),
     "scale": (("inliers", "camera"), "scaled")},
)
geometry = ep.Pipeline("geometry", inner, {"quality": 200, "threshold": 40.0, "camera": np.eye(2)})

def count(shape):
    return len(shape)

cg = ep.CompGraph({"geometry": geometry, "count": count}, {"geometry": ("photo", "shape"), "count": ("shape", "n")})
runner = ep.CompGraphRunner(cg)
"""
IMAGE = np.random.default_rng(5).integers(0, 255, (80, 90), dtype=np.uint8)


@pytest.fixture
def cells():
    return notebook(CELL)


def changed(cells):
    cells["runner"].run(photo=IMAGE)
    return cells["runner"].rerun(geometry__threshold=12.5, geometry__camera=np.array([[2.0, 0.0], [0.0, 3.0]]))


@pytest.mark.slow
def test_a_bundle_computes_what_the_notebook_computed(cells, tmp_path):
    run = changed(cells)
    bundle = ep.promote(cells["runner"], tmp_path / "shapes", outputs=["shape", "n"])
    verify(tmp_path / "shapes")
    loaded = ep.load(tmp_path / "shapes")
    assert loaded["geometry__threshold"] == 12.5
    assert loaded["geometry__quality"] == 200, "as it is in the pipeline, which is in the module"
    again = loaded.run(photo=IMAGE)
    np.testing.assert_array_equal(again["shape"], run["shape"])
    assert again["n"] == run["n"] > 0
    assert len(cells["geometry"](IMAGE)) != run["n"], "the pipeline alone computes something else"
    assert set(bundle.settings.hyperparameters) == {"geometry__threshold", "geometry__camera"}
    written = tomllib.loads((tmp_path / "shapes" / "pipeline.toml").read_text())["hyperparameters"]
    assert written["geometry__threshold"] == {"value": 12.5, "low": 0.1, "high": 500}
    assert "# Taken by geometry__ransac." in (tmp_path / "shapes" / "pipeline.toml").read_text()


@pytest.mark.slow
def test_what_is_not_changed_stays_in_the_pipeline_alone(cells, tmp_path):
    cells["runner"].run(photo=IMAGE)
    cells["geometry"]["threshold"] = 20.0
    run = cells["runner"].rerun()
    bundle = ep.promote(cells["runner"], tmp_path / "shapes", outputs=["n"])
    assert dict(bundle.settings.hyperparameters) == {}
    assert ep.load(tmp_path / "shapes").run(photo=IMAGE)["n"] == run["n"]


@pytest.mark.slow
def test_a_value_that_a_bundle_can_not_hold_is_refused_by_its_name(cells, tmp_path):
    cells["runner"].run(photo=IMAGE)
    cells["runner"].rerun(geometry__threshold=Fraction(25, 2))
    with pytest.raises(PromotionRefused, match="'geometry__threshold'"):
        ep.promote(cells["runner"], tmp_path / "shapes", outputs=["n"])


def test_to_source_writes_the_values_that_the_runner_has(cells):
    run = changed(cells)
    names = {}
    exec(ep.to_source(cells["runner"], name="whole"), names)
    assert names["whole"](IMAGE) == run["n"]
    assert "threshold=12.5" in ep.to_source(cells["runner"])


def test_to_source_of_a_pipeline_with_two_values_writes_two_functions(cells):
    cg = ep.CompGraph(
        {"near": cells["geometry"], "far": cells["geometry"]}, {"near": ("photo", "a"), "far": ("photo", "b")}
    )
    runner = ep.CompGraphRunner(cg, {"near__threshold": 5.0, "far__threshold": 300.0})
    run, names = runner.run(photo=IMAGE), {}
    exec(ep.to_source(runner, name="both"), names)
    for made, token in zip(names["both"](IMAGE), ("a", "b"), strict=True):
        np.testing.assert_array_equal(made, run[token])
    assert len(run["a"]) < len(run["b"])


@pytest.mark.slow
def test_a_sweep_in_processes_is_the_sweep_of_the_notebook(cells):
    cells["runner"].run(photo=IMAGE)
    grid = {"geometry__threshold": [5.0, 12.5, 300.0]}
    here = ep.sweep(cells["runner"], grid).to_frame()["n"].tolist()
    with ProcessPoolExecutor(1) as pool:
        assert ep.sweep(cells["runner"], grid, executor=pool).to_frame()["n"].tolist() == here
        cells["runner"].rerun(geometry__quality=250)
        ep.map(cells["runner"], [IMAGE], executor=pool)
        cells["runner"].unfreeze("geometry__quality")
        assert ep.map(cells["runner"], [IMAGE], executor=pool).to_frame()["n"].tolist() == [
            cells["runner"].rerun()["n"]
        ], "a value of an earlier job is forgotten"
    assert len(set(here)) == 3
    assert cells["runner"]["geometry__threshold"] == 40.0
