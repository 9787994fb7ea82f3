"""EPypes 0.1 in terms of this one: what it called otherwise, the new form, and what the old name answers.

``MODULES`` has the names of its modules, ``MEMBERS`` the attributes of its classes; renamed parameters are in
``epypes.deprecation``, which sends old names here. Modules that exist no more are made of the table when they are
imported. ``docs/from_0_1.md`` is this table for readers, and is tested against it.
"""

from __future__ import annotations

import importlib
import queue
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from epypes.deprecation import describe, old_names
from epypes.errors import InvalidValue
from epypes.graph import CompGraph, extend, rename, union
from epypes.optional import optional_import
from epypes.pipeline import EventLoop, Mailbox, Node, NodeBasedCompGraph, Pipeline, SinkPipeline, wait
from epypes.run import CompGraphRunner

if TYPE_CHECKING:
    import networkx as nx

    from epypes.pipeline import EventView


class Old(NamedTuple):
    """One name of EPypes 0.1.

    Attributes
    ----------
    new
        The new form, as the warning or the error says it.
    value
        Makes what the name stands for, of the object that has it, None for a module's; None if the name raises.
    """

    new: str
    value: Callable[[Any], Any] | None = None

    def answer(self, owner: Any, name: str, error: type[Exception]) -> Any:
        """Return what the name stands for, with a warning at the line that uses it; or raise the error.

        It is called by a ``__getattr__`` or a descriptor, which that line has called.
        """
        if self.value is None:
            raise error(describe(name, self.new))
        warnings.warn(describe(name, self.new), DeprecationWarning, stacklevel=3)
        return self.value(owner)


def _moved(path: str, new: str = "") -> Old:
    """Return the entry of what has another place: ``epypes.graph.CompGraph``."""
    module, _, name = path.rpartition(".")

    def load(_: Any) -> Any:
        with optional_import():
            return getattr(importlib.import_module(module), name)

    return Old(new or f"ep.{name}", load)


def _function(new: str, function: Any) -> Old:
    return Old(new, lambda _: function)


def _method(new: str, function: Callable[..., Any]) -> Old:
    return Old(new, lambda owner: partial(function, owner))


# -- functions and classes --------------------------------------------------------------------------------------------


def _graph_union_with_suffixing(
    cg1: CompGraph, cg2: CompGraph, suff_1: str = "_1", suff_2: str = "_2", exclude: Iterable[str] | None = None
) -> CompGraph:
    """Unite two graphs under suffixes; tokens in ``exclude`` get none, functions always do."""
    kept = frozenset(exclude or ())

    def suffixed(cg: CompGraph, ending: str) -> CompGraph:
        tokens = {token: token + ending for token in cg.tokens if token not in kept}
        return rename(cg, {name: name + ending for name in cg.functions}, tokens)

    return union(suffixed(cg1, suff_1), suffixed(cg2, suff_2))


def _create_nodes(cg: CompGraph) -> dict[str, Node]:
    return dict(NodeBasedCompGraph(cg).nodes)


def _node_based_graph(func_dict: Mapping[str, Callable[..., Any]], func_io: Any) -> NodeBasedCompGraph:
    return NodeBasedCompGraph(CompGraph(func_dict, func_io))


def _networkx_with_style(shown: Any, style_attrs: Mapping[str, Any] | None = None) -> Any:
    graph = _networkx_of_runner(shown) if isinstance(shown, CompGraphRunner) else shown.to_networkx()
    for attributes in dict(graph.nodes).values():
        attributes.update(style_attrs or {})
    return graph


def _networkx_of_runner(runner: CompGraphRunner) -> nx.DiGraph[str]:
    """Return the graph with plain names as vertices and Graphviz's attributes of styles, as 0.1 gave it."""
    graph = runner.cg.to_networkx()
    styles: dict[str, dict[str, Any]] = {"function": {"bipartite": 0, "shape": "rect"}, "token": {"bipartite": 1}}
    frozen = {"style": "filled", "fillcolor": "gray"}
    with optional_import():
        import networkx as nx
    made: nx.DiGraph[str] = nx.DiGraph()
    for kind, name in graph:
        dashed = {"style": "dashed"} if kind == "function" and name in runner.cg.placeholders else {}
        special = frozen if kind == "token" and name in runner.hyperparameters else dashed
        made.add_node(name, **styles[kind], **special)
    made.add_edges_from((left, right) for (_, left), (_, right) in graph.edges)
    return made


