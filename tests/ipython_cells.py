"""Cells that are run by IPython in a process of their own, and what it shows of each, as a notebook does."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

PROGRAM = """
import json, sys
from IPython.core.history import HistoryManager
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

cells, mode = json.loads(sys.argv[1])
HistoryManager.enabled = False
shell = InteractiveShell.instance()
shell.run_line_magic("colors", "nocolor")
shell.run_line_magic("xmode", mode)
# What a cell's last line is goes where its other outputs go, and not to the terminal as text.
shell.displayhook.write_output_prompt = lambda: None
shell.displayhook.write_format_data = lambda data, metadata=None: shell.display_pub.publish(data, metadata)
shown = []
for cell in cells:
    with capture_output() as captured:
        # Counted, as in a notebook.
        succeeded = shell.run_cell(cell, store_history=True).success
    shown.append([succeeded, captured.stdout, [output.data for output in captured.outputs]])
print("SHOWN", json.dumps(shown))
"""


@dataclass(frozen=True)
class Shown:
    """What a cell has shown: whether it succeeded, what it printed with its traceback, and its outputs by media type."""

    succeeded: bool
    text: str
    outputs: list[dict[str, object]]


def run_cells(*cells: str, mode: str = "Context", folder: Path | None = None) -> list[Shown]:
    """Run cells one after the other, with IPython's tracebacks in a mode."""
    arguments = [sys.executable, "-c", PROGRAM, json.dumps([cells, mode])]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=240, cwd=folder)
    assert not done.returncode, done.stderr
    return [Shown(*each) for each in json.loads(done.stdout.partition("SHOWN ")[2])]
