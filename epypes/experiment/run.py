"""How is the paper's experiment run? Layout by layout, request by request."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from epypes.acquisition.cameras import LAST_DEVICE
from epypes.errors import ExperimentError, KeysError
from epypes.experiment.components import Settings
from epypes.experiment.layouts import LAYOUTS, running
from epypes.experiment.results import Results, row_of, table_of
from epypes.experiment.robot import Robot
from epypes.transport import read_keys
from epypes.transport.zeromq.curve import public_keys

# Requests that come first and are not counted: they fill caches, and from its fourth run on a graph is compiled.
_WARM_UP: Final = 5
# So many requests without any answer in a row mean that there will be none.
_MOST_MISSING: Final = 3

Progress = Callable[[int, int], None]


def run_experiment(
    layout: str = "paper",
    *,
    requests: int = 500,
    experiments: int = 5,
    workers: int = 1,
    fps: float = 5.0,
    unsafe_pickle: bool = False,
    progress: Progress | None = None,
    cameras: Sequence[str | Path | int] = (),
    timeout_s: float = 5.0,
    keys: str | Path | None = None,
    allow: Sequence[str | Path] | None = None,
) -> Results:
    """Run the paper's experiment: a robot asks, acquisition finds the images, vision finds the keypoints.

    Parameters
    ----------
    layout
        How the nodes are spread: ``"paper"`` (the robot here, acquisition and vision in another process), ``"one"``
        (all of them here), ``"three"`` (a process each).
    requests
        How many requests are made in each experiment, one after another.
    experiments
        How often it is repeated; everything is started anew each time.
    workers
        How many functions of the graph may run at once.
    fps
        Frames per second of cameras that are files.
    unsafe_pickle
        Whether the contents of answers are pickled, as in 2019, and read. Whoever can send an answer could then run
        code here.
    progress
        Called with the requests made so far and those of all experiments, between two requests.
    cameras
        Two sources as `epypes.camera` takes them, each a path or the number of a device; without, the stereo pair that
        comes with scikit-image.
    timeout_s
        Longest wait for one answer.
    keys
        The .key_secret file of the pair that all nodes have in common; anybody on this machine may connect without.
    allow
        With keys: the .key files, or folders of them, of who else may connect to look on.

    Returns
    -------
    Results
        Its ``table`` has a row per request.

    Raises
    ------
    ExperimentError
        An option makes no sense, a process has ended, or there are no answers any more.
    KeysError
        Keys can't be read, or are not given.

    Notes
    -----
    Semeniuta and Falkman 2019, "Evaluation" (Figures 12 to 16).
    """
    import pandas as pd  # noqa: F401 - missing here, rather than after the last experiment

    _check(layout, requests=requests, experiments=experiments, workers=workers)
    _check_number("fps", fps)
    _check_number("timeout_s", timeout_s, threading.TIMEOUT_MAX)
    guarded = _checked_keys(keys, allow)
    settings = Settings(_checked_cameras(cameras), float(fps), workers, bool(unsafe_pickle), *guarded)
    rows: list[dict[str, Any]] = []
    counts: Counter[str] = Counter()

    def on_request() -> None:
        if progress is not None:
            progress(len(rows), requests * experiments)

    for experiment in range(experiments):
        with running(LAYOUTS[layout], settings) as system:
            robot = Robot(system.requests, system.inbox, timeout_s=timeout_s, unsafe_pickle=settings.unsafe_pickle)
            ask = _patient(robot)
            for _ in range(_WARM_UP):
                ask()
            for request in range(requests):
                rows.append(row_of(ask(), experiment, request))
                on_request()
        counts += robot.counts
    return Results(layout, table_of(rows), counts)


def _patient(robot: Robot) -> Callable[[], Any]:
    """Return the robot's ask, which gives up when nobody has answered several times in a row."""
    missing = 0

    def ask() -> Any:
        nonlocal missing
        answer = robot.ask()
        missing = missing + 1 if answer.is_missing else 0
        if missing >= _MOST_MISSING:
            text = f"Nobody answered {missing} requests in a row within {robot.timeout_s:g} s each."
            raise ExperimentError("robot", text)
        return answer

    return ask


def _check(layout: str, **counts: int) -> None:
    if layout not in list(LAYOUTS):
        raise ExperimentError("layout", f"There is no layout {layout!r}. There are: {', '.join(LAYOUTS)}.")
    for name, count in counts.items():
        if type(count) is not int or count < 1:
            raise ExperimentError(name, f"{name} must be a whole number from 1, not {count!r}.")


def _check_number(name: str, number: float, most: float = math.inf) -> None:
    if isinstance(number, bool) or not isinstance(number, int | float) or not 0 < number < math.inf:
        raise ExperimentError(name, f"{name} must be a number above 0, not {number!r}.")
    if number > most:
        raise ExperimentError(name, f"{name} must be at most {most:.0f}, not {number!r}.")


def _checked_keys(keys: str | Path | None, allow: Sequence[str | Path] | None) -> tuple[str, tuple[str, ...]]:
    """Return the files of keys as they can be told to another process."""
    if keys is None:
        if allow:
            raise KeysError("", "allow= was given, but no keys. Give keys= as well: epypes keys makes them.")
        return "", ()
    read_keys(keys)
    public_keys(allow or ())
    return str(Path(keys).absolute()), tuple(str(Path(path).absolute()) for path in allow or ())


def _checked_cameras(cameras: Sequence[str | Path | int]) -> tuple[str | int, ...]:
    """Return the sources as they can be told to another process."""
    given = [cameras] if isinstance(cameras, str | Path | int) else list(cameras)
    if len(given) not in (0, 2) or any(not isinstance(source, str | Path | int) for source in given):
        raise ExperimentError("cameras", f"cameras must be two, each a path or the number of a device, not {given!r}.")
    for source in given:
        if type(source) is int and not 0 <= source <= LAST_DEVICE:
            raise ExperimentError("cameras", f"No camera has the number {source}. They go from 0 to {LAST_DEVICE}.")
    return tuple(source if type(source) is int else str(Path(str(source)).absolute()) for source in given)
