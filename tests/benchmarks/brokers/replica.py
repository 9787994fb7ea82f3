"""How does one replica run, as a process of its own?"""

from __future__ import annotations

import importlib
import json
import sys

from tests.benchmarks.brokers.parties import Meeting


def main() -> None:
    serving = importlib.import_module(sys.argv[1]).serve
    serving(Meeting(**json.loads(sys.argv[2])), lambda: print("READY", flush=True))


if __name__ == "__main__":
    main()