def _generate_code(name: str, cg: CompGraph, frozen_tokens: Mapping[str, Any], return_tokens: Iterable[str]) -> str:
    from epypes.bundle import to_source

    return to_source(cg, frozen_tokens, returns=tuple(return_tokens), name=name)


def _attach(pipeline: Pipeline, nd: Node, tokens_as_input: Any, names_of_outputs: Any, new_name: str) -> Pipeline:
    cg = extend(pipeline.cg, {nd.name: nd}, {nd.name: (tokens_as_input, names_of_outputs)})
    return Pipeline(new_name, cg, pipeline.runner.hyperparameters)


def _queue_putter(func: Callable[[Any], Any], q_out: Any) -> Callable[[Any], None]:
    return lambda event: q_out.put(func(event))


def _subscriber(server_address: str, q: Any, sub_prefix: str = "") -> Any:
    if sub_prefix:
        new = "ep.ZMQSubscriber(address, queue), and look at the first bytes of each message in f_in"
        raise InvalidValue(describe("sub_prefix=", new))
    with optional_import():
        from epypes.transport import ZMQSubscriber
    return ZMQSubscriber(server_address, q)


def _publisher(server_address: str, q: Any) -> Any:
    with optional_import():
        from epypes.transport import ZMQPublisher
    # A Mailbox hands its items to the publisher itself, which takes bytes.
    return ZMQPublisher(server_address, q if isinstance(q, Mailbox) else _EncodedQueue(q))


class _EncodedQueue:
    """A queue whose texts are taken as bytes, as 0.1 sent them."""

    def __init__(self, q: Any) -> None:
        self._q = q

    def get(self, *args: Any, **kwargs: Any) -> Any:
        item = self._q.get(*args, **kwargs)
        return item.encode() if isinstance(item, str) else item

    def __getattr__(self, name: str) -> Any:
        return getattr(self._q, name)


def _create_queues() -> tuple[queue.Queue[Any], queue.Queue[Any], queue.Queue[Any]]:
    return queue.Queue(), queue.Queue(), queue.Queue()


def _dispatch_images(images: Sequence[Any]) -> dict[str, Any]:
    if len(images) == 1:
        return {"image": images[0]}
    return {f"image_{number}": image for number, image in enumerate(images, 1)}


class _ReactiveVisionSystem:
    """A subscriber, a grabber, a pipeline and a publisher, started from the end and stopped from the beginning."""

    def __init__(self, subscriber: Any, grabber: Any, pipeline: Any, publisher: Any) -> None:
        self._subscriber, self._grabber, self._pipeline, self._publisher = subscriber, grabber, pipeline, publisher

    def start(self, verbose: bool = False) -> None:
        self._publisher.start()
        self._pipeline.listen()
        self._grabber.start(show_video=False)
        self._subscriber.start()

    def stop(self, verbose: bool = False) -> None:
        for part in (self._subscriber, self._grabber, self._pipeline, self._publisher):
            part.stop()


# -- attributes of classes --------------------------------------------------------------------------------------------


