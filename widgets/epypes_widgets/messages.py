"""What does a panel do when its view says something?

Each answer is made on the thread that answers the front end, and returns at once: nothing is computed here but a probe,
which reads a pixel of pictures that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from epypes.errors import EpypesError
from epypes.run import CompGraphRunner
from epypes_widgets import settings
from epypes_widgets.looking.overlay import scene
from epypes_widgets.looking.probe import probe
from epypes_widgets.picture import Message
from epypes_widgets.promotion import Outcome, Promotion
from epypes_widgets.searching import Searching, told
from epypes_widgets.shown import Comparison
from epypes_widgets.tuning import Tuning
from epypes_widgets.writeback import WritingBack, Written


class Messages:
    """Takes the messages of a view.

    Parameters
    ----------
    tuning
        Does what they ask for.
    save, load
        Write the present values to a file, and set those of one.
    search
        Of hyperparameters; None if there is no metric.
    """

    def __init__(
        self, tuning: Tuning, save: Callable[[str], Path], load: Callable[[str], None], search: Searching | None
    ) -> None:
        self._tuning, self._save_to, self._load_from, self.search = tuning, save, load, search
        if search is not None:
            search.report = lambda _: self._tuning.screen.view.tell("optimised", told(search) or {})
        self.promotion = Promotion(self._promoted)
        self.writing_back = WritingBack(self._written)

    @property
    def handlers(self) -> dict[str, Callable[[Message], object]]:
        """What is called with each kind of message."""
        tuning = self._tuning
        return {
            "ready": self._ready,
            "hold": lambda message: tuning.hand.hold(message["names"]),
            "release": lambda _: tuning.release(),
            "set": lambda message: self._set(message["values"]),
            "move": self._move,
            "reset": self._reset,
            "stage": lambda message: self._look(token=tuning.screen.require_stage(message["token"])),
            "pin": self._pin,
            "compare": self._compare,
            "histogram": lambda message: self._look(has_histogram=bool(message["on"])),
            "live": self._live,
            "run": lambda _: tuning.run(),
            "probe": self._probe,
            "image": lambda message: tuning.want_image(int(message["index"])),
            "undo": lambda _: tuning.go_to(tuning.history.undo),
            "redo": lambda _: tuning.go_to(tuning.history.redo),
            "goto": lambda message: tuning.go_to(lambda: tuning.history.goto(int(message["number"]))),
            "save": lambda message: self._file(self._saved, message),
            "load": lambda message: self._file(self._loaded, message),
            "promote": self._promote,
            "write_back": self._write_back,
            "optimise": self._optimise,
            "optimise_stop": self._stop,
            "optimise_use": lambda _: self._use_best(),
            "seen": lambda _: tuning.seen(),
            "left": lambda _: tuning.leave(),
        }

    def _ready(self, _message: Message) -> None:
        self._tuning.release()  # a page that is loaded anew holds nothing
        self._tuning.screen.ready()
        self._tuning.come_back()

    # -- values -------------------------------------------------------------------------------------------------

    def _move(self, message: Message) -> None:
        self._tuning.hand.slide(message["places"])
        if message["values"]:
            self._set(message["values"], commit=False)

    def _set(self, values: Mapping[str, Any], *, commit: bool = True) -> None:
        # What the view sets is what the hand holds.
        values = self._tuning.hand.uncontested(values)
        self._tuning.hand.moved(values)
        try:
            self._tuning.want(values, commit=commit, is_by_hand=True)
        except ValueError as error:
            self._tuning.screen.fail(str(error), names=tuple(values))

    def _reset(self, message: Message) -> None:
        first, controls = self._tuning.runner.first_hyperparameters, self._tuning.hand.values
        names = message["names"] or controls
        self._set({name: first[name] for name in names if name in first and name in controls})

    def _live(self, message: Message) -> None:
        self._tuning.is_live = bool(message["on"])
        self._tuning.run()

    # -- looking ------------------------------------------------------------------------------------------------

    def _look(self, **parts: Any) -> None:
        self._tuning.screen.change(**parts)
        self._tuning.look()

    def _pin(self, message: Message) -> None:
        screen = self._tuning.screen
        token = screen.require_stage(message["token"])
        self._look(pinned=screen.shown.with_pin(token, on=bool(message["on"])).pinned)

    def _compare(self, message: Message) -> None:
        asked, screen = message["with"], self._tuning.screen
        if asked is None:
            self._look(comparison=None)
            return
        token = screen.require_stage(asked["token"]) if asked["kind"] == "stage" else ""
        self._look(comparison=Comparison(str(asked["kind"]), int(asked.get("number", 0)), token))

    def _probe(self, message: Message) -> None:
        screen, run = self._tuning.screen, self._tuning.session.result
        token = screen.shown.token
        seen = None if run is None or token is None else scene(run, token)
        if run is None or seen is None:
            return
        x, y = float(message["x"]), float(message["y"])
        rows = probe(run, screen.stages, x, y, seen)
        screen.view.tell("probe", {"id": message["id"], "x": x, "y": y, "rows": rows})

    # -- remembering --------------------------------------------------------------------------------------------

    def _file(self, act: Callable[[str], str], message: Message) -> None:
        """Read or write settings, and tell what came of it."""
        try:
            said, is_done = act(str(message["name"]).strip()), True
        except (EpypesError, ValueError) as error:
            said, is_done = str(error), False
        names = list(settings.names("."))
        self._tuning.screen.view.tell("settings", {"names": names, "said": said, "ok": is_done})

    def _saved(self, name: str) -> str:
        return f"Saved {self._save_to(name).name}."

    def _loaded(self, name: str) -> str:
        self._load_from(name)
        return f"Loaded {name}."

    # -- optimising ---------------------------------------------------------------------------------------------

    def _optimise(self, message: Message) -> None:
        if self.search is not None:
            self.search.start(int(message["n"]))

    def _stop(self, _message: Message) -> None:
        if self.search is not None:
            self.search.stop()

    def _use_best(self) -> None:
        setting = None if self.search is None else self.search.found.setting
        if setting is None:
            return
        try:
            self._tuning.want(setting)
        except (EpypesError, ValueError) as error:
            self._tuning.screen.fail(str(error), names=tuple(setting))

    # -- promoting ----------------------------------------------------------------------------------------------

    def _promote(self, message: Message) -> None:
        runner, to = self._tuning.runner, str(message["to"])
        if isinstance(runner, CompGraphRunner):
            self.promotion.start(runner, to)
        else:
            text = (
                "Not promoted: a running service is a bundle already. Write its values back, or promote the notebook."
            )
            self._promoted(Outcome("refused", text, to))

    def _write_back(self, message: Message) -> None:
        place = self._tuning.session.place
        if place.is_written_back:
            self.writing_back.start(place.owner, dry_run=bool(message["dry_run"]))
        else:
            self._written(Written("refused", "Not written: a runner has no bundle to write to. Promote it."))

    def _written(self, told: Written) -> None:
        content = {"state": told.state, "text": told.text, "diff": told.diff}
        self._tuning.screen.view.tell("written", content)

    def _promoted(self, outcome: Outcome) -> None:
        screen = self._tuning.screen
        screen.view.tell("promoted", {"state": outcome.state, "text": outcome.text, "to": outcome.to})
        if outcome.printed:
            screen.log(f"Printed while promoting: {outcome.printed}")
