"""A bundle with state between events: the sum of all numbers so far, and what an event asks for."""

from __future__ import annotations

from tests.service.bundles import written_bundle
from tests.service.served import TIMEOUT_S, event

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
        if what == "set":
            return object()
        return before + number


    def check(what, total, k):
        if what == "fail late":
            raise ValueError("after the sum")
        if what == "hold":
            time.sleep(1000)
        return 0 if what == "set" else total * k


    def f_out(view):
        from epypes.wire import Envelope

        if view["what"] == "fail answer":
            raise ValueError("in the answer")
        return Envelope("answer", {"out": view["out"]}, correlation_id=view.event.id)


    def with_delays(cg):
        return ep.delay(cg, "total", "before", initial=INITIAL)


    func_dict = {"add": add, "check": check}
    func_io = {"add": (("what", "number", "before"), "total"), "check": (("what", "total", "k"), "out")}
'''


def stateful_bundle(folder, *, k=1, initial=0, source=SOURCE):
    """Write a bundle whose answer is ``k`` times the sum of the numbers so far."""
    return written_bundle(
        folder,
        source.replace("INITIAL = 0", f"INITIAL = {initial}"),
        ("what", "number"),
        ("out",),
        hyperparameters={"k": k},
        sample=({"what": "plain", "number": 3}, {"out": (3 + initial) * k}),
        own=("f_out",),
        states={"before": "total"},
    )


def ask_from(peer, source, number=1, what="plain"):
    """Send an event of a source, and return its answer."""
    from dataclasses import replace

    request = replace(event(what, number), source=source)
    peer.requests.put(request)
    while True:
        (answer,) = peer.take(timeout_s=TIMEOUT_S)
        if answer.correlation_id == request.id:
            return answer
