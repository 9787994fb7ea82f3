"""Runs every benchmark, prints a table of ratios and writes ``test-output/benchmarks.json``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from tests.benchmarks import (
    batch_map,
    batch_sweep,
    brokers,
    case,
    cpp,
    cpp_service,
    engine,
    imports,
    mutable_state,
    peers,
    picture,
    pipeline,
    promotion,
    service,
    sockets,
    tuning,
)
from tests.benchmarks.table import as_table, write_json
from tests.benchmarks.timing import Effort

_WIDTH = 170
_MODULES = (
    *(
        imports,
        engine,
        pipeline,
        mutable_state,
        picture,
        sockets,
        brokers,
        service,
        cpp_service,
        promotion,
        batch_map,
        batch_sweep,
        case,
        cpp,
    ),
    tuning,
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few rounds and no peers: only proves that all of it runs")
    effort = Effort(quick=parser.parse_args().quick)
    console = Console()
    console = console if console.is_terminal else Console(width=_WIDTH)
    rows = []
    for module in _MODULES:
        console.print(module.__doc__, style="dim")
        rows += module.rows(effort)
    console.print(as_table(rows))
    absent = {peer.name for peer in peers.ALL} - {peer.name for peer in peers.present(effort)}
    if absent:
        console.print(f"Left out: {', '.join(sorted(absent))}" + (" (quick)." if effort.quick else " (not installed)."))
    for venue in brokers.venues.ALL:
        if venue.missing():
            console.print(f"Left out: {venue.missing()}.")
    if cpp_service.missing():
        console.print(f"Left out: the service in C++. Missing: {cpp_service.missing()}.")
    if tuning.missing():
        console.print(f"Left out: tuning in a browser. {tuning.missing()}")
    write_json(rows, absent, Path("test-output") / "benchmarks.json")


if __name__ == "__main__":
    main()