class _TokenManagerOf:
    """The tokens of a runner, read as those of the TokenManager that it had in 0.1."""

    def __init__(self, runner: CompGraphRunner) -> None:
        self._runner = runner

    @property
    def frozen_values(self) -> dict[str, Any]:
        return dict(self._runner.hyperparameters)

    @property
    def frozen(self) -> set[str]:
        return set(self._runner.hyperparameters)

    @property
    def free(self) -> set[str]:
        return {*self._runner.cg.tokens} - self.frozen

    @property
    def free_source_tokens(self) -> set[str]:
        return set(self._runner.free_source_tokens)

    def __getitem__(self, token_name: str) -> Any:
        return self._runner[token_name]

    token_value = __getitem__

    def get_values(self, names: Iterable[str] | None = None, deepcopy: bool = False) -> dict[str, Any]:
        # Without names all tokens, None for those that have no value.
        return {name: self._runner.get(name) for name in names or self._runner.cg.tokens}

    def freeze_token(self, token_name: str, token_value: Any) -> None:
        self._runner.freeze(**{token_name: token_value})


def _freeze(runner: CompGraphRunner, token_name: str, token_value: Any) -> None:
    runner.freeze(**{token_name: token_value})


def _modify_frozen(pipeline: Pipeline, token_name: str, new_value: Any) -> None:
    pipeline.runner.freeze(**{token_name: new_value})


def _set_attribute(pipeline: Pipeline, k: str, v: Any) -> None:
    pipeline.attributes[k] = v


def _get_attribute(pipeline: Pipeline | EventView, k: str) -> Any:
    return pipeline.attributes.get(k)


def _read(tokens: Any, token_name: str) -> Any:
    return tokens[token_name]


def _values(tokens: Any, names: Iterable[str] | None = None, deepcopy: bool = False) -> dict[str, Any]:
    return {name: tokens[name] for name in (tokens if names is None else names)}


def _set_exception_handler(loop: EventLoop, handler: Callable[[BaseException, Any], None]) -> None:
    pipeline = loop.callback
    loop.on_error = lambda event, exception: handler(exception, pipeline)
    if isinstance(pipeline, SinkPipeline):
        pipeline.on_error = lambda failure: handler(failure.exception, pipeline)


def _join_endpoint(endpoint: Any, timeout: float | None = None) -> bool:
    """Wait while there is something to publish or to work on; not for a subscriber or publisher that was stopped."""
    return not endpoint.is_connected or wait(timeout)


# -- the table --------------------------------------------------------------------------------------------------------

_OF_GRAPH: Final = (
    "Digraph", "BipartiteDigraph", "DepthFirstSearch", "DepthFirstOrder", "DirectedCycle", "create_set_of_vertices",
)  # fmt: skip
_OF_PAYLOAD: Final = (
    "copy_input_splitter", "elementwise_input_splitter", "equal_input_splitter", "split_payload_and_build_tokens",
)  # fmt: skip
_DIGRAPH: Final = Old("cg.digraph, which has inputs, outputs, producer, consumers and run_order()")
_CHUNKS: Final = Old("numpy.array_split(images, n); or ep.map(runner, images, executor=...), which shares out the work")
_RENAMING: Final = Old("ep.rename(cg, functions={...}, tokens={...})")
_FIXED: Final = Old("runner.freeze(token=value): a TokenManager holds what one run has computed, and does not change")

_WIRE: Final = {
    module: {name: _moved(f"epypes.wire.{name}", f"epypes.wire.{name}") for name in names}
    for module, names in {
        "epypes.protobuf.attributes_pb2": ("Attribute", "AttributeList"),
        "epypes.protobuf.event_pb2": ("Event",),
        "epypes.protobuf.image_pb2": ("Image",),
        "epypes.protobuf.imagepair_pb2": ("ImagePair",),
        "epypes.protobuf.justbytes_pb2": ("JustBytes",),
        "epypes.protobuf.timestamp_pb2": ("TimeStamp", "TimeStampList"),
    }.items()
}

