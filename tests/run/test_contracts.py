"""An image that is not what a function's annotation says stops the run at that function, however it is run."""

from __future__ import annotations

import queue
from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import ContractBroken, NotComputed

GRAY = ep.Image("uint8", ("h", "w"))
UNIT = ep.Image("float64", range=(0, 1))


class Calls:
    """A graph that counts the calls of ``smooth``, whose input and output are gray images."""

    def __init__(self):
        self.count = 0

        def smooth(image: Annotated[np.ndarray, GRAY], k: float) -> Annotated[np.ndarray, GRAY]:
            self.count += 1
            return image // 2 if k == int(k) else image / k

        self.cg = ep.CompGraph(
            {"shift": lambda raw: raw + 1, "smooth": smooth, "total": lambda smoothed: int(smoothed.sum())},
            {"shift": ("raw", "image"), "smooth": (("image", "k"), "smoothed"), "total": ("smoothed", "sum")},
        )


def image(dtype=np.uint8, value=9):
    return np.full((2, 3), value, dtype)


def test_an_input_that_breaks_the_contract_is_refused_before_the_function_is_called(way):
    calls = Calls()
    runner = way.runner(calls.cg, {"k": 2})
    runs = [runner.run(raw=image()) for _ in range(way.runs)]
    with (
        way.is_taken(),
        pytest.raises(
            ContractBroken, match=r"'smooth' takes token 'image' as uint8 \(h, w\), but it is float64 2 x 3"
        ) as error,
    ):
        runner.run(raw=image(np.float64, 4))
    told = error.value
    assert (told.function, told.token, told.contract, told.made) == ("smooth", "image", GRAY, False)
    assert told.__notes__ == ["In function 'smooth': (image: float64 2 x 3, k=2) -> (smoothed)"]
    assert calls.count == way.runs
    failed = runner.last
    assert (failed.failure.function, failed.failure.exception) == ("smooth", told)
    assert failed.report.ran == ("shift", "smooth")
    assert failed["image"].tolist() == [[5] * 3] * 2, "what came before is kept"
    for token in ("smoothed", "sum"):
        with pytest.raises(NotComputed, match="since smooth: ContractBroken"):
            failed[token]
    assert all(run["sum"] == 6 * 5 for run in runs), "earlier runs are as they were"
    assert runner.run(raw=image())["sum"] == 6 * 5


def test_an_output_that_breaks_the_contract_fails_the_function_that_made_it(way):
    calls = Calls()
    runner = way.runner(calls.cg, {"k": 2})
    before = runner.run(raw=image())
    for k in range(way.runs):
        runner.rerun(k=k)
    with (
        way.is_taken(),
        pytest.raises(
            ContractBroken, match=r"'smooth' makes token 'smoothed' as uint8 \(h, w\), but it is float64"
        ) as error,
    ):
        runner.rerun(k=2.5)
    assert (error.value.function, error.value.token, error.value.made) == ("smooth", "smoothed", True)
    assert runner.stale == ("smooth", "total")
    assert runner["image"].tolist() == image(value=10).tolist()
    for token in ("smoothed", "sum"):
        with pytest.raises(NotComputed, match="since smooth: ContractBroken"):
            runner[token]
    assert before["sum"] == 6 * 5
    run = runner.rerun(k=3)
    assert (run["sum"], run.report.reused) == (6 * 5, ("shift",))


@pytest.mark.parametrize("bad", ["low", "high"])
def test_each_of_several_outputs_keeps_its_own_contract(way, bad):
    def ends(x) -> tuple[Annotated[np.ndarray, GRAY], Annotated[np.ndarray, UNIT]]:
        low = image(np.int64 if x == "low" else np.uint8)
        return low, image(np.float64, 2.0 if x == "high" else 0.5)

    runner = way.runner(ep.CompGraph({"ends": ends}, {"ends": ("x", ("low", "high"))}))
    for _ in range(way.runs):
        assert runner.run(x="good")["high"].max() == 0.5
    with way.is_taken(), pytest.raises(ContractBroken) as error:
        runner.run(x=bad)
    assert (error.value.token, error.value.made) == (bad, True)
    assert set(runner.last) == {"x"}, "neither output is kept"


def test_what_has_a_contract_is_guarded_like_everything_else(way):
    def draw(picture: Annotated[np.ndarray, GRAY]) -> Annotated[np.ndarray, GRAY]:
        if picture[0, 0] == 1:
            picture[0, 0] = 255
        return picture * 2

    runner = way.runner(ep.CompGraph({"draw": draw}, {"draw": ("picture", "drawn")}))
    for _ in range(way.runs):
        run = runner.run(picture=image())
        assert not run["drawn"].flags.writeable
    mine = image(value=1)
    with way.is_taken(), pytest.raises(ValueError, match="read-only") as error:
        runner.run(picture=mine)
    assert "Work on a copy" in error.value.__notes__[0]
    assert mine[0, 0] == 1


@pytest.mark.parametrize("outputs", ["y", ("y", "z")])
def test_the_memory_of_an_output_with_a_contract_may_be_used_again(way, outputs):
    buffer = image()

    def fill(x) -> Annotated[np.ndarray, GRAY]:
        buffer[:] = x
        return buffer

    def fill_two(x) -> list[Annotated[np.ndarray, GRAY]]:
        return [fill(x), image()]

    runner = way.runner(ep.CompGraph({"f": fill if outputs == "y" else fill_two}, {"f": ("x", outputs)}))
    runs = [runner.run(x=value) for value in range(way.runs)]
    assert [run["y"].max() for run in runs] == list(range(way.runs))


def test_a_contract_holds_for_an_unguarded_function_too(way):
    seen = []

    @ep.unguarded
    def look(picture: Annotated[np.ndarray, GRAY]) -> Annotated[int, "pixels"]:
        seen.append(picture.flags.writeable)
        return picture.size

    runner = way.runner(ep.CompGraph({"look": look}, {"look": ("picture", "n")}))
    for _ in range(way.runs):
        assert runner.run(picture=image())["n"] == 6
    with way.is_taken(), pytest.raises(ContractBroken, match="'look' takes token 'picture'"):
        runner.run(picture=image(np.int16))
    assert seen == [True] * way.runs


def test_without_the_guard_contracts_still_hold(way):
    runner = way.runner(Calls().cg, {"k": 2}, guard=False)
    for _ in range(way.runs):
        runner.run(raw=image())
    with way.is_taken(), pytest.raises(ContractBroken):
        runner.run(raw=image(np.float32))


def test_a_broken_contract_in_an_event_is_a_failure_of_that_function():
    failures, q_in, q_out = queue.Queue(), queue.Queue(), queue.Queue()
    pipe = ep.FullPipeline(
        "p", Calls().cg, q_in, q_out, lambda event: {"raw": event}, lambda view: view["sum"], {"k": 2}
    )
    pipe.on_error = failures.put
    with pipe:
        q_in.put(image(np.float64))
        q_in.put(image())
        assert q_out.get(timeout=60) == 6 * 5
    failure = failures.get_nowait()
    assert (failure.function, failure.exception.token) == ("smooth", "image")
