"""Does pipeline.toml say of a hyperparameter what a service needs, and nothing of how it is tuned?"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import epypes as ep
from epypes.bundle.settings import Settings, read_settings, write_settings


def cut(
    image: Any,
    part: Annotated[tuple, ep.Roi("image")],
    level: Annotated[int, ep.Param(0, 255, unit="DN", soft=(0, 100), cuts="image", about="What counts as bright.")],
    how: Annotated[int, ep.Param(choices=(0, 1), labels=("FAST", "EXACT"))],
) -> Any:
    return image


def test_ranges_and_their_words_are_kept_and_what_only_a_picture_needs_is_left_out(tmp_path: Path) -> None:
    cg = ep.CompGraph.from_functions(cut)
    values = {"part": (1, 2, 30, 40), "level": 100, "how": 1}
    write_settings(tmp_path / "pipeline.toml", Settings("cut", ("image",), ("cut",), values), cg)
    written = tomllib.loads((tmp_path / "pipeline.toml").read_text())["hyperparameters"]
    assert written == {
        "part": {"value": [1, 2, 30, 40], "kind": "tuple"},
        "level": {
            "value": 100, "low": 0, "high": 255, "soft": [0, 100], "unit": "DN", "about": "What counts as bright.",
        },
        "how": {"value": 1, "choices": [0, 1], "labels": ["FAST", "EXACT"]},
    }  # fmt: skip
    assert read_settings(tmp_path / "pipeline.toml").hyperparameters == values
