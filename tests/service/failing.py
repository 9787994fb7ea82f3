"""A bundle that fails, kills its process, crashes or hangs, as the first pixel of its image says."""

from __future__ import annotations

import linecache

import numpy as np

import epypes as ep
from epypes.bundle.manifest import check_manifest
from epypes.service.failures.record import FailedEvent
from epypes.service.failures.store import FailureStore, failures_folder
from epypes.wire import Envelope

FINE, KILLS, HANGS, EXITS, CRASHES, RAISES = 20, 6, 8, 9, 7, 94

MODULE = '''
import ctypes
import os
import time

import numpy as np


def brighten(image, by):
    """Add to every pixel."""
    return image + by


def check(bright, most):
    """Raise where the picture is too bright; do worse where a test asks for it."""
    if bright[0, 0] == 7:
        os.kill(os.getpid(), 9)
    if bright[0, 0] == 8:
        ctypes.string_at(0)
    if bright[0, 0] == 9:
        time.sleep(3_600)
    if bright[0, 0] == 10:
        os._exit(5)
    if bright.max() > most:
        raise ValueError(f"too bright: {bright.max()}")
    return bright


def half(checked):
    """Take half of it."""
    return checked // 2


def f_in(event):
    """Take the pixels of a message of one frame."""
    if event == b"hangs":
        time.sleep(3_600)
    return {"image": np.frombuffer(event, np.uint8).reshape(6, 8)}
'''


def picture(value):
    return np.full((6, 8), value, np.uint8)


def request(value):
    return Envelope("epypes.request", {"image": picture(value)}, id="77")


def promoted(folder, *, with_f_in=False):
    """Promote the bundle to a folder; return its path. With its own f_in it takes bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "bright.py"
    source.write_text(MODULE)
    names = {}
    exec(compile(MODULE, str(source), "exec"), names)
    linecache.getlines(str(source))
    cg = ep.CompGraph(
        {name: names[name] for name in ("brighten", "check", "half")},
        {
            "brighten": (("image", "by"), "bright"),
            "check": (("bright", "most"), "checked"),
            "half": ("checked", "halved"),
        },
    )
    runner = ep.CompGraphRunner(cg, {"by": 1, "most": 90})
    runner.run(image=picture(FINE))
    return ep.promote(runner, folder / "bright", f_in=names["f_in"] if with_f_in else None).path


def keep(bundle, event, **told):
    """Have a failure of a bundle kept, as its service does; return its id."""
    store = FailureStore(failures_folder(bundle))
    record = {
        "event_id": "77",
        "function": "check",
        "exception": "ValueError",
        "message": "too bright: 95",
        "bundle": str(bundle),
        "digest": check_manifest(bundle),
        "hyperparameters": {"by": {"value": 1}, "most": {"value": 90}},
    }
    kept = store.keep(FailedEvent(**{**record, **told}), event)
    assert store.flush()
    return kept.id
