"""The two nodes that answer a request, and their messages: acquisition finds the images, vision finds the keypoints.

They are the same in every layout, and know nothing of sockets. Requests and answers are messages of 2019: an Event, a
JustBytes. A pair of images is an Envelope. Attributes are doubles, in seconds.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any, Final

import numpy as np

from epypes.acquisition import ImageAcquisition, camera
from epypes.errors import MessageError
from epypes.experiment.graph import Array, orb_graph, orb_hyperparameters, stereo_pair
from epypes.graph import CompGraph
from epypes.pipeline import EventView, FullPipeline
from epypes.run import Failure
from epypes.wire import Envelope, Event, JustBytes, add_attribute, attributes, parsed

REQUEST: Final = "vision_request"
PAIR: Final = "epypes.experiment.pair"
T_VREQ: Final = "t_vreq"
_IMAGES: Final = ("image_1", "image_2")
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
    """

    cameras: tuple[str | int, ...] = ()
    fps: float = 5.0
    workers: int = 1
    unsafe_pickle: bool = False


# -- messages --------------------------------------------------------------------------------------------------------


def time_of_request(request: Event | bytes) -> float:
    """Return the time whose images a request asks for: Unix time in seconds.

    Raises
    ------
    MessageError
        It is no Event, or has no attribute ``t_vreq``.
    """
    found = attributes(parsed(Event, request) if isinstance(request, bytes) else request).get(T_VREQ)
    if not isinstance(found, float):
        raise MessageError("no time", f"A request needs the attribute {T_VREQ!r}: Unix time in seconds, a double.")
    return found


def images_of(message: Any) -> dict[str, Any]:
    """Return the two images of a message from acquisition, by token of the vision graph.

    Raises
    ------
    MessageError
        Of reason ``"no pair"`` if it is something else.
    """
    if not isinstance(message, Envelope) or message.type != PAIR or message.parts.keys() != {*_IMAGES}:
        raise MessageError("no pair", f"Vision takes pairs of images, not {message!r:.200}.")
    return dict(message.parts)


def with_attributes(message: Any, values: Mapping[str, Any]) -> Any:
    """Return a message with more attributes: another Envelope, or the same JustBytes."""
    if isinstance(message, Envelope):
        return replace(message, attributes={**message.attributes, **values})
    for key, value in values.items():
        add_attribute(message, key, value)
    return message


def encode_keypoints(keypoints: Array, *, unsafe_pickle: bool = False) -> bytes:
    """Return matched coordinates, (rows, 4), as the contents of an answer: float32, little-endian, row after row.

    With ``unsafe_pickle``, as the pickle that a peer of 2019 reads.
    """
    if unsafe_pickle:
        # Protocol 2, and the module's name of that time: NumPy 2 has moved it, and can still read both.
        return pickle.dumps(keypoints, 2).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n", 1)
    return keypoints.astype("<f4", copy=False).tobytes()


def decode_keypoints(contents: bytes, *, unsafe_pickle: bool = False) -> Array:
    """Return the matched coordinates in the contents of an answer.

    Parameters
    ----------
    unsafe_pickle
        Whether the contents are a pickle, as a peer of 2019 sends them. The sender of a pickle can run any code in this
        process.

    Raises
    ------
    MessageError
        Of reason ``"pickle"`` if they are a pickle and ``unsafe_pickle`` is not set, ``"bad contents"`` if they can't
        be read.
    """
    # Every pickle ends with this byte; as the last byte of a float32 it would be a coordinate of 1e-10 pixels.
    if contents.endswith(pickle.STOP) and not unsafe_pickle:
        raise MessageError("pickle", "The contents are a pickle, which is read with unsafe_pickle=True alone.")
    try:
        if unsafe_pickle:
            found: Array = np.asarray(pickle.loads(contents))  # noqa: S301 - under the option named unsafe
        else:
            found = np.frombuffer(contents, "<f4").reshape(-1, 4)
    except Exception as error:  # broken bytes make pickle raise anything
        raise MessageError("bad contents", f"The contents can't be read: {error}") from error
    return found


# -- nodes -----------------------------------------------------------------------------------------------------------


class Component(FullPipeline):
    """A FullPipeline that writes its times into its answers, as attributes under its name.

    These are ``t_react``, ``t_fin_start``, ``t_fin_end``, ``t_fout_start``, ``t_fout_end`` and ``t_pub`` (Unix time),
    ``t_p`` (duration of the pipeline's graph) and ``o_cg`` (the part of it in none of its functions), all of them in
    seconds.

    Parameters
    ----------
    f_in
        Called with an event; returns its payload.
    f_out
        Called with the view of an event; returns the answer without its times: an Envelope or a JustBytes.

    The other parameters are those of FullPipeline.
    """

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer with its times on q_out."""
        # Read before anything else: to write the times is no part of them.
        put_ns = perf_counter_ns()
        stamps = view.stamps
        times_ns = {
            "t_pub": view.unix_ns(put_ns),
            "t_react": stamps.react_ns,
            "t_fin_start": stamps.f_in_start_ns,
            "t_fin_end": stamps.f_in_end_ns,
            "t_fout_start": stamps.f_out_start_ns,
            "t_fout_end": stamps.f_out_end_ns,
        }
        # t_p and o_cg are the paper's: the pipeline's own time as a node, and what its nodes' times leave of it.
        times_s = {"t_p": self.time, "o_cg": self.compute_overhead()}
        times_s |= {name: time_ns / _NS for name, time_ns in times_ns.items()}
        super().put(with_attributes(answer, {f"{self.name}.{name}": time for name, time in times_s.items()}), view)

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

        def nearest(t_vreq: float) -> tuple[Any, ...]:
            return tuple(frame.image for frame in self.cameras.nearest(round(t_vreq * _NS)))

        def pair(view: EventView) -> Envelope:
            parts = {name: view[name] for name in _IMAGES}
            return Envelope(PAIR, parts, view.event.id, source=self.name, attributes={T_VREQ: view[T_VREQ]})

        super().__init__(
            "acquisition",
            CompGraph({"nearest": nearest}, {"nearest": (T_VREQ, _IMAGES)}),
            q_in,
            q_out,
            lambda request: {T_VREQ: time_of_request(request)},
            pair,
        )

    def handle(self, event: Any) -> None:
        """Answer a request, which comes as bytes; a failure has its id, and f_in refuses what is no request."""
        with suppress(MessageError):
            event = parsed(Event, event)
        super().handle(event)

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


class Vision(Component):
    """The component that runs the ORB graph on pairs, and answers with the first 20 rows of matched keypoints."""

    def __init__(self, q_in: Any, q_out: Any, settings: Settings) -> None:
        def answer(view: EventView) -> Any:
            contents = encode_keypoints(view["keypoints_paired"][:_ROWS], unsafe_pickle=settings.unsafe_pickle)
            return with_attributes(JustBytes(contents=contents, id=view.event.id), view.event.attributes)

        super().__init__(
            "vision",
            orb_graph(),
            q_in,
            q_out,
            images_of,
            answer,
            hparams=orb_hyperparameters(),
            workers=settings.workers,
        )


COMPONENTS: Final[Mapping[str, Callable[[Any, Any, Settings], Component]]] = {
    "acquisition": Acquisition,
    "vision": Vision,
}
