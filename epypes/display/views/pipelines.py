"""What is to be seen of a pipeline around its graph: its name, and the stages that events pass?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Final, Protocol

from epypes.display.markup import cut
from epypes.display.previews.short import reason
from epypes.display.views.graphview import GraphView, StageView
from epypes.run import CompGraphRunner

_KINDS: Final = ("queue", "loop", "function")
_STATES: Final = ("static", "running", "stopped", "failed")
_NOTE_CHARACTERS: Final = 200
_MOST_STAGES: Final = 12
_MOST_NOTES: Final = 6


class PipelineLike(Protocol):
    """What is shown of a pipeline."""

    @property
    def name(self) -> str:
        """Stands on the frame."""

    @property
    def runner(self) -> CompGraphRunner:
        """Is shown inside the frame."""

    @property
    def stages(self) -> Any:
        """Has ``before`` and ``after``: records with kind, name, state and notes."""


def in_pipeline(graph: GraphView, pipeline: PipelineLike) -> GraphView:
    """Return the view of a pipeline's graph with the frame and the stages around it.

    Stages that can't be had are left out: they come from properties that users may override.
    """
    title = str(pipeline.name) or "pipeline"
    try:
        stages = pipeline.stages
        before, after = _stage_views(stages.before), _stage_views(stages.after)
    except Exception as error:
        caption = f"its stages can't be told: {reason(error, _NOTE_CHARACTERS)}"
        return replace(graph, title=title, caption=". ".join(filter(None, (graph.caption, caption))))
    return replace(graph, title=title, before=before, after=after)


def _stage_views(stages: Sequence[Any]) -> tuple[StageView, ...]:
    return tuple(
        StageView(
            _one_of(stage.kind, _KINDS, "function"),
            cut(str(stage.name), _NOTE_CHARACTERS),
            _one_of(stage.state, _STATES, "static"),
            _notes(stage.notes),
        )
        for stage in stages[:_MOST_STAGES]
    )


def _one_of(word: Any, known: Sequence[Any], otherwise: Any) -> Any:
    return word if word in known else otherwise


def _notes(notes: Iterable[Any]) -> tuple[str, ...]:
    return tuple(cut(str(note), _NOTE_CHARACTERS) for note in tuple(notes)[:_MOST_NOTES])
