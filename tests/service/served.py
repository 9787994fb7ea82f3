"""A served bundle whose function does what an event says, and a peer of it."""

from __future__ import annotations

import queue
from contextlib import contextmanager
from time import monotonic

import epypes as ep
from epypes.service import Service
from epypes.wire import Envelope
from tests.service.bundles import written_bundle
from tests.transport.peers import wait_until

TIMEOUT_S = 60.0

SOURCE = '''
    """A graph whose function does what an event says."""

    import os
    import re
    import signal
    import sys
    import time


    def act(what, number, k):
        name, _, more = what.partition(":")
        if name in ACTIONS:
            ACTIONS[name](more)
        return number * k


    def hold(folder):
        open(os.path.join(folder, "started"), "w").close()
        while not os.path.exists(os.path.join(folder, "release")):
            time.sleep(0.002)
        open(os.path.join(folder, "over"), "w").close()


    def hold_once(folder):
        """Hold for ever the first time, and return at once the second time."""
        seen = os.path.join(folder, "seen")
        if not os.path.exists(seen):
            open(seen, "w").close()
            time.sleep(1000)


    def die(number):
        os.kill(os.getpid(), number)
        time.sleep(1000)


    def fail(text):
        raise ValueError(text)


    def regex(more):
        re.match(r"(a+)+$", "a" * 60 + "b")


    ACTIONS = {
        "hold": hold,
        "hold_once": hold_once,
        "fail": fail,
        "regex": regex,
        "sleep": lambda seconds: time.sleep(float(seconds)),
        "kill": lambda more: die(signal.SIGKILL),
        "segv": lambda more: die(signal.SIGSEGV),
        "exit": lambda more: os._exit(3),
        "say": lambda more: print(more, file=sys.stderr, flush=True),
    }

    func_dict = {"act": act}
    func_io = {"act": (("what", "number", "k"), "out")}
'''


def acting_bundle(folder, *, k=2, source=SOURCE, expected=6, inputs=("what", "number"), outputs=("out",)):
    """Write a bundle of the function; its sample expects 3 * k."""
    sample = {name: {"what": "plain", "number": 3}.get(name, 0) for name in inputs}, dict.fromkeys(outputs, expected)
    return written_bundle(folder, source, inputs, outputs, hyperparameters={"k": k}, sample=sample)


def gated_bundle(folder, gate, **more):
    """Write a bundle of the function that no worker can load while the file ``gate`` exists."""
    waiting = f"\n    while os.path.exists({str(gate)!r}):\n        time.sleep(0.005)\n"
    return acting_bundle(folder, source=SOURCE + waiting, **more)


def event(what="plain", number=1):
    return Envelope(type="x", parts={"what": what, "number": number})


class Peer:
    """Sends events to a service and gets its answers and failures."""

    def __init__(self, requests, answers, failures, publisher):
        self.requests, self.answers, self.failures, self.publisher = requests, answers, failures, publisher
        self.sent = []

    def send(self, what="plain", number=1):
        return self.send_parts(what=what, number=number)

    def send_parts(self, **parts):
        request = Envelope(type="x", parts=parts)
        self.sent.append(request.id)
        self.requests.put(request)
        return request.id

    def take(self, count=1, timeout_s=TIMEOUT_S):
        """Return the next answers."""
        deadline = monotonic() + timeout_s
        return [self.answers.get(timeout=max(deadline - monotonic(), 0.01)) for _ in range(count)]

    def ask(self, what="plain", number=1):
        """Send an event, and return its answer."""
        sent = self.send(what, number)
        while True:
            (answer,) = self.take()
            if answer.correlation_id == sent:
                return answer

    def ask_until_answered(self, number=1):
        """Ask again and again: on a busy machine a plain event may take longer than a short time-out of a test."""
        while (answer := self.ask(number=number)).failure is not None:
            assert "did not return" in answer.failure.message
        return answer


@contextmanager
def peer_at(sub, pub, failures):
    requests, answers, failed = queue.Queue(), queue.Queue(), queue.Queue()
    with (
        ep.Subscriber(pub, answers) as answered,
        ep.Subscriber(failures, failed, "failure") as reported,
        ep.Publisher(sub, requests, bind=False) as publisher,
    ):
        assert answered.wait_joined(TIMEOUT_S)
        assert reported.wait_joined(TIMEOUT_S)
        assert publisher.wait_for_subscriber(TIMEOUT_S)
        yield Peer(requests, answers, failed, publisher)


@contextmanager
def peer_of(service):
    """Join a service from outside."""
    state = service.service_state
    with peer_at(state.sub, state.pub, state.failures) as peer:
        yield peer


@contextmanager
def serving(bundle, **options):
    """Serve a bundle, and talk to it; what was counted adds up at the end."""
    with Service(bundle, **options) as service:
        assert service.state == "READY", service.reason
        with peer_of(service) as peer:
            yield service, peer
    check_counts(service.counts())
    assert (service.counts()["waiting"], service.counts()["in_flight"]) == (0, 0)


def check_counts(counts):
    parts = ("answered", "failed", "dropped", "dead_letters", "waiting", "in_flight")
    assert counts["received"] == sum(counts[part] for part in parts), counts


def until(is_so, timeout_s=TIMEOUT_S):
    wait_until(is_so, timeout_s)
