"""Functions of OpenCV that write into their inputs get copies of these; other functions get them read-only."""

from __future__ import annotations

import functools
import queue

import cv2
import numpy as np
import pytest

import epypes as ep

SETTINGS = {"centre": (10, 10), "radius": 5, "colour": 255}
DRAWING = ep.CompGraph(
    {"draw": cv2.circle, "total": np.sum},
    {"draw": (("image", "centre", "radius", "colour"), "drawn"), "total": ("image", "total")},
)


def black():
    return np.zeros((24, 24), np.uint8)


@pytest.mark.parametrize("kind", [ep.CompGraphRunner, functools.partial(ep.Pipeline, "p")], ids=["runner", "pipeline"])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_function_that_draws_into_its_input_draws_into_a_copy(kind, workers):
    image, made = black(), kind(DRAWING, SETTINGS, workers=workers)
    for _ in range(8):  # compiled from the fourth run on
        run = made.run(image=image)
        assert np.array_equal(run["drawn"], cv2.circle(black(), (10, 10), 5, 255))
        assert run["total"] == 0
    assert not image.any()
    runner = getattr(made, "runner", made)
    for radius in range(1, 8):
        assert np.array_equal(runner.rerun(radius=radius)["drawn"], cv2.circle(black(), (10, 10), radius, 255))
    assert not runner.last["drawn"].flags.writeable


def test_what_was_drawn_does_not_change_when_it_is_drawn_into_again():
    cg = ep.CompGraph(
        {"first": cv2.circle, "second": cv2.circle},
        {
            "first": (("image", "centre", "radius", "colour"), "one"),
            "second": (("one", "centre", "radius_2", "colour"), "two"),
        },
    )
    run = ep.CompGraphRunner(cg, {**SETTINGS, "radius_2": 8}).run(image=black())
    assert run["one"].sum() < run["two"].sum()
    assert np.array_equal(run["one"], cv2.circle(black(), (10, 10), 5, 255))


def test_only_the_arguments_that_it_writes_into_are_copies():
    image, mask = np.full((8, 8), 7, np.uint8), np.zeros((10, 10), np.uint8)
    mask[5] = 1
    cg = ep.CompGraph(
        {"fill": cv2.floodFill}, {"fill": (("image", "mask", "seed", "value"), ("area", "filled", "reached", "box"))}
    )
    run = ep.CompGraphRunner(cg, {"seed": (0, 0), "value": 200}).run(image=image, mask=mask)
    assert run["area"] == 32, "the mask stops it in the middle"
    assert (run["filled"] == 200).sum() == 32
    assert (image == 7).all()
    assert mask.sum() == 10
    assert run["reached"].sum() > 10


def test_a_partial_has_its_remaining_arguments_copied():
    def into(image, **given):
        return ep.CompGraphRunner(
            ep.CompGraph({"fill": functools.partial(cv2.floodFill, *given.pop("args", ()), **given)}, {"fill": io})
        )

    io = (("image", "mask"), ("area", "filled", "reached", "box"))
    image = black()
    assert into(image, seedPoint=(1, 1), newVal=9).run(image=image, mask=None)["filled"].min() == 9
    assert not image.any()
    io = (("mask", "seed", "value"), ("area", "filled", "reached", "box"))
    mask = np.zeros((26, 26), np.uint8)
    run = into(image, args=(black(),)).run(mask=mask, seed=(1, 1), value=9)
    assert run["reached"].any()
    assert not mask.any()
    points = [cv2.KeyPoint(5, 5, 4)]
    cg = ep.CompGraph({"draw": functools.partial(cv2.drawKeypoints, black(), points)}, {"draw": ("canvas", "drawn")})
    canvas = np.zeros((24, 24, 3), np.uint8)
    assert ep.CompGraphRunner(cg).run(canvas=canvas)["drawn"].any()
    assert not canvas.any()


