"""Each extra, installed alone, does what the README says that it is for."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.cpp.building import bundle_of

pytestmark = pytest.mark.packaging

JUPYTER = ("IPython", "ipykernel", "jupyter_core", "jupyterlab", "nbclient", "nbformat", "ipywidgets")

# A graph that needs NumPy alone.
GRAPH = """
import numpy as np
import epypes as ep


def invert(image):
    return 255 - image


def threshold(inverted, level):
    return inverted > level


cg = ep.CompGraph(
    {"invert": invert, "threshold": threshold},
    {"invert": ("image", "inverted"), "threshold": (("inverted", "level"), "mask")},
)
runner = ep.CompGraphRunner(cg, {"level": 100})
image = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
run = runner.run(image=image)
"""

DRAWING = "ep.show(run, direction='right').save('edges.svg'); assert '<svg' in open('edges.svg').read()\n"

TUNING = """
from epypes_widgets import tune

panel = tune(runner)
panel.set(level=40)
panel.wait(120)
assert runner["level"] == 40, runner["level"]
assert "level=40" in panel.code()
panel.save("settings.toml")
assert "image/svg+xml" in runner._repr_mimebundle_()
"""

VISION = """
import cv2
import matplotlib.figure
import numpy as np
import epypes as ep
from epypes.acquisition import read_image, write_image
from skimage import data

cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
run = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200}).run(image=cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR))
write_image("edges.png", run["edges"])
assert np.array_equal(read_image("edges.png"), run["edges"])
with ep.ImageAcquisition([ep.camera("edges.png")]) as acquisition:
    pass
writer = cv2.VideoWriter("belt.avi", cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
writer.write(np.full((48, 64, 3), 90, np.uint8))
writer.release()
assert [frame.image.shape for frame in ep.camera("belt.avi")] == [ep.video("belt.avi")[0].shape]
"""

SCALE = """
from concurrent.futures import ProcessPoolExecutor

if __name__ == "__main__":
    with ProcessPoolExecutor(1) as executor:
        result = ep.map(runner, [image, image[::-1]], keep=["mask"], executor=executor)
    assert len(result.to_frame()) == 2, result.to_frame()
    assert ep.map(runner, [image], store="results.sqlite", name="run", progress=True).to_frame()["failure"].isna().all()
    swept = ep.sweep(runner, {"level": [30, 70]})
    assert "<img" in swept._repr_mimebundle_()["text/html"]
    noisy = run["inverted"] ^ np.uint8(1)
    wanted = {"mask": run["mask"], "inverted": noisy}
    metrics = {"iou": {"token": "mask", "min": 0.9}, "psnr": {"token": "inverted", "min": 20}}
    checked = ep.check(runner, [ep.Case(image, wanted, metrics)])
    assert checked.passed, checked
    checked.to_junit("checked.xml")
    found = ep.optimize(runner, lambda run, case: float(run["mask"].mean()), [image], n=4, ranges={"level": (0, 255)})
    found.history_plot().savefig("history.png")
    assert len(found.to_frame()) == 4
"""

CLUSTER = """
from distributed import Client

if __name__ == "__main__":
    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        result = ep.map(runner, [image, image[::-1]], keep=["mask"], executor=client.get_executor())
    assert len(result.to_frame()) == 2
"""

TABLES = """
import pandas as pd
from epypes.wire import Envelope, decode, encode

table = pd.DataFrame({"name": ["a", None], "kind": pd.Categorical(["b", "b"])})
assert decode(encode(Envelope("rows", {"table": table}))).parts["table"].equals(table)
"""

STORE = """
import epypes as ep

with ep.Store("results.sqlite") as store:
    series = store.series("map", "edges")
    series.append("first", {"failure": None})
    print(*dict(series.items()))
"""

POSTGRES = """
import epypes as ep

try:
    with ep.Store("postgresql://nobody@127.0.0.1:1/none") as store:
        list(store.series("map", "edges").items())
except ep.errors.StoreError as error:
    print(error)
"""

SERVING = """
import subprocess, sys
from pathlib import Path
from epypes.service import call

process = subprocess.Popen(
    [str(Path(sys.executable).with_name("epypes")), "serve", "bundle", "--http", "127.0.0.1:0"],
    stdout=subprocess.PIPE, text=True,
)
try:
    ready = process.stdout.readline()
    assert ready.startswith("READY"), ready
    service = ep.connect(ready.partition("control at ")[2].partition(",")[0])
    answer = call("bundle", {"image": image}, timeout_s=60)
    assert np.array_equal(answer.tokens["mask"], run["mask"])
    service.set(level=40)
    assert service.parameters().entries["level"]["value"] == 40
finally:
    process.terminate()
    process.wait(60)
"""

RECORDING = """
import queue
import epypes as ep
from epypes.transport import Player, Recorder, recording_info
from epypes.wire import Envelope

messages, received = queue.SimpleQueue(), queue.SimpleQueue()
with ep.ZMQPublisher("tcp://127.0.0.1:*", messages) as publisher:
    recorder = Recorder(publisher.address, "messages.mcap", messages=1).start()
    recorder.wait_joined(60)
    messages.put(Envelope("frame", {"number": 7}))
    recorder.wait(60)
    recorder.stop(60)
print(recording_info("messages.mcap").messages)
"""

TRACED = """
import os, subprocess, sys
from epypes.service import call

process = subprocess.Popen(
    [os.path.join(os.path.dirname(sys.executable), "opentelemetry-instrument"), "--traces_exporter", "console",
     "--metrics_exporter", "none", "--logs_exporter", "none", "epypes", "serve", "bundle"],
    stdout=subprocess.PIPE, text=True, env={**os.environ, "PATH": os.path.dirname(sys.executable)},
)
try:
    assert process.stdout.readline().startswith("READY")
    call("bundle", {"image": image}, timeout_s=60)
finally:
    process.terminate()
    print(process.communicate(timeout=60)[0])
"""

BROKER = """
import queue, sys
import numpy as np
import epypes as ep
from epypes.wire import Envelope

images, found = queue.SimpleQueue(), queue.SimpleQueue()
image = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
frame = Envelope("frame", {"image": image}, rgb=["image"])
with (
    ep.Subscriber(sys.argv[1], found, acknowledge="received") as subscriber,
    ep.Publisher(sys.argv[1], images) as publisher,
):
    assert subscriber.wait_joined(60) and publisher.wait_for_subscriber(60)
    images.put(frame)
    event = found.get(timeout=60)
    assert np.array_equal(event.parts["image"], image)
    print("arrived")
"""

NAMED = """
import sys
import epypes as ep

missing = {}


def try_out(what, code):
    try:
        exec(code, {"ep": ep, "runner": runner, "run": run, "image": 7})
    except ep.errors.MissingPackage as error:
        assert str(error) == f"Package {error.package!r} is missing. Run: pip install 'epypes[{error.extra}]'", error
        assert isinstance(error, ModuleNotFoundError)
        print(what, error.extra)


runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x, k: x + k}, {"f": (("x", "k"), "y")}), {"k": 1})
run = runner.run(x=1)
assert run["y"] == 2
for line in sys.argv[1:]:
    try_out(line, line)
