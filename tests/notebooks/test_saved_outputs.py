"""What the saved outputs of the tutorials contain."""

from __future__ import annotations

import json
import re
from pathlib import Path

TUTORIALS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
# Encoded pictures have slashes and words, too: before these no other character of theirs may stand.
MACHINE_PATH = re.compile(r"(?<![\w+/.])/(?:tmp|home|root|Users|work|mnt|opt)/[^\s\"'<>\\]*")


def test_no_output_holds_a_path_of_the_machine_that_executed_the_tutorial():
    found = {}
    for path in TUTORIALS:
        for cell in json.loads(path.read_text())["cells"]:
            found.setdefault(path.name, []).extend(MACHINE_PATH.findall(json.dumps(cell.get("outputs", []))))
    assert len(found) == len(TUTORIALS) > 0
    assert not any(found.values()), found