MODULES: Final[Mapping[str, Mapping[str, Old]]] = {
    "epypes.compgraph": {
        "CompGraph": _moved("epypes.graph.CompGraph"),
        "CompGraphRunner": _moved("epypes.run.CompGraphRunner"),
        "TokenManager": _moved("epypes.run.TokenManager"),
        "NodeBasedCompGraph": _function("ep.NodeBasedCompGraph(cg)", _node_based_graph),
        "FunctionPlaceholder": _moved("epypes.graph.Placeholder"),
        "UndefinedSourceTokensException": _moved("epypes.errors.PayloadError", "ep.errors.PayloadError"),
        "graph_union": _function("ep.union(g1, g2), or g1 | g2", union),
        "graph_union_with_suffixing": _function(
            'ep.union(g1, g2, suffixes=("_1", "_2"), keep=[...])', _graph_union_with_suffixing
        ),
        "add_new_vertices": _function("ep.extend(cg, func_dict, func_io)", extend),
        "create_nodes_from_comp_graph": _function("ep.NodeBasedCompGraph(cg).nodes", _create_nodes),
        "get_networkx_graph": _function("ep.show(cg), or cg.to_networkx()", _networkx_with_style),
        "rename_in_dict": _RENAMING,
        "add_suffix_to_dict_values": _RENAMING,
        "merge_dicts": Old("ep.union(g1, g2)"),
        "common_func_names_exist": Old("ep.union(g1, g2), which names functions that two graphs have"),
    },
    "epypes.graph": dict.fromkeys(_OF_GRAPH, _DIGRAPH),
    "epypes.pipeline": {"attach": _function("ep.Pipeline(name, ep.extend(pipe.cg, {...}, {...}), hparams)", _attach)},
    "epypes.node": {"Node": _moved("epypes.pipeline.Node")},
    "epypes.loop": {
        "EventLoop": _moved("epypes.pipeline.EventLoop"),
        "CommonEventLoop": _moved("epypes.pipeline.EventLoop", "ep.EventLoop(q_in, callback)"),
    },
    "epypes.zeromq": {
        "ZeroMQSubscriber": _function("ep.ZMQSubscriber(address, queue)", _subscriber),
        "ZeroMQPublisher": _function("ep.ZMQPublisher(address, queue)", _publisher),
    },
    "epypes.queue": {
        "Queue": _moved("queue.Queue", "queue.Queue, or ep.Mailbox, which drops events that arrive too fast"),
        "create_queue_putter": _function("ep.FullPipeline, which puts what f_out returns on q_out", _queue_putter),
    },
    "epypes.reactivevision": {
        "create_queues": _function("queue.Queue() for each", _create_queues),
        "dispatch_images": _function('a function of your own: {"image_1": images[0], ...}', _dispatch_images),
        "ReactiveVisionSystem": _function("with publisher, pipe, subscriber: ep.wait()", _ReactiveVisionSystem),
    },
    "epypes.payload": dict.fromkeys(_OF_PAYLOAD, _CHUNKS),
    "epypes.codegen": {
        "generate_code_from_compgraph": _function("ep.to_source(cg, hparams, returns=[...])", _generate_code),
        "format_args": Old("ep.to_source(cg, hparams)"),
        "format_kwargs": Old("ep.to_source(cg, hparams)"),
    },
    "epypes.cli": {"parse_pubsub_args": Old("argparse; or epypes serve BUNDLE --sub ADDRESS --pub ADDRESS")},
    "epypes.commons": {"GenericObject": Old("a class of your own with an attribute name")},
    "epypes.util": {
        "generate_short_uuid": Old("uuid.uuid4().hex[:8]"),
        "create_name_with_uuid": Old("uuid.uuid4().hex[:8]"),
        "create_basic_queue": _moved("queue.Queue", "queue.Queue()"),
    },
    "epypes.protobuf": {},
    **_WIRE,
    "epypes.protobuf.pbtypes": {
        **{name: old for names in _WIRE.values() for name, old in names.items()},
        "enable_protobuf_types": Old("nothing: the classes of epypes.wire need no path"),
    },
    "epypes.protobuf.pbprocess": {
        "add_attribute": _moved("epypes.wire.add_attribute", "epypes.wire.add_attribute"),
        "get_attributes_dict": Old("epypes.wire.attributes(message)"),
        "copy_downstream_attributes": Old("message.attributes.entries.extend(earlier.attributes.entries)"),
    },
}  # fmt: skip

_TOKEN_VALUE: Final = _method('pipe["token"]', _read)

