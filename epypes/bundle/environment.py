"""What does a replay run on? What can make the same code compute something else."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Final

_CPU_INFO: Final = Path("/proc/cpuinfo")
# What is told of each difference, by the name of what differs.
_TOLD: Final = {
    "python": "another Python",
    "platform": "another platform",
    "processor": "another processor",
    "opencv": "another build of OpenCV",
    "opencv processor features": "a processor of which OpenCV uses other features",
    "opencv threads": "another number of threads of OpenCV",
}


def environment() -> dict[str, str]:
    """Return Python, platform and processor; and OpenCV's build, features and threads where it is imported."""
    facts = {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }
    cv2 = sys.modules.get("cv2")
    if cv2 is not None:
        build = hashlib.sha256(cv2.getBuildInformation().encode()).hexdigest()[:12]
        facts["opencv"] = f"{cv2.__version__} {build}"
        facts["opencv processor features"] = cv2.getCPUFeaturesLine()
        facts["opencv threads"] = str(cv2.getNumThreads())
    return {name: " ".join(value.split()) for name, value in facts.items()}


def _processor() -> str:
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor()) or f"{os.cpu_count()} of unknown kind"


def environment_differences(recorded: dict[str, str], now: dict[str, str]) -> list[str]:
    """Return as sentences what is not as it was when the samples were recorded."""
    return [
        f"It was recorded on {what}: {recorded[name]}, here it is {now[name]}."
        for name, what in _TOLD.items()
        if name in recorded and name in now and recorded[name] != now[name]
    ]
