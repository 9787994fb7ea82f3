"""Choosing one setting of a sweep by a click on its picture."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

import anywidget

from epypes.batch.contact_sheet import Sheet, Tile, sheet_page, shown_tokens
from epypes.batch.grid import identity
from epypes.batch.mapping import SweepResult
from epypes.display.text import cut
from epypes.errors import EpypesError, InvalidType
from epypes_widgets.picture.static import Displayed, StaticOutput
from epypes_widgets.values import is_same, setting_text
from epypes_widgets.view import script, styles, use_subshell
from epypes_widgets.worker import Worker

_LOG: Final = logging.getLogger(__name__)
# More are no overview, and each is a picture of up to 5 KB.
_MAX_TILES: Final = 400
_TEXT_CHARACTERS: Final = 160
# A cell that changes the runner has done so after a few attempts.
_MAX_ATTEMPTS: Final = 5
_STATIC_S: Final = 0.5

Message = Mapping[str, Any]


class SheetView(anywidget.AnyWidget):
    """The contact sheet in the browser; to the kernel it sends ``ready``, ``pick`` and ``show``."""

    _esm = script("picker.js")
    _css = styles()


def pick(result: SweepResult, token: str | None = None, rows: str | None = None, columns: str | None = None) -> Picker:
    """Return the contact sheet of a sweep as a widget: a click on a tile sets the runner to that setting.

    Parameters
    ----------
    result
        What ``ep.sweep`` has returned. Its runner is set, and runs what is then stale on its last payload, so that
        open panels follow.
    token, rows, columns
        As for ``result.sheet``.

    Raises
    ------
    TypeError
        It is no result of a sweep.
    UnknownName, ScaleError
        As ``result.sheet`` does.
    """
    if not isinstance(result, SweepResult):
        raise InvalidType(f"pick takes what ep.sweep has returned, not {type(result).__name__!r}: pick(ep.sweep(...)).")
    return Picker(result, result.sheet(token, rows, columns))


class Picker(Displayed):
    """A contact sheet that is clicked; made by ``pick``.

    Attributes
    ----------
    result
        The sweep.
    """

    def __init__(self, result: SweepResult, sheet: Sheet) -> None:
        self.result, self._sheet = result, sheet
        # The first place of each setting.
        self._places = {self._key(result[place].setting): place for place in reversed(range(len(result)))}
        self._clicked: int | None = None
        self._text = ""
        self._is_seen = False
        self._worker = Worker("epypes-pick", self._failed)
        self._static = StaticOutput(lambda: sheet_page(self._sheet, self.chosen))
        self._view = SheetView()
        self._view.on_msg(self._answer)
        use_subshell(self._view)
        # The runner must not keep alive a picker that is not shown any more.
        changed = weakref.WeakMethod(self._runner_changed)
        self._unwatch = weakref.finalize(self, result.runner.watch(lambda: (method := changed()) and method()))

    @property
    def chosen(self) -> int | None:
        """The place in the result of the setting that the runner has; None if it has none of them."""
        now = self.result.runner.hyperparameters
        if self._clicked is not None:
            setting = self.result[self._clicked].setting
            if all(name in now and is_same(value, now[name]) for name, value in setting.items()):
                return self._clicked
        return self._places.get(self._key(now))

    def _key(self, values: Mapping[str, Any]) -> tuple[Any, ...]:
        return tuple(identity(values.get(name)) for name in self.result.names)

    @property
    def text(self) -> str:
        """The text below the sheet: what was set, or why nothing was."""
        return self._text

    @property
    def widget(self) -> Any:
        """The widget, to be put into a layout of one's own."""
        return self._view

    def choose(self, place: int) -> None:
        """Set the runner to the setting of an outcome, as a click on its tile does; returns at once.

        Raises
        ------
        IndexError
            There is no such outcome.
        """
        if not 0 <= place < len(self.result):
            raise IndexError(f"There is no outcome {place}; the sweep has {len(self.result)}.")
        self._worker.post("pick", partial(self._pick, place))

    def wait(self, timeout_s: float) -> None:
        """Return when the runner has what was chosen.

        Raises
        ------
        TimeoutError
            It took longer.
        """
        self._worker.wait(timeout_s)

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop following clicks and the runner; the sheet stays. May be called twice.

        Raises
        ------
        StillRunning
            A function did not return in time.
        """
        self._unwatch()
        self._worker.close(timeout_s)

    # -- on the worker's thread ---------------------------------------------------------------------------------

    def _pick(self, place: int) -> None:
        self._tell({"kind": "state", "chosen": place, "busy": True, "text": ""})
        self._clicked, self._text = place, self._set(self.result[place].setting)
        self._tell_state()

    def _set(self, setting: Mapping[str, Any]) -> str:
        """Set the runner and run what is stale, all or nothing; return the text for it."""
        runner, named = self.result.runner, setting_text(setting)
        if runner.last is None:
            runner.set(**setting)
            return f"Set: {named}. Nothing has been run yet."
        for _ in range(_MAX_ATTEMPTS):
            run = runner.trial(setting)
            if run.failure is not None:
                return f"Not set, since it fails: {run.failure}"
            if runner.adopt(run):
                return f"Set: {named}"
        return "Not set, since the runner is being changed by something else. Try again."

    def _failed(self, error: BaseException) -> None:
        if not isinstance(error, EpypesError):
            _LOG.error("A setting could not be picked", exc_info=error)
        self._text = f"Not set: {error}"
        self._tell_state()

    def _runner_changed(self) -> None:
        self._worker.post("state", self._tell_state)

    # -- the view -----------------------------------------------------------------------------------------------

    def _answer(self, _view: object, content: Any, _buffers: object) -> None:
        kind = content.get("kind")
        if kind == "ready":
            self._is_seen = True
            self._tell_sheet()
        elif kind == "pick":
            self.choose(int(content["place"]))
        elif kind == "show" and content["token"] in self._tokens:
            self._sheet = self.result.sheet(content["token"], self._sheet.rows, self._sheet.columns)
            self._tell_sheet()

    @property
    def _tokens(self) -> list[str]:
        return list(shown_tokens(self.result.runner.cg, self.result))

    def _tell(self, content: Message, buffers: Sequence[bytes] = ()) -> None:
        if self._is_seen:
            self._view.send(content, list(buffers))

    def _tell_state(self) -> None:
        text = cut(self._text, 2 * _TEXT_CHARACTERS)
        self._tell({"kind": "state", "chosen": self.chosen, "busy": False, "text": text})
        self._worker.post("static", self._static.update, _STATIC_S, is_work=False)

    def _tell_sheet(self) -> None:
        shown = self._sheet.first(_MAX_TILES)
        pictures: dict[bytes, int] = {}
        tiles = partial(_tile, self.result, pictures)
        blocks = [
            {"title": block.title, "rows": [[[*map(tiles, cell)] for cell in row] for row in block.rows]}
            for block in shown.blocks
        ]
        content = {
            "kind": "sheet",
            "token": self._sheet.token,
            "tokens": self._tokens,
            "rows": shown.rows,
            "columns": shown.columns,
            "row_labels": list(shown.row_labels),
            "column_labels": list(shown.column_labels),
            "blocks": blocks,
            "left_out": len(self._sheet.tiles) - len(shown.tiles),
        }
        self._tell(content, list(pictures))
        self._tell_state()

    # -- itself -------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"<Picker: {len(self.result)} outcomes of {', '.join(self.result.names):.40}; chosen: {self.chosen}>"


def _tile(result: SweepResult, pictures: dict[bytes, int], tile: Tile) -> dict[str, Any]:
    """Return a tile as the view knows it; ``pictures`` gets its picture if that is not in it."""
    shown = tile.thumbnail
    return {
        "place": tile.place,
        "label": tile.label,
        "numbers": list(tile.numbers),
        "text": cut(tile.text, _TEXT_CHARACTERS),
        "failed": tile.has_failed,
        "setting": setting_text(result[tile.place].setting),
        "picture": None if shown is None else pictures.setdefault(shown.data, len(pictures)),
        "media_type": "" if shown is None else shown.media_type,
    }
