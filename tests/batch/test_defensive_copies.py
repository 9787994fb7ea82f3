"""A value that is given is computed as it was then, whatever its owner does with it afterwards."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import epypes as ep
from tests.batch.conftest import runner_of

LEVELS = [float(level) for level in range(12)]


def refilled(wrapped=lambda image: image):
    """Frames as a camera's driver gives them: the same memory, each time with another content."""
    frame = np.zeros((400, 400))
    for level in range(12):
        frame[:] = level
        yield wrapped(frame)


def mean(image):
    return float(np.asarray(image).mean())


WRAPPED = {
    "arrays": lambda image: image,
    "views": lambda image: image[::2, ::2],
    "by token": lambda image: {"image": image},
    "tuples": lambda image: {"image": (image, image)},
    "lists": lambda image: {"image": [image]},
    "masked arrays": lambda image: np.ma.masked_array(image),
}


@pytest.mark.slow
@pytest.mark.parametrize("wrapped", WRAPPED.values(), ids=WRAPPED)
@pytest.mark.parametrize("threads", [0, 2])
def test_a_generator_may_fill_one_array_again_and_again(wrapped, threads, tmp_path):
    runner = runner_of(mean, "image")
    with ThreadPoolExecutor(2) as pool:
        executor = pool if threads else None
        for how in ({}, {"keep": ["image"]}, {"store": tmp_path / "r.sqlite"}):
            found = ep.map(runner, refilled(wrapped), executor, **how)
            assert [one.values["out"] for one in found] == LEVELS
            assert [mean(one.kept["image"]) for one in found if one.kept] == (LEVELS if "keep" in how else [])
    images = [wrapped(np.full((400, 400), level)) for level in LEVELS]
    assert [one.values["out"] for one in ep.map(runner, images, store=tmp_path / "r.sqlite")] == LEVELS


@pytest.mark.slow
def test_processes_get_what_was_given(processes):
    assert [one.values["out"] for one in ep.map(runner_of(mean, "image"), refilled(), processes)] == LEVELS


def test_sweeps_checks_and_searches_get_what_was_given():
    runner = runner_of(lambda image, gain: float(image.mean() * gain), "image", "gain", gain=2)
    expected = [2 * level for level in LEVELS]
    with ThreadPoolExecutor(2) as pool:
        assert [one.values["out"] for one in ep.sweep(runner, {"gain": [2]}, refilled(), pool)] == expected
    labels = iter(expected)
    cases = (ep.Case(image, {"out": next(labels)}) for image in refilled())
    assert ep.check(runner, cases).passed
    by_token = ({"image": image} for image in refilled())
    assert ep.optimize(runner, "out", by_token, 1, ranges={"gain": [2]}).best_value == sum(expected) / 12


def test_arrays_of_a_list_are_not_copied():
    images = [np.zeros((3, 3)), np.ones((3, 3))]
    assert all(
        map(
            np.shares_memory,
            (one.kept["image"] for one in ep.map(runner_of(mean, "image"), images, keep=["image"])),
            images,
        )
    )


@pytest.mark.parametrize("threads", [0, 2])
def test_a_change_of_the_runner_meanwhile_changes_nothing_that_is_computed_or_stored(threads, tmp_path):
    table = np.ones(3)
    runner = runner_of(lambda image, gain, tables: float(gain + tables[0].sum()), "image", "gain", "tables")
    runner.freeze(gain=1, tables=(table,))

    class Counted(list):
        """Images that are counted just when somebody turns a slider."""

        def __len__(self):
            runner.freeze(gain=2)
            table[:] = 9
            return super().__len__()

    images = Counted([np.zeros((3, 3))] * 3)
    with ThreadPoolExecutor(2) as pool:
        found = ep.map(runner, images, pool if threads else None, store=tmp_path / "r.sqlite")
    assert [one.values["out"] for one in found] == [4.0] * 3
    runner.freeze(gain=1, tables=(np.ones(3),))
    assert [one.values["out"] for one in ep.map(runner, [np.zeros((3, 3))] * 3, store=tmp_path / "r.sqlite")] == [
        4.0
    ] * 3


def test_a_change_of_the_runner_during_a_sweep_or_a_check_changes_nothing():
    runner = runner_of(lambda image, gain, table: float(gain + table.sum()), "image", "gain", "table")

    def frames():
        for _ in range(3):
            yield {"image": np.zeros((3, 3))}
            runner.freeze(gain=7)
            table[:] = 9

    table = np.ones(3)
    runner.freeze(gain=1, table=table)
    found = ep.sweep(runner, {"gain": [1, 2]}, frames())
    assert [one.values["out"] for one in found] == [4.0, 5.0] * 3
    assert found.runner is runner
    table = np.ones(3)
    runner.freeze(gain=1, table=table)
    assert ep.check(runner, (ep.Case(frame, {"out": 4.0}) for frame in frames())).passed
