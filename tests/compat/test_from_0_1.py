"""Programs of EPypes 0.1 run; each of its names works or raises as docs/from_0_1.md says, and tells the new form."""

from __future__ import annotations

import importlib
import inspect
import queue
import re
import runpy
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import epypes as ep
from epypes import compat, deprecation
from epypes.wire import Event, JustBytes

ROOT = Path(__file__).parents[2]
# Each asserts what it computes, and passes with the published package too.
PROGRAMS = sorted((Path(__file__).parent / "programs").glob("*.py"))
TIMEOUT_S = 60

CG = ep.CompGraph({"f": lambda x, k: x + k}, {"f": (("x", "k"), "y")})
OTHER = ep.CompGraph({"g": abs}, {"g": ("y", "z")})


def ran_runner():
    runner = ep.CompGraphRunner(CG, {"k": 1})
    runner.run(x=2)
    return runner


def ran_pipeline():
    pipe = ep.Pipeline("p", CG, {"k": 1})
    pipe.run(x=2)
    pipe.attributes["a"] = 5
    return pipe


def view_of_event():
    """Return the view that f_out gets, of a run whose y is 3."""
    answers = queue.Queue()
    pipe = ep.SourcePipeline("p", CG, answers, lambda view: view, {"k": 1})
    pipe.attributes["a"] = 5
    pipe.run(x=2)
    return answers.get(timeout=TIMEOUT_S)


def stopped_endpoint():
    return ep.ZMQPublisher("tcp://127.0.0.1:*", queue.Queue())


def missing_payload():
    with pytest.raises(ep.errors.PayloadError) as caught:
        ep.CompGraphRunner(CG, {"k": 1}).run()
    return caught.value


OBJECTS = {
    "CompGraph": lambda: CG,
    "CompGraphRunner": ran_runner,
    "TokenManager": lambda: ran_runner().last.tokens,
    "Pipeline": ran_pipeline,
    "EventView": view_of_event,
    "EventLoop": lambda: ep.EventLoop(queue.Queue(), print),
    "Endpoint": stopped_endpoint,
    "PayloadError": missing_payload,
}


def has_frozen(runner_or_pipeline, change):
    change("k", 7)
    return runner_or_pipeline["k"] == 7


def handles(loop):
    seen = queue.Queue()
    loop.callback = None
    loop.set_exception_handler(lambda exception, pipeline: seen.put((exception, pipeline)))
    loop.on_error("event", "exception")
    return seen.get(timeout=TIMEOUT_S) == ("exception", None)


def starts_in_order(system_class):
    calls = []

    def part(name):
        return SimpleNamespace(
            start=lambda **_: calls.append(f"start {name}"),
            listen=lambda: calls.append(f"start {name}"),
            stop=lambda: calls.append(f"stop {name}"),
        )

    system = system_class(*map(part, "sgpo"))
    system.start(verbose=True)
    system.stop()
    return calls == [f"{what} {name}" for what, order in (("start", "opgs"), ("stop", "sgpo")) for name in order]


def receives_text(publisher_class):
    outlet, received = queue.Queue(), queue.SimpleQueue()
    with (
        publisher_class("tcp://127.0.0.1:*", outlet) as publisher,
        ep.ZMQSubscriber(publisher.address, received) as inlet,
    ):
        inlet.wait_joined()
        outlet.put("text")
        return received.get(timeout=TIMEOUT_S) == b"text"


def receives_bytes(subscriber_class):
    outlet, received = ep.Mailbox("block", 8), queue.SimpleQueue()
    publisher = ep.ZMQPublisher("tcp://127.0.0.1:*", outlet)
    with publisher, subscriber_class(server_address=publisher.start().address, q=received) as inlet:
        inlet.wait_joined()
        outlet.put(b"bytes")
        return received.get(timeout=TIMEOUT_S) == b"bytes"


def puts(create_queue_putter):
    found = queue.Queue()
    create_queue_putter(abs, found)(-3)
    return found.get_nowait() == 3


