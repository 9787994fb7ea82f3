"""A service as its HTTP control sees it, in this process: the graph runs where the test can see and break it."""

from __future__ import annotations

import json
import os
import threading
import uuid
from contextlib import contextmanager

from epypes.bundle.settings import encode_value
from epypes.catalog import plain
from epypes.display.views.graphview import to_json
from epypes.display.views.view import view
from epypes.errors import NotComputed, ParametersRefused, RevisionConflict, ServiceError
from epypes.service.http.server import HttpServer
from epypes.service.parameters import Parameters, changed_entries
from epypes.service.supervision.packing import pack
from epypes.wire import Envelope, encode


class Standing:
    """Answers as a service does."""

    def __init__(self, runner, folder, ranges=None, outputs=("edges",)):
        self.runner, self.folder, self.outputs = runner, folder, outputs
        self.state, self.reason = "READY", ""
        self.entries = {
            t: {**encode_value(plain(v)), **(ranges or {}).get(t, {})} for t, v in runner.hyperparameters.items()
        }
        self.revision = 0
        self.reruns = 0
        self.asked = []
        self.completed = None
        self.listeners = []
        self.lock = threading.RLock()
        self.failure_store = None

    # -- what the line does ---------------------------------------------------------------------------------------

    def event(self, **payload):
        """An event comes on the line."""
        with self.lock:
            run = self.runner.trial({}, payload=payload)
            event_id = uuid.uuid4().hex
            if run.failure is None:
                self.completed = run, event_id, self.revision
                self.tell("run", seq=1, event_id=event_id, revision=self.revision, total_ns=run.report.total_ns)
            else:
                failure = run.failure
                self.tell(
                    "failure",
                    id="f1",
                    event_id=event_id,
                    function=failure.function,
                    tokens=list(failure.tokens),
                    exception=failure.kind,
                    message=failure.message,
                    trace=[],
                    kind="raised",
                    revision=self.revision,
                )
            return run

    def become(self, state, reason=""):
        self.state, self.reason = state, reason
        self.tell("state", state=state, reason=reason)

    def tell(self, kind, /, **data):
        for callback in tuple(self.listeners):
            callback(kind, data)

    # -- what HTTP asks -------------------------------------------------------------------------------------------

    def alive(self):
        return ""

    def ready(self):
        return "" if self.state == "READY" else self.reason

    def info(self):
        return {
            "name": "edges", "bundle": str(self.folder), "digest": "3f" * 32, "state": self.state, "reason": self.reason,
            "inputs": list(self.runner.free_source_tokens), "outputs": list(self.outputs),
            "func_io": json.loads(json.dumps(dict(self.runner.cg.func_io))),
            "rgb": [], "threads": 1, "revision": self.revision, "addresses": {"sub": "tcp://127.0.0.1:1", "pub": "tcp://127.0.0.1:2"},
            "pid": os.getpid(), "worker_pid": None, "started_ns": 1, "restarts": 0, "counts": {}, "versions": {"epypes": "1.0.0.dev0"},
        }  # fmt: skip

    def counts(self):
        return dict.fromkeys(
            (
                "received",
                "answered",
                "failed",
                "dropped",
                "rejected",
                "retried",
                "dead_letters",
                "waiting",
                "in_flight",
            ),
            0,
        )

    def group(self):
        return {
            "is_shared": False, "replicas": 1, "ready": 1, "agree": True, "counts": {}, "trouble": "", "rejected": 0, "members": [],
            "lost": [],
        }  # fmt: skip

    def parameters(self):
        return Parameters(self.revision, self.entries)

    def set_parameters(self, values, revision):
        with self.lock:
            self.asked.append((dict(values), revision))
            if revision is not None and revision != self.revision:
                raise RevisionConflict(self.folder, self.parameters())
            entries, problems = changed_entries(self.entries, values)
            if problems:
                raise ParametersRefused(self.folder, problems)
            self.entries, self.revision = entries, self.revision + 1
            self.runner.set(**{t: tuple(v) if isinstance(v, list) else v for t, v in values.items()})
        self.tell("parameters", revision=self.revision, parameters=self.entries)
        return self.parameters()

    def view(self):
        return json.dumps(to_json(view(self.completed[0] if self.completed else self.runner))).encode()

    def graph_svg(self):
        return b"<svg/>"

    def preview(self, token, max_side_px):
        return "text/plain", repr(self.completed[0][token]).encode()

    def run(self, tokens, revision=None):
        with self.lock:
            if self.state == "LOADING":
                raise ServiceError(self.folder, "The worker is starting.")
            if self.completed is None:
                raise NotComputed("", "No event has been completed yet. Send one first.")
            run, event_id, of = self.completed
            if revision is not None and of < revision:
                self.reruns += 1
                run = self.runner.trial({}, payload={t: run[t] for t in self.runner.free_source_tokens})
                if run.failure is not None:
                    raise NotComputed("", str(run.failure))
                of = self.revision
            for token in tokens:
                run.cg.require_token(token)
            return pack(
                encode(
                    Envelope(
                        type="epypes.values",
                        parts={token: run[token] for token in tokens},
                        correlation_id=event_id,
                        revision=of,
                        timings=run.report.durations_ns,
                    )
                )
            )

    def failure_records(self, limit):
        return []

    def pause(self):
        self.become("PAUSED")

    def resume(self):
        self.become("READY")

    def drain(self, timeout_s):
        self.become("STOPPED")

    def listen(self, callback):
        self.listeners.append(callback)
        return lambda: self.listeners.remove(callback)


@contextmanager
def standing(service, address="127.0.0.1:0"):
    """Serve it over HTTP; yield the server, with its ``url`` and ``token``."""
    access_key_file = service.folder / "token"
    with HttpServer(service, address, access_key_file=access_key_file) as server:
        server.token = access_key_file.read_text().strip()
        yield server