MEMBERS: Final[Mapping[str, Mapping[str, Old]]] = {
    "CompGraph": {
        "graph": _DIGRAPH,
        "to_cg_with_nodes": _method("ep.NodeBasedCompGraph(cg)", NodeBasedCompGraph),
    },
    "CompGraphRunner": {
        "token_value": _method('runner["token"]', _read),
        "freeze_token": _method('runner["token"] = value, or runner.freeze(token=value)', _freeze),
        "frozen_tokens": Old("runner.hyperparameters", lambda runner: dict(runner.hyperparameters)),
        "required_source_tokens": Old("runner.free_source_tokens", lambda runner: set(runner.free_source_tokens)),
        "token_manager": Old("runner itself, a mapping of its tokens; or runner.hyperparameters", _TokenManagerOf),
        "to_networkx": _method("ep.show(runner), or runner.cg.to_networkx()", _networkx_of_runner),
    },
    "TokenManager": {
        "token_value": _method('tokens["token"]', _read),
        "get_values": _method("dict(run)", _values),
        "freeze_token": _FIXED,
        "save_payload_value": _FIXED,
        "frozen_values": Old("runner.hyperparameters"),
        "frozen": Old("runner.hyperparameters"),
        "free": Old("runner.free_source_tokens"),
        "free_source_tokens": Old("runner.free_source_tokens"),
        "to_networkx": Old("ep.show(runner), or runner.cg.to_networkx()"),
    },
    "Pipeline": {
        "token_value": _TOKEN_VALUE,
        "modify_frozen_token": _method('pipe["token"] = value', _modify_frozen),
        "set_attr": _method('pipe.attributes["key"] = value', _set_attribute),
        "get_attr": _method('pipe.attributes["key"]', _get_attribute),
        "cgraph": Old("pipe.cg; its nodes are pipe.network.nodes", lambda pipe: pipe.network),
    },
    "EventView": {
        "token_value": _method('view["token"]', _read),
        "get_attr": _method('view.attributes["key"]', _get_attribute),
        "cgraph": Old("view.run.cg", lambda view: view.run.cg),
        "runner": Old('view["token"], or view.run: what f_out gets is the view of one event'),
        "set_attr": Old('pipe.attributes["key"] = value: what f_out gets is the view of one event'),
        "modify_frozen_token": Old('pipe["token"] = value: what f_out gets is the view of one event'),
    },
    "EventLoop": {
        "set_exception_handler": _method("pipe.on_error = function(failure)", _set_exception_handler),
        "is_alive": Old("loop.is_running", lambda loop: lambda: loop.is_running),
    },
    "Endpoint": {"join": _method("ep.wait(); stop() alone waits until it has stopped", _join_endpoint)},
    "PayloadError": {"missing_source_tokens": Old("error.tokens", lambda error: set(error.tokens))},
}


def member(kind: type, name: str) -> Old | None:
    """Return the entry of an attribute that a class, or one above it, had in 0.1."""
    tables = (MEMBERS.get(above.__name__, {}) for above in kind.__mro__ if above.__module__.startswith("epypes."))
    return next((table[name] for table in tables if name in table), None)


# -- modules that are gone --------------------------------------------------------------------------------------------


class _Loader:
    """Makes a module of 0.1 whose names answer from the table."""

    def create_module(self, spec: ModuleSpec) -> None:
        """Leave it to the import system."""

    def exec_module(self, module: ModuleType) -> None:
        table = MODULES[module.__name__]
        module.__doc__ = "Names of EPypes 0.1; see docs/from_0_1.md."
        module.__dict__["__getattr__"] = old_names(module.__name__)
        module.__dict__["__all__"] = [name for name, old in table.items() if old.value is not None]


def find_spec(name: str) -> ModuleSpec | None:
    """Return the spec of a module of 0.1 that nothing else has found; None for any other name."""
    return ModuleSpec(name, _Loader(), is_package=name == "epypes.protobuf") if name in MODULES else None  # type: ignore[arg-type]