def generated(generate):
    namespace = {}
    cg = ep.CompGraph({"size": abs, "top": max}, {"size": ("x", "y"), "top": (("y", "k"), "z")})
    exec(generate("run", cg, {"k": 5}, ["z"]), namespace)
    return namespace["run"](-9) == 9


def same(new):
    return lambda old: old is new


def message(kind):
    return lambda old: old is getattr(importlib.import_module("epypes.wire"), kind)


def attributes_of(add):
    made = JustBytes(contents=b"")
    add(made, "key", 3)
    return made.attributes.entries[0].int_val == 3


# What each name that works does, of the object that it stands for; for attributes also of their owner.
NAMES = {
    "epypes.compgraph.CompGraph": same(ep.CompGraph),
    "epypes.compgraph.CompGraphRunner": same(ep.CompGraphRunner),
    "epypes.compgraph.TokenManager": same(ep.TokenManager),
    "epypes.compgraph.NodeBasedCompGraph": lambda old: set(old(func_dict=dict(CG.functions), func_io=dict(CG.func_io)).nodes) == {"f"},
    "epypes.compgraph.FunctionPlaceholder": lambda old: isinstance(old(), ep.Placeholder),
    "epypes.compgraph.UndefinedSourceTokensException": same(ep.errors.PayloadError),
    "epypes.compgraph.graph_union": lambda old: old(CG, OTHER).sink_tokens == ("z",),
    "epypes.compgraph.graph_union_with_suffixing": lambda old: (
        set(old(CG, CG, suff_1="_l", suff_2="_r", exclude=["k", "f", "unknown"]).tokens) == {"x_l", "y_l", "x_r", "y_r", "k"}
        and set(old(CG, CG).functions) == {"f_1", "f_2"}
    ),
    "epypes.compgraph.add_new_vertices": lambda old: old(CG, {"g": abs}, {"g": ("y", "z")}).sink_tokens == ("z",),
    "epypes.compgraph.create_nodes_from_comp_graph": lambda old: old(CG)["f"](1, 2) == 3,
    "epypes.compgraph.get_networkx_graph": lambda old: old(ran_runner(), {"color": "red"}).nodes["x"]["color"] == "red",
    "epypes.pipeline.attach": lambda old: (
        old(ran_pipeline(), ep.Node("g", abs), ("y",), "z", "q").run(x=-5)["z"] == 4
    ),
    "epypes.node.Node": same(ep.Node),
    "epypes.loop.EventLoop": same(ep.EventLoop),
    "epypes.loop.CommonEventLoop": same(ep.EventLoop),
    "epypes.zeromq.ZeroMQSubscriber": receives_bytes,
    "epypes.zeromq.ZeroMQPublisher": receives_text,
    "epypes.queue.Queue": same(queue.Queue),
    "epypes.queue.create_queue_putter": puts,
    "epypes.reactivevision.create_queues": lambda old: len({id(made) for made in old()}) == 3,
    "epypes.reactivevision.dispatch_images": lambda old: (old("a"), old("ab")) == ({"image": "a"}, {"image_1": "a", "image_2": "b"}),
    "epypes.reactivevision.ReactiveVisionSystem": starts_in_order,
    "epypes.codegen.generate_code_from_compgraph": generated,
    "epypes.util.create_basic_queue": lambda old: old().empty(),
    "epypes.protobuf.pbprocess.add_attribute": attributes_of,
    **{f"epypes.protobuf.pbtypes.{kind}": message(kind) for kind in compat.MODULES["epypes.protobuf.pbtypes"] if kind[0].isupper()},
    **{
        f"{module}.{kind}": message(kind)
        for module, names in compat.MODULES.items()
        if module.endswith("_pb2")
        for kind in names
    },
}  # fmt: skip
ATTRIBUTES = {
    "CompGraph.to_cg_with_nodes": lambda old, cg: set(old().nodes) == {"f"},
    "CompGraphRunner.token_value": lambda old, runner: old("y") == 3,
    "CompGraphRunner.freeze_token": lambda old, runner: has_frozen(runner, old) and runner.rerun()["y"] == 9,
    "CompGraphRunner.frozen_tokens": lambda old, runner: old == {"k": 1},
    "CompGraphRunner.required_source_tokens": lambda old, runner: old == {"x"},
    "CompGraphRunner.token_manager": lambda old, runner: (
        (old.frozen_values, old.frozen, old.free, old.free_source_tokens) == ({"k": 1}, {"k"}, {"x", "y"}, {"x"})
        and old["y"] == old.token_value("y") == old.get_values()["y"] == 3
        and has_frozen(runner, old.freeze_token)
    ),
    "CompGraphRunner.to_networkx": lambda old, runner: set(old().edges) == {("x", "f"), ("k", "f"), ("f", "y")},
    "TokenManager.token_value": lambda old, tokens: old("y") == 3,
    "TokenManager.get_values": lambda old, tokens: (old(), old(["x"], deepcopy=True)) == ({"x": 2, "k": 1, "y": 3}, {"x": 2}),
    "Pipeline.token_value": lambda old, pipe: old("y") == 3,
    "Pipeline.modify_frozen_token": lambda old, pipe: has_frozen(pipe, old),
    "Pipeline.set_attr": lambda old, pipe: old("b", 1) is None and pipe.attributes["b"] == 1,
    "Pipeline.get_attr": lambda old, pipe: (old("a"), old("no")) == (5, None),
    "Pipeline.cgraph": lambda old, pipe: old.nodes["f"] is pipe.network.nodes["f"],
    "EventView.token_value": lambda old, view: old("y") == 3,
    "EventView.get_attr": lambda old, view: (old("a"), old("no")) == (5, None),
    "EventView.cgraph": lambda old, view: old is view.run.cg,
    "EventLoop.set_exception_handler": lambda old, loop: handles(loop),
    "EventLoop.is_alive": lambda old, loop: old() is False,
    "Endpoint.join": lambda old, endpoint: old() is True,
    "PayloadError.missing_source_tokens": lambda old, error: old == {"x"},
}  # fmt: skip


