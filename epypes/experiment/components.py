"""Which two pipelines answer a request? Acquisition, which finds the images, and vision, which finds the keypoints.

They are the same in every layout, and know nothing of sockets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from epypes.acquisition import ImageAcquisition, camera
from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
from epypes.experiment.messages import T_VREQ, Request, StereoPair, contents_of, read_request
from epypes.graph import CompGraph
from epypes.pipeline import EventView, FullPipeline
from epypes.pipeline.reactive import FIn
from epypes.run import Failure
from epypes.wire import JustBytes, add_attribute

ROWS: Final = 20
_NS: Final = 1_000_000_000
# An older frame than this is no answer, unless a camera is as slow: so many of its frames may be missing.
_MAX_AGE_S: Final = 1.0
_MOST_MISSED: Final = 3
# What a component writes into its answers; the last two when f_out has returned.
_TIMES: Final = ("t_react", "t_fin_start", "t_fin_end", "t_p", "o_cg", "t_fout_start", "t_fout_end", "t_pub")

Pack = Callable[[EventView], Any]
AddAttribute = Callable[[Any, str, float], None]
SetAttribute = Callable[[Any, int, str, float], None]


@dataclass(frozen=True, slots=True)
class Settings:
    """What the nodes are made with.

    Attributes
    ----------
    cameras
        Two sources as `epypes.camera` takes them, each a path or the number of a device; none for the stereo pair
        that comes with scikit-image.
    fps
        Frames per second of cameras that are files.
    workers
        How many functions of the graph may run at once.
    unsafe_pickle
        Whether the contents of answers are pickled, for a peer of 2019.
    keys
        The .key_secret file of the pair that all nodes have in common; empty for none.
    allow
        The .key files, or folders of them, of who else may connect.
    """

    cameras: tuple[str | int, ...] = ()
    fps: float = 5.0
    workers: int = 1
    unsafe_pickle: bool = False
    keys: str = ""
    allow: tuple[str, ...] = ()


class Component(FullPipeline):
    """A FullPipeline that writes its times into its answers, as attributes under its name.

    These are ``t_react``, ``t_fin_start``, ``t_fin_end``, ``t_fout_start``, ``t_fout_end`` and ``t_pub`` (Unix time),
    ``t_p`` (how long the pipeline's graph took) and ``o_cg`` (how much of that was in none of its functions), all of
    them in seconds.

    Parameters
    ----------
    pack
        Makes an answer from the event's view; it is f_out but for the times.
    add
        Adds an attribute to an answer.
    set_last
        Sets one that has been added: given the answer, its place from the end (-1 is the last), its key and the value.
    """

    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_in: Any,
        q_out: Any,
        f_in: FIn,
        pack: Pack,
        add: AddAttribute,
        set_last: SetAttribute,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
    ) -> None:
        super().__init__(name, cg, q_in, q_out, f_in, self._answer, hparams, workers=workers)
        self.pack, self.add, self.set_last = pack, add, set_last
        *self._keys, self._t_fout_end, self._t_pub = (f"{name}.{time}" for time in _TIMES)

    def _answer(self, view: EventView) -> Any:
        answer = self.pack(view)
        stamps = view.stamps
        # t_p and o_cg are the paper's: the pipeline's own time as a node, and what its nodes' times leave of it.
        times = (
            stamps.react_ns / _NS,
            stamps.f_in_start_ns / _NS,
            stamps.f_in_end_ns / _NS,
            self.time,
            self.compute_overhead(),
            stamps.f_out_start_ns / _NS,
        )
        for key, time in zip(self._keys, times, strict=True):
            self.add(answer, key, time)
        # Their values are not known yet; to set them takes less of the time that they are about than to add them.
        self.add(answer, self._t_fout_end, 0.0)
        self.add(answer, self._t_pub, 0.0)
        return answer

    def put(self, answer: Any, view: EventView) -> None:
        """Write the end of f_out and the time of publishing into an answer, then put it on q_out."""
        self.set_last(answer, -2, self._t_fout_end, view.stamps.f_out_end_ns / _NS)
        self.set_last(answer, -1, self._t_pub, view.stamps.now_ns() / _NS)
        super().put(answer, view)

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Return whether it can answer, within ``timeout_s`` seconds of being started."""
        return True


class Acquisition(Component):
    """The component whose graph finds the frames nearest to a time; its cameras run while it listens."""

    def __init__(self, q_in: Any, q_out: Any, settings: Settings) -> None:
        sources = settings.cameras or stereo_pair()
        self.cameras = ImageAcquisition(
            *(camera(source, fps=settings.fps) for source in sources),
            # Of slow cameras the newest frame is older.
            max_age_s=max(_MAX_AGE_S, _MOST_MISSED / settings.fps),
            on_error=self._report_camera,
        )
        cg = acquisition_graph(self.cameras)
        super().__init__("acquisition", cg, q_in, q_out, payload_of_request, pack_pair, add_to_pair, set_in_pair)

    def listen(self, timeout_s: float = 0.5) -> None:
        """Start the cameras and the event loop."""
        self.cameras.start()
        super().listen(timeout_s)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop the event loop and the cameras."""
        try:
            super().stop(timeout_s)
        finally:
            self.cameras.stop(timeout_s)

    def _report_camera(self, index: int, exception: BaseException) -> None:
        if self.on_error is not None:
            self.on_error(Failure(f"camera {index}", (), {}, exception, source=self.name))

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Return whether every camera has given a frame within ``timeout_s`` seconds."""
        return self.cameras.wait_for_frames(timeout_s)


def acquisition_graph(cameras: ImageAcquisition) -> CompGraph:
    """Return the graph with one function, from a time to the images that are nearest to it."""

    def nearest(t_vreq: float) -> tuple[Any, ...]:
        return tuple(frame.image for frame in cameras.nearest(round(t_vreq * _NS)))

    return CompGraph({"nearest": nearest}, {"nearest": (T_VREQ, "pair")})


def payload_of_request(event: Request) -> dict[str, Any]:
    """Return the payload of the acquisition's graph: the f_in for an Event's bytes."""
    return {T_VREQ: read_request(event)}


def pack_pair(view: EventView) -> StereoPair:
    """Return the images, with the id and the time of the request."""
    return StereoPair(view["pair"], view.event.id, {T_VREQ: view[T_VREQ]})


def add_to_pair(pair: StereoPair, key: str, value: float) -> None:
    """Add an attribute to a pair."""
    pair.attributes[key] = value


def set_in_pair(pair: StereoPair, _place: int, key: str, value: float) -> None:
    """Set an attribute of a pair."""
    pair.attributes[key] = value


def vision(q_in: Any, q_out: Any, settings: Settings) -> Component:
    """Return the component that runs the ORB graph on pairs."""
    pack = pack_pickled if settings.unsafe_pickle else pack_keypoints
    cg, hparams = orb_graph(), orb_hyperparameters()
    return Component(
        "vision",
        cg,
        q_in,
        q_out,
        payload_of_pair,
        pack,
        add_attribute,
        set_in_answer,
        hparams,
        workers=settings.workers,
    )


def payload_of_pair(pair: StereoPair) -> dict[str, Any]:
    """Return the payload of the ORB graph: the f_in for a pair."""
    image_1, image_2 = pair
    return {"image_1": image_1, "image_2": image_2}


def set_in_answer(answer: JustBytes, place: int, _key: str, value: float) -> None:
    """Set an attribute that has been added to an answer."""
    answer.attributes.entries[place].double_val = value


def pack_keypoints(view: EventView) -> JustBytes:
    """Return the first 20 rows of the matched keypoints, with what is known of the request so far."""
    return _answer(view, contents_of(view["keypoints_paired"][:ROWS]))


def pack_pickled(view: EventView) -> JustBytes:
    """Return the same for a peer of 2019, which expects a pickle."""
    return _answer(view, contents_of(view["keypoints_paired"][:ROWS], unsafe_pickle=True))


def _answer(view: EventView, contents: bytes) -> JustBytes:
    answer = JustBytes(contents=contents, id=view.event.id)
    for key, value in view.event.attributes.items():
        add_attribute(answer, key, value)
    return answer


NODES: Final[Mapping[str, Callable[[Any, Any, Settings], Component]]] = {"acquisition": Acquisition, "vision": vision}
