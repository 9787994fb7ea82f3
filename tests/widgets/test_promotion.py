"""Does the Promote button write a bundle that proves itself, and say what it did or why it did not?"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes_widgets.promotion import BundleJob, Outcome, proposal

pytestmark = pytest.mark.slow

TIMEOUT_S = 60.0


class Told:
    """Keeps what a promotion reports, and on which thread."""

    def __init__(self) -> None:
        self.outcomes: list[Outcome] = []
        self.threads: list[threading.Thread] = []
        self.promotion = BundleJob(self._arrives)

    def _arrives(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)
        self.threads.append(threading.current_thread())

    def promoted(self, runner: ep.CompGraphRunner, to: object, outputs: Any = None) -> Outcome:
        assert self.promotion.promote(runner, str(to), outputs)
        outcome = self.promotion.wait(TIMEOUT_S)
        assert outcome is self.outcomes[-1]
        return outcome


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def edges(photograph: Any) -> ep.CompGraphRunner:
    """Of OpenCV's own functions, which a bundle can have."""
    cg = ep.CompGraph(
        {"smooth": cv2.medianBlur, "canny": cv2.Canny},
        {"smooth": (("image", "side"), "smoothed"), "canny": (("smoothed", "lo", "hi"), "edges")},
    )
    runner = ep.CompGraphRunner(cg, {"side": 5, "lo": 70, "hi": 200})
    runner.run(image=photograph)
    return runner


def runner_of(function: Callable[..., Any], *inputs: str, **hparams: Any) -> ep.CompGraphRunner:
    return ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": (inputs, "y")}), hparams)


def test_a_bundle_is_written_and_said_to_be_identical(told: Told, edges: ep.CompGraphRunner, tmp_path: Path) -> None:
    target = tmp_path / "edges"
    outcome = told.promoted(edges, target, ["edges"])
    assert outcome == Outcome(
        "promoted",
        "done",
        f"Promoted to {target}: output edges; 1 sample replayed in a fresh process, identical.\n"
        "No function says the order of the colours of 'image': bgr is assumed. If it is rgb, annotate a parameter: "
        'Annotated[np.ndarray, ep.Image(order="rgb")].',
        str(target),
    )
    assert [each.state for each in told.outcomes] == ["running", "done"]
    assert threading.current_thread() not in told.threads
    assert all(thread.daemon for thread in told.threads)
    assert ep.load(target).hyperparameters == edges.hyperparameters


def test_a_runner_of_which_only_a_stage_was_run_is_completed(
    told: Told, edges: ep.CompGraphRunner, tmp_path: Path, photograph: Any
) -> None:
    edges["side"] = 7
    partial = edges.rerun("smoothed")
    assert edges.stale == ("canny",)
    outcome = told.promoted(edges, tmp_path / "b", ["smoothed", "edges"])
    assert (outcome.state, "outputs smoothed and edges" in outcome.text) == ("done", True)
    assert edges.last is partial, "what cells read is left alone"
    served = ep.load(tmp_path / "b").run(image=photograph)
    np.testing.assert_array_equal(served["edges"], edges.rerun()["edges"])


def test_a_value_that_was_set_and_not_run_is_promoted(told: Told, edges: ep.CompGraphRunner, tmp_path: Path) -> None:
    edges["lo"] = 10
    assert told.promoted(edges, tmp_path / "b").state == "done"
    assert ep.load(tmp_path / "b").hyperparameters["lo"] == 10


def test_a_runner_that_has_not_been_run_is_refused(told: Told, tmp_path: Path) -> None:
    outcome = told.promoted(runner_of(cv2.medianBlur, "image", "side", side=3), tmp_path / "b")
    assert outcome.state == "refused"
    assert outcome.text.startswith("Not promoted:\n- Nothing has been run")
    assert not (tmp_path / "b").exists()


def test_every_reason_is_said(told: Told, tmp_path: Path) -> None:
    runner = runner_of(lambda x, k, m: x, "x", "k", "m", k=[np.ones(1_000)], m=len)
    runner.run(x=1)
    outcome = told.promoted(runner, tmp_path / "b")
    assert outcome.state == "refused"
    assert "Hyperparameter 'k' is or holds an array of 1000 numbers" in outcome.text
    assert "Hyperparameter 'm'" in outcome.text


@pytest.mark.parametrize("error", [ValueError("13 is bad"), SystemExit(3), KeyboardInterrupt()])
def test_a_function_that_fails_is_a_refusal_that_names_it(told: Told, tmp_path: Path, error: BaseException) -> None:
    fails = [False]

    def moody(x: int) -> int:
        if fails[0]:
            raise error
        return x

    runner = runner_of(moody, "x")
    runner.run(x=1)
    fails[0] = True
    outcome = told.promoted(runner, tmp_path / "b")
    assert outcome.state == "refused"
    assert type(error).__name__ in outcome.text
    assert "'f'" in outcome.text, "the note names the function"


@pytest.mark.parametrize("outputs", [["edgs"], [], "edges", [3]])
def test_outputs_that_are_none_are_refused(told: Told, edges: ep.CompGraphRunner, tmp_path: Path, outputs: Any) -> None:
    outcome = told.promoted(edges, tmp_path / "b", outputs)
    assert outcome.state == "refused"
    assert outcome.text.startswith(("Not done:", "Not promoted:"))
    assert not (tmp_path / "b").exists()


def test_a_folder_that_can_not_be_is_refused(told: Told, edges: ep.CompGraphRunner, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    for to in (tmp_path / "mine", "", "  ", "a\0b", "~nobody-of-this-name/x"):
        outcome = told.promoted(edges, to)
        assert (outcome.state, outcome.to) == ("refused", str(to))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


def test_one_promotion_runs_at_a_time(told: Told, tmp_path: Path) -> None:
    begun, go_on = threading.Event(), threading.Event()
    go_on.set()

    def slow(x: int) -> int:
        begun.set()
        go_on.wait(TIMEOUT_S)
        return x

    runner = runner_of(slow, "x")
    runner.run(x=1)
    go_on.clear()
    begun.clear()
    assert told.promotion.promote(runner, str(tmp_path / "a"))
    assert begun.wait(TIMEOUT_S)
    assert not told.promotion.promote(runner, str(tmp_path / "b"))
    assert [outcome.to for outcome in told.outcomes] == [str(tmp_path / "a")]
    with pytest.raises(TimeoutError, match="still computing"):
        told.promotion.wait(0.01)
    go_on.set()
    told.promotion.wait(TIMEOUT_S)
    assert told.promotion.promote(runner, str(tmp_path / "b")), "after it the next may begin"
    told.promotion.wait(TIMEOUT_S)


def test_a_report_that_fails_ends_nothing(edges: ep.CompGraphRunner, tmp_path: Path) -> None:
    def broken(_outcome: Outcome) -> None:
        raise RuntimeError("the view is gone")

    promotion = BundleJob(broken)
    assert promotion.wait(0.0) is None
    assert promotion.promote(edges, str(tmp_path / "b"))
    outcome = promotion.wait(TIMEOUT_S)
    assert outcome is not None
    assert outcome.state == "done"


@pytest.mark.parametrize(
    ("outputs", "folder"),
    [(["edges"], "services/edges"), (["a/b c"], "services/a-b-c"), ([".."], "services/graph"), ([], "services/graph"),
     (["mask", "area"], "services/mask-area"), (["größe"], "services/größe"), (["x" * 500], "services/" + "x" * 60)],
)  # fmt: skip
def test_a_folder_is_proposed_after_the_outputs_that_are_promoted(outputs: list[str], folder: str) -> None:
    assert proposal(outputs) == folder