def rows(heading):
    """Return the rows of the table under a heading of the page: old names, the new form, and whether they work."""
    text = (ROOT / "docs/from_0_1.md").read_text(encoding="utf-8")
    section = text.split(f"## {heading}\n")[1].partition("\n## ")[0]
    found = {}
    for line in section.splitlines():
        if not line.startswith("| `"):
            continue
        old, new, works, why = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:5])
        assert why
        for name in re.findall("`([^`]+)`", old):
            assert name not in found
            found[name] = new.strip("`").replace("\\|", "|"), {"works": True, "raises": False}[works]
    return found


MODULE_ROWS, MEMBER_ROWS, PARAMETER_ROWS = map(rows, ("Names of modules", "Attributes of classes", "Parameters"))


def test_the_page_lists_what_the_tables_have():
    for listed, table in ((MODULE_ROWS, compat.MODULES), (MEMBER_ROWS, compat.MEMBERS)):
        assert listed == {
            f"{home}.{name}": (old.new, old.value is not None)
            for home, names in table.items()
            for name, old in names.items()
        }
    parameters = {f"{old}=": (f"{new}=", True) for old, new in deprecation.RENAMED.items()}
    parameters |= {f"{old}=": (new, False) for old, new in deprecation.REMOVED.items()}
    assert parameters == PARAMETER_ROWS
    assert {kind: set(names) for kind, names in deprecation.OLD_MEMBERS.items()} == {
        kind: set(names) for kind, names in compat.MEMBERS.items()
    }


def test_every_name_that_works_is_tried_here():
    assert {name for name, (_, works) in MODULE_ROWS.items() if works} == NAMES.keys()
    assert {name for name, (_, works) in MEMBER_ROWS.items() if works} == ATTRIBUTES.keys()


@pytest.mark.parametrize("name", MODULE_ROWS)
def test_a_name_of_a_module_works_or_raises_and_says_the_new_form(name):
    module, _, attribute = name.rpartition(".")
    new, works = MODULE_ROWS[name]
    statement = f"from {module} import {attribute} as found"
    namespace = {}
    if not works:
        with pytest.raises(ImportError, match=re.escape(f"{name} is of EPypes 0.1. Write {new}.")):
            exec(statement, namespace)
        return
    with pytest.warns(DeprecationWarning, match=re.escape(f"{name} is of EPypes 0.1. Write {new}.")):
        exec(statement, namespace)
    assert NAMES[name](namespace["found"])