"""


def notebook(folder, code):
    """Write a notebook of one cell, as Jupyter does."""
    cell = {"cell_type": "code", "metadata": {}, "source": code, "outputs": [], "execution_count": None, "id": "a"}
    about = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    text = json.dumps({"cells": [cell], "metadata": about, "nbformat": 4, "nbformat_minor": 5})
    (folder / "graph.ipynb").write_text(text, encoding="utf-8")


def test_without_an_extra_each_thing_names_the_one_that_it_needs(environment):
    alone = environment("")
    wanted = {
        "ep.promote(runner, 'bundle')": "serve",
        "ep.ZMQSubscriber('tcp://127.0.0.1:*', None)": "serve",
        "ep.connect('http://127.0.0.1:1')": "serve",
        "from epypes.service import Service": "serve",
        "from epypes.wire import Envelope, encode; encode(Envelope('frame', {'number': 7}))": "serve",
        "from epypes.transport import recording_info; recording_info('x.mcap')": "record",
        "from epypes_widgets import tune": "widgets",
        "ep.camera(0)": "vision",
        "ep.video('x.mp4')": "vision",
        "ep.Store('results.sqlite')": "store",
        "runner.cg.to_networkx()": "widgets",
        "run.report.to_frame()": "scale",
        "ep.map(runner, [1]).to_frame()": "scale",
        "ep.optimize(runner, lambda run, case: run['y'], [1], ranges={'k': (1, 2)})": "scale",
        "from epypes.experiment import run_experiment; run_experiment()": "experiment",
    }
    told = dict(line.rpartition(" ")[::2] for line in alone.python(NAMED, *wanted).splitlines())
    assert told == wanted
    for command, extra in (("serve nowhere", "serve"), ("lab .", "notebook"), ("keys camera --to .", "serve")):
        done = alone.epypes(*command.split())
        assert done.returncode == 1
        assert done.stderr.strip().splitlines()[1:] == []
        assert done.stderr.strip().endswith(f"is missing. Run: pip install 'epypes[{extra}]'"), done.stderr


def test_graphviz_draws_graphs(environment):
    environment("graphviz").python(NAMED.partition("for line")[0] + DRAWING)


def test_widgets_tune_without_jupyterlab(environment):
    alone = environment("widgets")
    alone.python(GRAPH + DRAWING + TUNING)
    assert alone.has("ipykernel", "jupyterlab", "cv2") == ["ipykernel"]


def test_notebook_brings_jupyterlab(environment):
    alone = environment("notebook")
    alone.python(GRAPH + DRAWING + TUNING)
    done = alone.epypes("lab", ".", "--", "--version")
    assert done.returncode == 0, done.stderr
    assert alone.has("cv2") == []


def test_vision_reads_images_and_brings_opencv(environment):
    environment("vision").python(VISION)


def test_serve_serves_without_jupyter(environment):
    alone = environment("serve")
    alone.python(GRAPH + "ep.promote(runner, 'bundle', outputs=['mask'])\n" + SERVING)
    done = alone.epypes("verify", "bundle")
    assert done.returncode == 0, done.stderr
    assert alone.has(*JUPYTER, "cv2", "pygraphviz", "pandas", "sqlalchemy") == []
    done = alone.epypes("serve", "bundle", "--store", "events.sqlite")
    assert (done.returncode, done.stderr) == (
        1,
        "epypes: Package 'sqlalchemy' is missing. Run: pip install 'epypes[store]'\n",
    )
    done = alone.epypes("promote", "graph.ipynb", "--to", "other")
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        1, "epypes: Package 'nbformat' is missing. Run: pip install 'epypes[service]'"
    )  # fmt: skip


def test_service_promotes_a_notebook_and_serves_it(environment):
    alone = environment("service")
    notebook(alone.folder, GRAPH)
    done = alone.epypes("promote", "graph.ipynb", "--to", "bundle", "--output", "mask")
    assert done.returncode == 0, done.stderr
    alone.python(GRAPH + DRAWING + SERVING)
    alone.python(RECORDING)
    assert alone.has("jupyterlab", "cv2") == []


def test_record_records_and_tells_what_is_in_the_file(environment):
    alone = environment("record")
    assert alone.python(RECORDING) == "1\n"
    done = alone.epypes("play", "messages.mcap", "--info")
    assert "1 message" in done.stdout, done.stderr


def test_otel_sets_a_tracer_provider_and_prints_the_spans_of_a_service(environment):
    alone = environment("serve,otel")
    printed = alone.python(GRAPH + "ep.promote(runner, 'bundle', outputs=['mask'])\n" + TRACED)
    assert '"name": "process bundle"' in printed
    assert '"name": "invert"' in printed
    assert alone.has(*JUPYTER, "cv2") == []


def test_scale_maps_in_processes_checks_and_searches(environment):
    alone = environment("scale")
    alone.python(GRAPH + SCALE)
    assert alone.has("cv2", "fastapi", *JUPYTER) == []


def test_tables_travel(environment):
    environment("tables").python(TABLES)


def test_cluster_maps_on_dask(environment):
    environment("cluster").python(GRAPH + CLUSTER)


def test_cpp_exports_a_bundle(environment, tmp_path):
    source = "def half(image):\n    return image[::2, ::2]"
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    bundle_of(tmp_path / "halves", source, {"half": [(image,)]}, lambda half, inputs: half(**inputs))
    alone = environment("cpp")
    done = alone.epypes("export", "cpp", str(tmp_path / "halves"), "--to", "halves_cpp", "--service")
    assert done.stdout.splitlines()[1].split() == ["half", "yes"], done.stderr
    assert (alone.folder / "halves_cpp" / "service" / "tokens.cpp").is_file()
    assert alone.has(*JUPYTER, "cv2") == []


def test_store_keeps_rows(environment):
    assert environment("store").python(STORE) == "first\n"


def test_postgres_has_a_driver(environment):
    assert "127.0.0.1" in environment("postgres").python(POSTGRES)


@pytest.mark.parametrize(("extra", "server"), [("rabbitmq", "rabbitmq"), ("nats", "nats"), ("mqtt", "mosquitto")])
def test_a_broker_carries_envelopes(extra, server, environment, request):
    address = request.getfixturevalue(server).address("events", create="true")
    assert environment(extra).python(BROKER, address) == "arrived\n"


@pytest.mark.parametrize(
    ("extra", "address"), [("dds", "dds://7/extras"), ("zenoh", "zenoh://127.0.0.1/epypes/extras")]
)
def test_a_middleware_without_a_broker_carries_envelopes(extra, address, environment):
    assert environment(extra).python(BROKER, address) == "arrived\n"


def test_the_experiment_runs_beside_any_opencv(environment):
    arguments = ("experiment", "--layout", "one", "--requests", "2", "--experiments", "1", "--out", "results")
    alone = environment("experiment")
    done = alone.epypes(*arguments)
    assert done.returncode == 1
    assert done.stderr.strip().endswith("is missing. Run: pip install 'epypes[vision]'"), done.stderr
    both = environment("experiment,vision")
    done = both.epypes(*arguments)
    assert done.returncode == 0, done.stderr
    assert (both.folder / "results" / "figure_14.svg").is_file()


def test_promoting_without_its_extra_names_it(environment):
    told = environment("notebook,vision").python(NAMED, "ep.promote(runner, 'bundle')")
    assert told == "ep.promote(runner, 'bundle') serve\n"
