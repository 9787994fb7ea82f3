"""The two pipelines that answer a request: acquisition finds the images, vision finds the keypoints.

They are the same in every layout, and know nothing of sockets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from epypes.acquisition import ImageAcquisition, camera
from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
from epypes.experiment.messages import T_VREQ, Request, StereoPair, encode_keypoints
from epypes.graph import CompGraph
from epypes.pipeline import EventView, FullPipeline
from epypes.run import Failure
from epypes.wire import JustBytes, add_attribute

_ROWS: Final = 20
_NS: Final = 1_000_000_000
# An older frame than this is no answer, unless a camera is as slow: so many of its frames may be missing.
_MAX_AGE_S: Final = 1.0
_MAX_MISSED: Final = 3


@dataclass(frozen=True, slots=True)
class Settings:
    """The options of the nodes.

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
        The .key files, or folders of them, of further peers that may connect.
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
    ``t_p`` (duration of the pipeline's graph) and ``o_cg`` (the part of it in none of its functions), all of them in
    seconds. A subclass makes an answer of the event's view in `pack`, and adds attributes to it in `add`.
    """

    def __init__(
        self, name: str, cg: CompGraph, q_in: Any, q_out: Any, hparams: Any = None, *, workers: int = 1
    ) -> None:
        super().__init__(name, cg, q_in, q_out, self.payload, self.answer, hparams, workers=workers)

    def payload(self, event: Any) -> Mapping[str, Any]:
        """Return the payload of an event: the f_in."""
        raise NotImplementedError

    def pack(self, view: EventView) -> Any:
        """Return the answer without its times."""
        raise NotImplementedError

    def add(self, answer: Any, key: str, value: float) -> None:
        """Add an attribute to an answer."""
        raise NotImplementedError

    def answer(self, view: EventView) -> Any:
        """Return the answer with the times so far: the f_out."""
        answer, stamps = self.pack(view), view.stamps
        # t_p and o_cg are the paper's: the pipeline's own time as a node, and what its nodes' times leave of it.
        times = {
            "t_react": stamps.react_ns / _NS,
            "t_fin_start": stamps.f_in_start_ns / _NS,
            "t_fin_end": stamps.f_in_end_ns / _NS,
            "t_p": self.time,
            "o_cg": self.compute_overhead(),
            "t_fout_start": stamps.f_out_start_ns / _NS,
        }
        for key, value in times.items():
            self.add(answer, f"{self.name}.{key}", value)
        return answer

    def put(self, answer: Any, view: EventView) -> None:
        """Add the end of f_out and the time of publishing to an answer, then put it on q_out."""
        t_pub = view.stamps.now_ns() / _NS
        self.add(answer, f"{self.name}.t_fout_end", view.stamps.f_out_end_ns / _NS)
        self.add(answer, f"{self.name}.t_pub", t_pub)
        super().put(answer, view)

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Return whether it can answer, within ``timeout_s`` seconds of being started."""
        return True


class Acquisition(Component):
    """The component whose graph finds the frames nearest to a time; its cameras run while it listens."""

    def __init__(self, q_in: Any, q_out: Any, settings: Settings) -> None:
        self.cameras = ImageAcquisition(
            *(camera(source, fps=settings.fps) for source in settings.cameras or stereo_pair()),
            # Of slow cameras the newest frame is older.
            max_age_s=max(_MAX_AGE_S, _MAX_MISSED / settings.fps),
            on_error=self._report_camera,
        )
        super().__init__("acquisition", acquisition_graph(self.cameras), q_in, q_out)

    def payload(self, event: Request) -> Mapping[str, Any]:
        """Return the time that a request asks for."""
        return {T_VREQ: event.t_vreq}

    def pack(self, view: EventView) -> StereoPair:
        """Return the images, with the id and the time of the request."""
        return StereoPair(view["pair"], view.event.id, {T_VREQ: view[T_VREQ]})

    def add(self, answer: StereoPair, key: str, value: float) -> None:
        """Add an attribute to a pair."""
        answer.attributes[key] = value

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

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Return whether every camera has given a frame within ``timeout_s`` seconds."""
        return self.cameras.wait_for_frames(timeout_s)

    def _report_camera(self, index: int, exception: BaseException) -> None:
        if self.on_error is not None:
            self.on_error(Failure(f"camera {index}", (), {}, exception, source=self.name))


def acquisition_graph(cameras: ImageAcquisition) -> CompGraph:
    """Return the graph with one function, from a time to the images that are nearest to it."""

    def nearest(t_vreq: float) -> tuple[Any, ...]:
        return tuple(frame.image for frame in cameras.nearest(round(t_vreq * _NS)))

    return CompGraph({"nearest": nearest}, {"nearest": (T_VREQ, "pair")})


class Vision(Component):
    """The component that runs the ORB graph on pairs."""

    def __init__(self, q_in: Any, q_out: Any, settings: Settings) -> None:
        self.unsafe_pickle = settings.unsafe_pickle
        super().__init__("vision", orb_graph(), q_in, q_out, orb_hyperparameters(), workers=settings.workers)

    def payload(self, event: StereoPair) -> Mapping[str, Any]:
        """Return the two images of a pair."""
        image_1, image_2 = event
        return {"image_1": image_1, "image_2": image_2}

    def pack(self, view: EventView) -> JustBytes:
        """Return the first 20 rows of the matched keypoints, with the attributes of the pair."""
        contents = encode_keypoints(view["keypoints_paired"][:_ROWS], unsafe_pickle=self.unsafe_pickle)
        answer = JustBytes(contents=contents, id=view.event.id)
        for key, value in view.event.attributes.items():
            add_attribute(answer, key, value)
        return answer

    def add(self, answer: JustBytes, key: str, value: float) -> None:
        """Add an attribute to an answer."""
        add_attribute(answer, key, value)


COMPONENTS: Final[Mapping[str, Callable[[Any, Any, Settings], Component]]] = {
    "acquisition": Acquisition,
    "vision": Vision,
}