@pytest.mark.parametrize("name", MEMBER_ROWS)
def test_an_attribute_works_or_raises_and_says_the_new_form(name):
    kind, _, attribute = name.partition(".")
    new, works = MEMBER_ROWS[name]
    owner = OBJECTS[kind]()
    text = re.escape(f".{attribute} is of EPypes 0.1. Write {new}.")
    assert attribute not in dir(owner), "what is old is not offered"
    if not works:
        with pytest.raises(AttributeError, match=text):
            getattr(owner, attribute)
        assert not hasattr(owner, attribute)
        return
    with pytest.warns(DeprecationWarning, match=text):
        value = getattr(owner, attribute)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        assert ATTRIBUTES[name](value, owner)


def f_in(event):
    return {"x": event}


def f_out(view):
    return view["y"]


Q = queue.Queue()
# By old parameter: what takes it, its other arguments, and whether the value arrived.
CALLS = {
    "comp_graph=": (lambda **old: ep.Pipeline("p", hparams={"k": 1}, **old), CG, lambda made: made.cg),
    "frozen_tokens=": (lambda **old: ep.CompGraphRunner(CG, **old), {"k": 4}, lambda made: dict(made.hyperparameters)),
    "event_dispatcher=": (lambda **old: ep.SinkPipeline("p", CG, Q, **old), f_in, lambda made: made.f_in),
    "out_prep_func=": (lambda **old: ep.FullPipeline("p", CG, Q, Q, f_in, **old), f_out, lambda made: made.f_out),
    "q=": (lambda **old: ep.EventLoop(callback=print, **old), Q, lambda made: made.q_in),
    "callback_func=": (lambda **old: ep.EventLoop(Q, **old), print, lambda made: made.callback),
    "callback_pipeline=": (lambda **old: ep.EventLoop(Q, **old), print, lambda made: made.callback),
    "func_v_attr=": (CG.to_networkx, {}, None),
    "token_v_attr=": (CG.to_networkx, {}, None),
    "edge_attr=": (CG.to_networkx, {}, None),
}


@pytest.mark.parametrize("name", PARAMETER_ROWS)
def test_a_parameter_works_or_raises_and_says_the_new_form(name):
    new, works = PARAMETER_ROWS[name]
    call, value, read = CALLS[name]
    text = re.escape(f"{name} is of EPypes 0.1. Write {new}.")
    if not works:
        with pytest.raises(TypeError, match=text):
            call(**{name[:-1]: value})
        return
    with pytest.warns(DeprecationWarning, match=text):
        made = call(**{name[:-1]: value})
    assert read(made) == value


@pytest.mark.parametrize(
    "kind", [ep.CompGraphRunner, ep.Pipeline, ep.SourcePipeline, ep.SinkPipeline, ep.FullPipeline, ep.EventLoop]
)
def test_an_old_parameter_is_not_part_of_the_signature(kind):
    assert not set(inspect.signature(kind.__init__).parameters) & {*deprecation.RENAMED, *deprecation.REMOVED}


def test_an_old_parameter_beside_its_new_name_raises():
    with pytest.raises(TypeError, match="hparams= is given twice: frozen_tokens= is its name"):
        ep.CompGraphRunner(CG, frozen_tokens={"k": 1}, hparams={"k": 2})


def test_a_parameter_that_never_was_raises_as_ever():
    with pytest.raises(TypeError, match="unexpected keyword argument 'frozen_token'"):
        ep.CompGraphRunner(CG, frozen_token={"k": 1})


@pytest.mark.parametrize(
    "module", ["epypes.compgraph", "epypes.pipeline", "epypes.graph", "epypes.protobuf", "epypes.wire"]
)
def test_a_module_has_no_other_names(module):
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = importlib.import_module(module).no_such_name


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'epypes\.never'"):
        importlib.import_module("epypes.never")


