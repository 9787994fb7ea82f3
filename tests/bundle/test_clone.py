"""A clone of a graph computes the same, and leaves no trace in the user's nodes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.source.clone import clone_graph


def times(x, gain=2.0):
    return x * gain


def test_a_graph_of_functions_is_its_own_and_keeps_its_defaults():
    cg = ep.CompGraph.from_functions(times)
    assert clone_graph(cg) is cg
    node = ep.CompGraph.from_functions(ep.Node("times", times))
    assert clone_graph(node).functions["times"] is times
    assert dict(clone_graph(node).defaults) == {"gain": 2.0}


def test_what_a_pipeline_was_set_to_goes_along_and_what_was_unfrozen_stays_an_input():
    pipeline = ep.Pipeline("times", ep.CompGraph.from_functions(times), {"gain": 5.0}, workers=2, guard=False)
    cg = ep.CompGraph({"times": pipeline}, {"times": ("x", "y")})
    own = clone_graph(cg).functions["times"]
    assert own is not pipeline
    assert (own(3), own.runner.workers, own.runner.guard, pipeline.run_count) == (15.0, 2, False, 0)
    pipeline.runner.unfreeze("gain")
    cg = ep.CompGraph({"times": pipeline}, {"times": (("x", "gain"), "y")})
    assert clone_graph(cg).functions["times"](3, 4) == 12


def test_a_node_that_does_something_of_its_own_is_kept():
    class Louder(ep.Node):
        def compute(self, *args):
            return 2 * super().compute(*args)

    louder = Louder("times", times)
    cg = ep.CompGraph({"times": louder}, {"times": (("x", "gain"), "y")})
    assert clone_graph(cg).functions["times"] is louder


def lightened(image):
    return image + 1


@pytest.mark.slow
def test_a_nested_pipeline_without_guard_and_functions_that_write_into_their_inputs_are_promoted(tmp_path):
    inner = ep.Pipeline(
        "inner",
        ep.CompGraph(
            {"lightened": lightened, "draw": cv2.circle},
            {"lightened": ("image", "light"), "draw": (("light", "centre", "radius", "colour"), "drawn")},
        ),
        settings := {"centre": (4, 4), "radius": 2, "colour": 200},
        guard=False,
    )
    cg = ep.CompGraph(
        {"inner": inner, "again": cv2.circle},
        {"inner": ("image", "once"), "again": (("once", "centre", "radius", "colour"), "twice")},
    )
    runner = ep.CompGraphRunner(cg, {**settings, "centre": (8, 8)})
    image = np.zeros((12, 12), np.uint8)
    run = runner.run(image=image)
    ep.promote(runner, tmp_path / "drawing")
    loaded = ep.load(tmp_path / "drawing")
    assert np.array_equal(loaded.run(image=image)["twice"], run["twice"])
    assert not image.any()
    assert loaded.cg.functions["inner"].runner.guard is False
