"""Black and white are the same values in the picture of a graph and on a panel."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.display import encode_image, view
from epypes_widgets.picture.frames import picture


def steps(*values: float, dtype: str = "float64") -> np.ndarray:
    """Return an image of broad stripes of these values, which JPEG keeps."""
    return np.repeat(np.array(values, dtype), 32)[None].repeat(64, axis=0)


def levels(data: bytes, count: int) -> list[int]:
    """Return the brightness of each stripe of an encoded picture."""
    row = np.asarray(Image.open(io.BytesIO(data)).convert("L"))[-8]
    width = len(row) // count
    return [int(row[index * width + width // 2]) for index in range(count)]


def runner() -> ep.CompGraphRunner:
    return ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x.copy()}, {"f": ("x", "y")}))


def detail(run: ep.Run) -> str:
    return next(token.preview.detail for token in view(run).tokens if token.name == "y")


def shown(run: ep.Run, count: int) -> list[int]:
    """Return the brightness of each stripe, which panel and thumbnail must agree about."""
    thumbnail = next(token.preview.picture.data for token in view(run).tokens if token.name == "y")
    found = levels(thumbnail, count)
    assert levels(picture(run, "y", "main")[1], count) == pytest.approx(found, abs=4)
    return found


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (steps(10, 128, 250, dtype="uint8"), (10, 128, 250)),
        (steps(0.0, 0.5, 1.0), (0, 127, 255)),
        (steps(0.2, 0.4, 0.6), (51, 102, 153)),
        (steps(-31, 0, 31, dtype="int16"), (0, 127, 255)),
        (steps(0, 0, 31, dtype="int16") - steps(10, 0, 0, dtype="int16"), (86, 127, 255)),
        (steps(10.0, 20.0, 30.0), (0, 127, 255)),
        (steps(0, 2048, 4095, dtype="uint16"), (0, 128, 255)),
        (steps(0, 512, 1016, dtype="uint16") + (np.arange(64, dtype="uint16") % 8)[:, None], (1, 129, 254)),
        (steps(0, 30_000, 60_000, dtype="uint16"), (0, 117, 234)),
        (steps(-1e308, 0, 1e308), (0, 127, 255)),
        (steps(0, np.nan, 1), (0, 0, 255)),
        (steps(0, -np.inf, np.inf), (0, 0, 255)),
        (steps(10**9, 10**9 + 5, 10**9 + 10), (0, 127, 255)),
    ],
    ids=lambda value: str(getattr(value, "dtype", value)),
)
def test_every_kind_of_number_has_its_range(image, expected):
    assert levels(encode_image(image).data, 3) == pytest.approx(expected, abs=4)


def test_a_range_is_kept_so_that_a_darker_frame_is_darker():
    ours = runner()
    assert shown(ours.run(x=steps(-20, 0, 20, dtype="int32")), 3) == pytest.approx([0, 127, 255], abs=4)
    assert shown(ours.run(x=steps(-10, 0, 10, dtype="int32")), 3) == pytest.approx([64, 127, 191], abs=4)
    assert "shown from -20 to 20" in detail(ours.last)


def test_values_beyond_the_kept_range_are_clipped():
    ours = runner()
    ours.run(x=steps(0, 1000, 4000, dtype="uint16"))
    view(ours.last)
    assert shown(ours.run(x=steps(0, 2048, 60_000, dtype="uint16")), 3) == pytest.approx([0, 128, 255], abs=4)
    assert "shown from 0 to 4095" in detail(ours.last)


def test_the_panel_decides_for_the_picture_where_it_was_first():
    ours = runner()
    picture(ours.run(x=steps(0.0, 50.0, 100.0)), "y", "main")
    assert shown(ours.run(x=steps(0.0, 10.0, 20.0)), 3) == pytest.approx([0, 25, 51], abs=4)


def test_an_image_of_one_value_decides_nothing():
    ours = runner()
    view(ours.run(x=steps(0, 0, 0, dtype="int32")))
    view(ours.run(x=steps(0, 0, 0, dtype="uint16")))
    assert shown(ours.run(x=steps(-20, 0, 20, dtype="int32")), 3) == pytest.approx([0, 127, 255], abs=4)
    assert shown(ours.run(x=steps(0, 2048, 4095, dtype="uint16")), 3) == pytest.approx([0, 128, 255], abs=4)


def test_an_image_of_one_value_is_shown_in_the_range_that_was_kept():
    ours = runner()
    view(ours.run(x=steps(-20, 0, 20, dtype="int32")))
    assert shown(ours.run(x=steps(10, 10, 10, dtype="int32")), 3) == pytest.approx([191, 191, 191], abs=4)


def test_another_dtype_has_another_range():
    ours = runner()
    view(ours.run(x=steps(0, 2048, 4095, dtype="uint16")))
    assert shown(ours.run(x=steps(0.0, 0.5, 1.0)), 3) == pytest.approx([0, 127, 255], abs=4)


@pytest.mark.parametrize("which", ["runner", "run", "pipeline"])
def test_ranges_can_be_reset(which):
    pipe = ep.Pipeline("copy", runner().cg)
    pipe.run(x=steps(0.0, 50.0, 100.0))
    view(pipe.runner)
    ep.reset_display_ranges({"runner": pipe.runner, "run": pipe.runner.last, "pipeline": pipe}[which])
    pipe.run(x=steps(0.0, 10.0, 20.0))
    assert shown(pipe.runner.last, 3) == pytest.approx([0, 127, 255], abs=4)


def test_a_runner_keeps_its_ranges_for_itself():
    ours, theirs = runner(), runner()
    view(ours.run(x=steps(0.0, 50.0, 100.0)))
    assert shown(theirs.run(x=steps(0.0, 10.0, 20.0)), 3) == pytest.approx([0, 127, 255], abs=4)


def test_what_has_no_ranges_is_refused_and_a_runner_without_a_run_has_none():
    ours = runner()
    ep.reset_display_ranges(ours)
    for wrong in (3, None, ours.cg, ours.plan(), ours.run(x=steps(1)).report, ours.last.hyperparameters):
        with pytest.raises(TypeError, match="A runner, a run or a pipeline"):
            ep.reset_display_ranges(wrong)


def test_ranges_of_hyperparameters_are_kept_and_reset_too():
    ours = ep.CompGraphRunner(ep.CompGraph({"f": lambda k: 0}, {"f": ("k", "y")}), {"k": steps(0.0, 50.0, 100.0)})
    seen = lambda: next(token.preview.detail for token in view(ours).tokens if token.name == "k")  # noqa: E731
    ours.run()
    assert "shown from 0 to 100" in seen()
    ours["k"] = steps(0.0, 10.0, 20.0)
    ours.run()
    assert "shown from 0 to 100" in seen()
    ep.reset_display_ranges(ours)
    assert "shown from 0 to 20" in seen()