def test_arrays_in_a_list_that_is_written_into_are_copied_too():
    images = [black(), black()]
    cg = ep.CompGraph({"mix": cv2.mixChannels}, {"mix": (("sources", "targets", "pairs"), "mixed")})
    sources = [np.full((24, 24), 3, np.uint8), np.full((24, 24), 4, np.uint8)]
    run = ep.CompGraphRunner(cg).run(sources=sources, targets=images, pairs=[0, 1, 1, 0])
    assert [int(image[0, 0]) for image in run["mixed"]] == [4, 3]
    assert not np.any(images)


def test_a_calibration_refines_copies_of_the_matrices():
    camera = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
    grid = np.zeros((20, 3), np.float32)
    grid[:, :2] = np.mgrid[:5, :4].T.reshape(-1, 2)
    views = [
        cv2.projectPoints(grid, np.array([0.1 * n, 0.3 - 0.1 * n, 0]), np.array([-2.0, -1.5, 10.0 + n]), camera, None)[
            0
        ]
        for n in range(6)
    ]
    cg = ep.CompGraph(
        {"calibrate": cv2.calibrateCamera},
        {"calibrate": (("grids", "views", "size", "guess", "lens", "r", "t", "flags"), ("rms", "K", "d", "rs", "ts"))},
    )
    guess = camera * [[1.1], [1.1], [1]]
    before = guess.copy()
    run = ep.CompGraphRunner(
        cg, {"size": (320, 240), "flags": cv2.CALIB_USE_INTRINSIC_GUESS, "r": None, "t": None}
    ).run(grids=[grid] * 6, views=[view.astype(np.float32) for view in views], guess=guess, lens=np.zeros(5))
    assert run["rms"] < 0.1
    assert abs(run["K"][0, 0] - 400) < 5
    assert np.array_equal(guess, before)


def test_a_function_of_ones_own_that_draws_into_its_input_is_told_as_before():
    def draw(image, centre, radius, colour):
        return cv2.circle(image, centre, radius, colour)

    cg = ep.CompGraph({"draw": draw}, {"draw": (("image", "centre", "radius", "colour"), "drawn")})
    runner = ep.CompGraphRunner(cg, SETTINGS)
    with pytest.raises(cv2.error) as caught:
        runner.run(image=black())
    assert any("Inputs are read-only" in note for note in caught.value.__notes__)


def test_without_guard_a_function_writes_into_what_it_gets():
    image = black()
    run = ep.CompGraphRunner(DRAWING, SETTINGS, guard=False).run(image=image)
    assert run["drawn"] is image


def test_checking_for_changes_does_not_mistake_the_copy_for_one():
    image = black()
    run = ep.CompGraphRunner(DRAWING, SETTINGS, check_mutation=True).run(image=image)
    assert run["drawn"].any()
    assert not image.any()


def test_written_as_plain_python_it_gets_a_copy_too():
    source = ep.to_source(DRAWING, SETTINGS, returns=["drawn", "total"])
    namespace, image = {}, black()
    exec(source, namespace)
    drawn, total = namespace["run_graph"](image)
    assert (int(total), bool(drawn.any()), bool(image.any())) == (0, True, False)
    plain = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    assert "copy" not in ep.to_source(plain), "its buffer for the result is not given"


def paint(image):
    image[:] = 9
    return image


PAINTING = ep.CompGraph({"paint": paint}, {"paint": ("image", "painted")})
PIPELINES = {
    "Pipeline": lambda **options: ep.Pipeline("p", PAINTING, **options),
    "SourcePipeline": lambda **options: ep.SourcePipeline("p", PAINTING, queue.Queue(), dict, **options),
    "SinkPipeline": lambda **options: ep.SinkPipeline("p", PAINTING, queue.Queue(), dict, **options),
    "FullPipeline": lambda **options: ep.FullPipeline(
        "p", PAINTING, queue.Queue(), queue.Queue(), dict, dict, **options
    ),
}


@pytest.mark.parametrize("kind", PIPELINES)
def test_guard_false_lets_the_functions_of_a_pipeline_write_into_their_inputs(kind):
    image = black()
    with pytest.raises(ValueError, match="read-only"):
        PIPELINES[kind]().run(image=image)
    assert not image.any()
    pipe = PIPELINES[kind](guard=False)
    assert pipe.run(image=image)["painted"] is image
    assert image.min() == 9
