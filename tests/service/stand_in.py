"""A service as HTTP sees it, without processes and sockets, until the real one is there."""

from __future__ import annotations

import json
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from epypes.display.paint.svg import paint_svg
from epypes.display.show import view as _view  # noqa: F401
from epypes.display.views.jsonview import to_json
from epypes.display.views.view import view
from epypes.errors import BundleError, DeployRefused, ParametersRefused, RevisionConflict, UnknownName
from epypes.service.failurerecord import FailureRecord
from epypes.service.failurestore import FailureStore


@dataclass(frozen=True)
class Parameters:
    revision: int
    entries: dict


@dataclass(frozen=True)
class Latency:
    total_ns: int = 123_000_000
    buckets: dict = field(default_factory=lambda: {1_000_000: 3, 10_000_000: 40, 2**62: 1})
    functions: dict = field(default_factory=lambda: {"canny": 9_000_000, "blur": 4_000_000})


class StandIn:
    def __init__(self, runner, folder):
        self.runner, self.state, self.reason = runner, "READY", ""
        self.revision, self.values = 0, {t: dict(e) for t, e in ENTRIES.items()}
        self.failure_store = FailureStore(Path(folder) / "failures")
        self.path = str(folder)
        self.listeners = []
        self.received = 0
        self.lock = threading.Lock()

    def alive(self):
        return "" if self.state != "FAULTED" else self.reason

    def ready(self):
        return "" if self.state == "READY" else f"The service is {self.state}. {self.reason}".strip()

    def info(self):
        return {
            "name": "edges", "bundle": self.path, "digest": "3f" * 32, "state": self.state, "reason": self.reason,
            "inputs": ["image"], "outputs": ["edges"], "func_io": {n: [list(i), list(o)] for n, (i, o) in self.runner.cg.func_io.items()} if False else {},
            "rgb": [], "threads": 1, "revision": self.revision,
            "addresses": {"sub": "tcp://127.0.0.1:5555", "pub": "tcp://127.0.0.1:5556", "failures": "", "http": ""},
            "pid": os.getpid(), "worker_pid": None, "started_ns": time.time_ns(), "restarts": 0,
            "versions": {"epypes": "1", "python": "3.11"},
        }

    def counts(self):
        n = self.received
        return {"received": n, "answered": n, "failed": 0, "dropped": 0, "rejected": 0, "retried": 0, "dead_letters": 0, "waiting": 0, "in_flight": 0}

    def latency(self):
        return Latency()

    def parameters(self):
        return Parameters(self.revision, self.values)

    def set_parameters(self, values, revision):
        if revision is not None and revision != self.revision:
            raise RevisionConflict(self.path, self.parameters())
        problems = {t: f"No parameter {t!r}." for t in values if t not in self.values}
        problems |= {t: f"{t} is {v!r}; a number up to 255." for t, v in values.items() if t in self.values and (type(v) is not int or not 0 <= v <= 255)}
        if problems:
            raise ParametersRefused(self.path, problems)
        self.values = {t: {**e, **({"value": values[t]} if t in values else {})} for t, e in self.values.items()}
        self.revision += 1
        for token, value in values.items():
            self.runner[token] = value
        self.runner.rerun()
        self.tell("parameters", {"revision": self.revision, "parameters": self.values})
        return self.parameters()

    def view(self):
        return json.dumps(to_json(view(self.runner))).encode()

    def graph_svg(self):
        return paint_svg(view(self.runner)).encode()

    def preview(self, token, max_side_px):
        if token not in self.runner.cg.tokens:
            raise UnknownName("token", token, self.runner.cg.tokens)
        import cv2
        value = self.runner[token]
        if not hasattr(value, "shape"):
            return "text/plain", repr(value).encode()
        return "image/png", cv2.imencode(".png", value)[1].tobytes()

    def run(self, tokens, revision=None):
        for t in tokens:
            if t not in self.runner.cg.tokens:
                raise UnknownName("token", t, self.runner.cg.tokens)
        return b"frames"

    def failure_records(self, limit):
        return self.failure_store.records(limit)

    def deploy(self, path):
        if not Path(path).is_dir():
            raise BundleError(path, f"{path} does not exist.")
        raise DeployRefused(path, ["Token 'edges' differs at [0, 0]."])

    def rollback(self):
        raise DeployRefused(self.path, ["There was no bundle before."])

    def pause(self):
        self.set_state("PAUSED", "")

    def resume(self):
        self.set_state("READY", "")

    def drain(self, timeout_s):
        pass

    def set_state(self, state, reason):
        self.state, self.reason = state, reason
        self.tell("state", {"state": state, "reason": reason})

    def tell(self, kind, data):
        for each in self.listeners:
            each(kind, data)

    def listen(self, callback):
        self.listeners.append(callback)
        return lambda: self.listeners.remove(callback)

    def ran(self):
        self.received += 1
        self.tell("run", {"seq": self.received, "event_id": str(self.received), "revision": self.revision, "total_ns": 5_000_000 + self.received % 7 * 300_000})

    def fail(self):
        record = FailureRecord(event_id="e1", function="canny", tokens=("image_blurred", "canny_lo", "canny_hi", "edges"), exception="ValueError", message="lo is above hi", trace=("Traceback", "  line 1"), bundle=self.path, revision=self.revision, hyperparameters=self.values)
        record = self.failure_store.keep(record, b"event")
        self.tell("failure", record)
        return record


ENTRIES = {
    "blur_kernel": {"value": 11, "low": 1, "high": 31, "odd": True},
    "canny_lo": {"value": 70, "low": 0, "high": 255},
    "canny_hi": {"value": 200, "low": 0, "high": 255, "unit": "grey levels"},
}
