"""How close to the floor, and how far before its peers, must the panel be?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median

from tests.benchmarks.row import OURS, Goal, Row
from tests.benchmarks.tuning.cells import RUN_S
from tests.benchmarks.tuning.latency import Seen, p50, p95
from tests.benchmarks.tuning.session import IMAGE, MATPLOTLIB, MOVES, SLOW_MOVES, Measured

_SERVER = "JupyterLab"
_ECHO = "echo"
_ALLOWED = "allowed"
# After the last move: the run that it found, its own, and the ways there and back.
_RUNS_LATE, _ECHOES_LATE = 2, 5
_PICTURES = 50

Share = Callable[[Iterable[float]], float]


def compared(measured: Measured) -> list[Row]:
    """Return a row for each goal."""
    press, drag = measured.presses, measured.drags
    return [
        _beside_echo(measured, "a key press, p50", press[OURS], p50, 2.5),
        _beside_peer("a key press, p50", press, IMAGE, p50, 1.2),
        _beside_echo(measured, f"a drag of {MOVES} moves, p50", drag[OURS], p50, 4),
        _beside_echo(measured, f"a drag of {MOVES} moves, p95", drag[OURS], p95, 8),
        _beside_peer(f"a drag of {MOVES} moves, p95", drag, IMAGE, p95, 1),
        _beside_peer(f"a drag of {MOVES} moves, p50", drag, MATPLOTLIB, p50, 1 / 5),
        _pictures(measured),
        *_slow(measured),
    ]


def _beside_echo(measured: Measured, work: str, seen: Sequence[Seen], share: Share, most: float) -> Row:
    amounts = {_ECHO: p50(measured.echoes_ms) * 1e6, OURS: share(_latencies(seen)) * 1e6}
    note = "limit: p50 of an integer's way to the kernel and back"
    return Row(f"{_SERVER}: {work}, to {_ECHO}", amounts, goal=Goal("ratio", most), limit=_ECHO, note=note)


def _beside_peer(work: str, seen: Mapping[str, Sequence[Seen]], peer: str, share: Share, most: float) -> Row:
    amounts = {name: share(_latencies(seen[name])) * 1e6 for name in (peer, OURS)}
    return Row(f"{_SERVER}: {work}, to {peer}", amounts, goal=Goal("ratio", most), limit=peer)


def _pictures(measured: Measured) -> Row:
    amounts = {name: median(seen.values_shown for seen in measured.drags[name]) for name in (IMAGE, OURS)}
    work = f"{_SERVER}: pictures in a drag of {MOVES} moves"
    return Row(work, amounts, goal=Goal("least", _PICTURES), limit=IMAGE, note=f"limit: {IMAGE}", unit="count")


def _slow(measured: Measured) -> list[Row]:
    seen, run_ms = measured.slow, RUN_S * 1e3
    late_ms = _RUNS_LATE * run_ms + _ECHOES_LATE * p50(measured.echoes_ms)
    runs = {_ALLOWED: float(int(seen.duration_ms / run_ms + 1)), OURS: measured.slow_runs}
    late = {_ALLOWED: late_ms * 1e6, OURS: seen.last_late_ms * 1e6}
    work = f"{_SERVER}: {SLOW_MOVES} moves over {RUN_S:g} s"
    return [
        Row(f"{work}, runs", runs, 1, Goal("ratio", 1), _ALLOWED, note="limit: time / run time + 1", unit="count"),
        Row(f"{work}, last picture", late, 1, Goal("ratio", 1), _ALLOWED, note="limit: 2 runs and 5 echoes late"),
    ]


def _latencies(seen: Sequence[Seen]) -> list[float]:
    return [latency for each in seen for latency in each.latencies_ms]
