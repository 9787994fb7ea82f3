"""What a panel does with each message of its view.

Each is handled on the thread that handles the messages of the front end, and returns at once: nothing is computed here
but a probe, which reads a pixel of pictures that are there, and contrast limits, which are found in one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epypes.display import reset_display_ranges
from epypes.errors import EpypesError, InvalidValue
from epypes.run import CompGraphRunner
from epypes_widgets import settings
from epypes_widgets.cases import Cases
from epypes_widgets.picture.frames import scene
from epypes_widgets.picture.picture_settings import auto_limits
from epypes_widgets.picture.screen import Comparison
from epypes_widgets.picture.stages import probe
from epypes_widgets.promotion import BundleJob, Outcome
from epypes_widgets.tuning import Tuning
from epypes_widgets.view import Handler, Message

if TYPE_CHECKING:
    from epypes.display.previews.images import Range
    from epypes_widgets.panel import Panel


class Messages:
    """Handles the messages of a view.

    Parameters
    ----------
    panel
        Saves, loads, searches and writes back.
    tuning
        Does what else they ask for.
    cases
        Need to know whether there is a view.
    """

    def __init__(self, panel: Panel, tuning: Tuning, cases: Cases) -> None:
        self._panel, self._tuning, self._cases, self._screen = panel, tuning, cases, tuning.screen
        self._bundle_job = BundleJob(self._show_outcome)
        search = panel.search
        if search is not None:
            search.report = lambda: self._screen.view.tell("optimised", search.content())

    @property
    def handlers(self) -> dict[str, Handler]:
        """What is called with each kind of message."""
        tuning, screen = self._tuning, self._screen
        return {
            "ready": self._ready,
            "ping": lambda _: screen.view.tell("pong", {}),
            "seen": lambda _: tuning.seen(),
            "left": self._left,
            "hold": lambda message: tuning.controls.hold(message["names"]),
            "release": lambda _: tuning.release(),
            "set": lambda message: self._set(message["values"]),
            "move": self._move,
            "reset": lambda message: self._set(tuning.first_values(message["names"]), is_return=True),
            "live": self._live,
            "run": lambda _: tuning.run(),
            "image": lambda message: tuning.want_image(int(message["index"])),
            "stage": lambda message: tuning.look(token=screen.require_stage(message["token"])),
            "pin": self._pin,
            "compare": self._compare,
            "histogram": lambda message: tuning.look(has_histogram=bool(message["on"])),
            "scalars": lambda message: tuning.look(has_scalars=bool(message["on"])),
            "probe": self._probe,
            "picture": self._picture,
            "undo": lambda _: tuning.undo(),
            "redo": lambda _: tuning.go_to(tuning.history.redo),
            "goto": lambda message: tuning.go_to(lambda: tuning.history.goto(int(message["number"]))),
            "save": lambda message: self._file(message, self._saved),
            "load": lambda message: self._file(message, self._loaded),
            "promote": self._promote,
            "write_back": self._write_back,
            **dict.fromkeys(("optimise", "optimise_stop", "optimise_use"), self._optimise),
        }

    def _ready(self, _message: Message) -> None:
        self._tuning.release()  # a page that is loaded anew holds nothing
        self._screen.ready()
        self._tuning.come_back()
        self._cases.come_back()

    def _left(self, _message: Message) -> None:
        self._tuning.leave()
        self._cases.leave()

    # -- values -------------------------------------------------------------------------------------------------

    def _set(self, values: Mapping[str, Any], **how: bool) -> None:
        try:
            if values:
                self._tuning.want(values, **{"by_user": True, **how})
        except ValueError as error:
            self._screen.fail(str(error), names=tuple(values))

    def _move(self, message: Message) -> None:
        self._tuning.controls.slide(message["places"])
        self._set(message["values"], commit=False)
        if "image" in message:
            self._tuning.want_image(int(message["image"]), commit=False)

    def _live(self, message: Message) -> None:
        self._tuning.is_live = bool(message["on"])
        self._tuning.run()

    def _optimise(self, message: Message) -> None:
        search = self._panel.search
        if search is None:
            return
        if message["kind"] == "optimise":
            search.start(int(message["n"]))
        elif message["kind"] == "optimise_stop":
            search.stop()
        elif search.best is not None:
            self._set(search.best.setting, by_user=False)

    # -- looking ------------------------------------------------------------------------------------------------

    def _pin(self, message: Message) -> None:
        """Pin a token, or let go of it: a picture beneath the big one, a number as a tile."""
        token, screen = message["token"], self._screen
        is_tile = token in screen.tiles.offered
        pinned = screen.pinned_tiles if is_tile else screen.shown.pinned
        others = tuple(name for name in pinned if name != token)
        now = (*others, token if is_tile else screen.require_stage(token)) if message["on"] else others
        self._tuning.look(**{"tiles" if is_tile else "pinned": now})

    def _compare(self, message: Message) -> None:
        asked, comparison = message["with"], None
        if asked is not None:
            token = self._screen.require_stage(asked["token"]) if asked["kind"] == "stage" else ""
            comparison = Comparison(str(asked["kind"]), int(asked.get("number", 0)), token)
        self._tuning.look(comparison=comparison)

    def _picture(self, message: Message) -> None:
        token, change = str(message["token"]), dict(message["change"])
        if change.get("limits") == "auto":
            change["limits"] = self._auto_limits()
        elif "limits" in change and change["limits"] is None:
            reset_display_ranges(self._tuning.session.result or self._tuning.runner, token)
        self._screen.change_picture(token, change)
        if change.keys() & {"limits", "over"}:
            self._tuning.look()

    def _auto_limits(self) -> Range | None:
        run, token = self._tuning.session.result, self._screen.shown.token
        seen = None if run is None or token is None else scene(run, token)
        return None if seen is None else auto_limits(seen.backdrop.image)

    def _probe(self, message: Message) -> None:
        run, token = self._tuning.session.result, self._screen.shown.token
        seen = None if run is None or token is None else scene(run, token)
        if run is None or seen is None:
            return
        x, y = float(message["x"]), float(message["y"])
        rows = probe(run, self._screen.stages, x, y, seen)
        self._screen.view.tell("probe", {"id": message["id"], "x": x, "y": y, "rows": rows})

    # -- files, bundles -----------------------------------------------------------------------------------------

    def _file(self, message: Message, act: Callable[[str], str]) -> None:
        """Read or write settings, and say what came of it."""
        try:
            name = str(message["name"]).strip()
            if ".." in Path(name).parts:
                way_out = f"Name them {Path(name).name!r}; panel.save(path) and panel.load(path) take any path."
                raise InvalidValue(f"{name!r} has '..' in it, which leads out of a folder. {way_out}")
            text, is_done = act(name), True
        except (EpypesError, ValueError) as error:
            text, is_done = str(error), False
        self._screen.view.tell("settings", {"names": list(settings.names(".")), "text": text, "ok": is_done})

    def _saved(self, name: str) -> str:
        return f"Saved {self._panel.save(name)}."

    def _loaded(self, name: str) -> str:
        self._panel.load(name)
        return f"Loaded {name}."

    def _promote(self, message: Message) -> None:
        runner, to = self._tuning.runner, str(message["to"])
        if isinstance(runner, CompGraphRunner):
            self._bundle_job.promote(runner, to)
        else:
            text = "Not promoted: a running service is a bundle already. Write its values back."
            self._show_outcome(Outcome("promoted", "refused", text, to))

    def _write_back(self, message: Message) -> None:
        if self._tuning.session.is_service:
            self._bundle_job.write_back(self._panel.write_back, dry_run=bool(message["dry_run"]))
        else:
            text = "Not written: a runner has no bundle to write to. Promote it."
            self._show_outcome(Outcome("written", "refused", text))

    def _show_outcome(self, outcome: Outcome) -> None:
        content = asdict(outcome)
        self._screen.view.tell(content.pop("kind"), content)
