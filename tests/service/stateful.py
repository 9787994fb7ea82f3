"""A bundle with state between events: the sum of all numbers so far, and what an event asks for."""

from __future__ import annotations

from dataclasses import replace

from tests.service.bundles import written_bundle
from tests.service.served import event

SOURCE = '''
    """A graph that adds the numbers of its events."""

    import os
    import time

    import numpy as np

    import epypes as ep

    INITIAL = 0


    def add(what, number, before):
        if what == "fail":
            raise ValueError("before the sum")
        if what == "kill":
            os.kill(os.getpid(), 9)
            time.sleep(1000)
        if what == "object":
            return object()
        name, _, path = what.partition(":")
        if name == "touch":
            open(path, "w").close()
        if name in ("touch", "wait"):
            while not os.path.exists(path):
                time.sleep(0.002)
        return before + number


    def check(what, total, k):
        if what == "fail late":
            raise ValueError("after the sum")
        if what == "hold":
            time.sleep(1000)
        if what == "fail answer":
            return object()
        return 0 if what == "object" else total * k


    def with_delays(cg):
        return ep.delay(cg, "total", "before", initial=INITIAL)


    func_dict = {"add": add, "check": check}
    func_io = {"add": (("what", "number", "before"), "total"), "check": (("what", "total", "k"), "out")}
'''


def stateful_bundle(folder, *, k=1, initial=0, source=SOURCE, prefix=""):
    """Write a bundle whose answer is ``k`` times the sum of the numbers so far."""
    return written_bundle(
        folder,
        source.replace("INITIAL = 0", f"INITIAL = {initial}"),
        ("what", "number"),
        ("out",),
        hyperparameters={"k": k},
        sample=({"what": "plain", "number": 3}, {"out": (3 + initial) * k}),
        states={f"{prefix}before": f"{prefix}total"},
        state=({f"{prefix}before": initial}, {f"{prefix}before": 3 + initial}),
    )


def send_from(peer, source, number=1, what="plain"):
    """Send an event of a source."""
    peer.requests.put(replace(event(what, number), source=source))


def sums(peer, *numbers, source=""):
    """Send events one after the other, and return what they are answered with."""
    found = []
    for number in numbers:
        send_from(peer, source, number)
        (answer,) = peer.take()
        assert answer.failure is None, answer.failure
        found.append(answer.parts["out"])
    return found
