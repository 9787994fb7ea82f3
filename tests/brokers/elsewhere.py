"""How does a test start a broker on another host?

By ``python -m tests.brokers.elsewhere MODULE ADDRESS NAME...``: it says READY and the address of each place on its
standard output, and runs until its input ends.
"""

from __future__ import annotations

import contextlib
import importlib
import sys

from tests.brokers.fleet import Member


@contextlib.contextmanager
def broker_at(host, module, *names):
    """Start a broker on a host; give the addresses of its places. It is ended and removed afterwards."""
    member = Member("-m", "tests.brokers.elsewhere", module, host.address, *names, before=host.before)
    try:
        member.wait_ready()
        yield member.lines[0].split()[1:]
    finally:
        member.end()


def main(module, host, *names):
    with importlib.import_module(f"tests.brokers.{module}").server(host) as made:
        print("READY", *(made.address(name, create=True) for name in names), flush=True)  # noqa: T201
        sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