def test_a_starred_import_gives_what_works():
    namespace = {}
    with pytest.warns(DeprecationWarning, match="is of EPypes 0.1"):
        exec("from epypes.compgraph import *", namespace)
    assert namespace["CompGraph"] is ep.CompGraph
    assert "merge_dicts" not in namespace


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_a_program_of_0_1_runs(program):
    before = set(threading.enumerate())
    runpy.run_path(str(program), run_name="__main__")
    left = [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("epypes ")]
    for thread in left:
        thread.join(TIMEOUT_S)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_the_warnings_of_a_program_point_at_its_own_lines(program):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        runpy.run_path(str(program), run_name="__main__")
    found = [each for each in caught if each.category is DeprecationWarning and "EPypes 0.1" in str(each.message)]
    assert found
    assert {each.filename for each in found} == {str(program)}
    lines = program.read_text(encoding="utf-8").splitlines()
    for each in found:
        # The last part of a name, or the parameter, stands in that line, or in the call that begins there.
        name = re.split(r"[.=]", str(each.message).partition(" is of EPypes")[0].rstrip("="))[-1]
        assert any(name in line for line in lines[each.lineno - 1 : each.lineno + 10])


def test_the_warning_is_shown_to_a_script_and_names_its_line(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import epypes.compgraph\n\ncg = epypes.compgraph.CompGraph({'f': abs}, {'f': ('x', 'y')})\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True, timeout=TIMEOUT_S)
    assert (
        f"{script}:3: DeprecationWarning: epypes.compgraph.CompGraph is of EPypes 0.1. Write ep.CompGraph."
        in done.stderr
    )


def test_a_pipeline_that_answers_events_loads_nothing_of_it():
    code = (
        "import sys, queue, epypes as ep\n"
        "cg = ep.CompGraph({'f': abs}, {'f': ('x', 'y')})\n"
        "with ep.FullPipeline('p', cg, queue.Queue(), q := queue.Queue(), lambda e: {'x': e}, lambda v: v['y']) as p:\n"
        "    p.q_in.put(-1); assert q.get(timeout=60) == 1\n"
        "assert 'epypes.compat' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-I", "-c", code], check=True, timeout=TIMEOUT_S)


def test_an_attribute_error_inside_a_property_is_told_as_it_is():
    class Mine(ep.Pipeline):
        @property
        def lens(self):
            return self.attributes.no_such_attribute

    with pytest.raises(AttributeError, match="'dict' object has no attribute 'no_such_attribute'"):
        _ = Mine("p", CG, {"k": 1}).lens


def test_a_prefix_of_messages_is_refused_with_the_way_out():
    with pytest.warns(DeprecationWarning, match="ep.ZMQSubscriber"):
        from epypes.zeromq import ZeroMQSubscriber
    with pytest.raises(ValueError, match="look at the first bytes"):
        ZeroMQSubscriber("tcp://127.0.0.1:5555", queue.Queue(), "prefix")


def test_an_event_that_the_old_classes_made_is_read():
    with pytest.warns(DeprecationWarning, match="epypes.wire.Event"):
        from epypes.protobuf.pbtypes import Event as OldEvent
    assert OldEvent is Event


def test_a_handler_of_a_pipelines_loop_gets_the_exception_and_the_pipeline():
    seen = queue.Queue()
    pipe = ep.SinkPipeline("p", ep.CompGraph({"f": lambda x: 1 / x}, {"f": ("x", "y")}), queue.Queue(), f_in)
    with pytest.warns(DeprecationWarning, match="set_exception_handler"):
        pipe.loop.set_exception_handler(lambda exception, pipeline: seen.put((exception, pipeline)))
    with pipe:
        pipe.q_in.put(0)
        exception, found = seen.get(timeout=TIMEOUT_S)
    assert isinstance(exception, ZeroDivisionError)
    assert found is pipe


@pytest.mark.parametrize("kind", OBJECTS)
def test_what_is_old_costs_nothing_when_an_attribute_of_today_is_read(kind):
    # With a __getattr__, CPython specializes no look-up of an attribute: an event took a fifth longer.
    assert not hasattr(type(OBJECTS[kind]()), "__getattr__")
