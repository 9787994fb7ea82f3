"""A file by which functions keep something from event to event is refused, also where no sample runs the lines."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import PromotionRefused
from tests.bundle.hostile import in_notebook

IMPORTS = """\
import csv, functools, io, json, os, pickle, sqlite3, subprocess, tempfile, uuid, zipfile
from multiprocessing import shared_memory
from pathlib import Path
from xml.etree import ElementTree
import cv2, numpy as np
LAST = "/tmp/epypes-last.png"
FOLDER = Path("/tmp") / "epypes-kept"
def name_of(camera):
    return f"/tmp/last-{camera}.npy"
def write(path, image):
    cv2.imwrite(path, image)
def read(path):
    return cv2.imread(path, 0)
def own_file(image):
    path = tempfile.mkstemp(suffix=".png")[1]
    cv2.imwrite(path, image)
    return path
put, get = functools.partial(cv2.imwrite, LAST), functools.partial(cv2.imread, LAST, 0)
"""

# By name: the body of a function of an image and a camera; a file of one event is what another one reads.
KEPT = {
    "OpenCV": "if image.max() > 250:\n    last = cv2.imread(LAST, 0)\n    cv2.imwrite(LAST, image)\n    return last",
    "the working folder": "if image.max() > 250:\n    last = cv2.imread('last.png')\n    cv2.imwrite('./last.png', image)\n    return last",
    "helpers": "last = read(LAST) if image.max() > 250 else image\nwrite(LAST, image)\nreturn last",
    "a name of a token": "p = f'/tmp/{camera}.png'\nif image.max() > 250:\n    image = cv2.imread(p)\ncv2.imwrite(p, image)\nreturn image",
    "a helper's name": "if os.path.exists(name_of(camera)):\n    image = image - np.load(name_of(camera))\nnp.save(name_of(camera), image)\nreturn image",
    "a storage": "fs = cv2.FileStorage('/tmp/g.yml', cv2.FILE_STORAGE_READ)\ngain = fs.getNode('g').real()\n"
    "out = cv2.FileStorage('/tmp/g.yml', cv2.FILE_STORAGE_WRITE)\nout.write('g', float(image.mean()))\nreturn gain",
    "a path": "p = FOLDER / 'mean.txt'\nmean = float(p.read_text()) if p.exists() else 0\np.write_text(str(image.mean()))\nreturn mean",
    "a pickle": "with open(LAST + '.pkl', 'rb') as file:\n    last = pickle.load(file)\nwith open(LAST + '.pkl', 'wb') as file:\n    pickle.dump(image, file)\nreturn last",
    "a folder's names": "n = len(list(FOLDER.glob('*.png')))\ncv2.imwrite(str(FOLDER / f'{n}.png'), image)\nreturn n",
    "a flag": "is_first = not os.path.exists('/tmp/flag')\nPath('/tmp/flag').touch()\nreturn image * is_first",
    "an appended file": "with open('/tmp/log.txt', 'a') as f:\n    f.write('x')\nreturn os.path.getsize('/tmp/log.txt')",
    "a database": "db = sqlite3.connect('/tmp/e.db')\nreturn db.execute('select count(*) from seen').fetchone()[0]",
    "a map of memory": "m = np.memmap('/tmp/m.dat', np.uint8, 'r+', shape=4)\nm[0] += 1\nreturn int(m[0])",
    "a move": "cv2.imwrite('/tmp/new.png', image)\nold = cv2.imread(LAST)\nos.replace('/tmp/new.png', LAST)\nreturn old",
    "a branch before": "if image.max() > 250:\n    cv2.imwrite(LAST, image)\nreturn cv2.imread(LAST)",
    "a number that goes on": "n = 1\ncv2.imwrite(f'/tmp/{n}.png', image)\nn += 1\nreturn cv2.imread(f'/tmp/{n}.png')",
    "partials": "last = get()\nput(image)\nreturn last",
    "other names": "put, get = cv2.imwrite, cv2.imread\nlast = get(LAST)\nput(LAST, image)\nreturn last",
    "a process": "subprocess.run(f'date >> {LAST}', shell=True)\nreturn open(LAST).read()",
    "shared memory": "return bytes(shared_memory.SharedMemory('epypes-last').buf)",
    "functions that are not known": "root = ElementTree.parse('/tmp/a.xml')\nElementTree.ElementTree(root).write('/tmp/a.xml')\nreturn root",
}  # fmt: skip

FINE = {
    "only written": "cv2.imwrite(f'/tmp/debug-{uuid.uuid4()}.png', image)\nreturn image",
    "written first": "cv2.imwrite(LAST, image)\nif image.max() > 2:\n    return cv2.imread(LAST)\nreturn os.path.getsize(LAST)",
    "written first, as a check": "if not cv2.imwrite(LAST, image):\n    raise OSError(LAST)\nreturn cv2.imread(LAST)",
    "its own file": "with tempfile.NamedTemporaryFile(suffix='.png') as file:\n    cv2.imwrite(file.name, image)\n    return cv2.imread(file.name)",
    "its own folder": "with tempfile.TemporaryDirectory() as folder:\n    path = os.path.join(folder, 'a.npy')\n"
    "    np.save(path, image)\n    return np.load(path) + len(os.listdir(folder))",
    "a file that a function names": "path = own_file(image)\nback = cv2.imread(path)\nos.unlink(path)\nreturn back",
    "an archive in memory": "file = io.BytesIO()\nwith zipfile.ZipFile(file, 'w') as made:\n    made.writestr('a.json', '1')\n"
    "    return json.load(made.open('a.json'))",
    "memory": "buffer = io.BytesIO()\nnp.save(buffer, image)\nbuffer.seek(0)\nreturn np.load(buffer)",
    "a folder that it makes": "if not os.path.isdir('/tmp/debug'):\n    os.makedirs('/tmp/debug')\ncv2.imwrite('/tmp/debug/a.png', image)\nreturn image",
    "a table of its log": "is_new = not os.path.exists('/tmp/log.csv')\nwith open('/tmp/log.csv', 'a') as file:\n    log = csv.writer(file)\n"
    "    if is_new:\n        log.writerow(['mean'])\n    log.writerow([image.mean()])\nreturn image",
    "other files": "cv2.imwrite(f'/tmp/debug-{camera}.png', image)\nreturn cv2.imread(f'/usr/share/plates/{camera}.png')",
    "another ending": "cv2.imwrite(f'{camera}.png', image)\nreturn json.load(open(f'{camera}.json'))",
    "a path that the event brings": "write('/tmp/debug.png', image)\nreturn read(camera)",
    "methods of other objects": "text = 'a'.replace('a', 'b')\nparts = [1, 2].copy()\nparts.remove(1)\nreturn image.copy()",
    "a cascade": "cv2.imwrite(LAST, image)\nreturn cv2.CascadeClassifier(cv2.data.haarcascades + 'a.xml').empty()",
}  # fmt: skip


def reasons_against(body, monkeypatch, to):
    """Return the reasons against a function that was never run, but for that."""
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    names = in_notebook(monkeypatch, IMPORTS, f"def f(image, camera):\n{lines}")
    runner = ep.CompGraphRunner(ep.CompGraph({"f": names["f"]}, {"f": (("image", "camera"), "out")}))
    with pytest.raises(PromotionRefused) as caught:
        ep.promote(runner, to)
    return caught.value.reasons[1:]


@pytest.mark.parametrize("how", KEPT)
def test_a_file_that_keeps_something_for_a_later_event_is_refused_with_both_lines(how, monkeypatch, tmp_path):
    (reason, *_) = reasons_against(KEPT[how], monkeypatch, tmp_path / "b")
    assert re.search(
        r"calls .+ \(cell \[\d\], line \d+\), which may read what .+ \(cell \[\d\], line \d+\) has written", reason
    )
    assert "ep.delay(" in reason


@pytest.mark.parametrize("what", FINE)
def test_a_file_that_is_only_written_or_of_one_event_alone_is_fine(what, monkeypatch, tmp_path):
    assert reasons_against(FINE[what], monkeypatch, tmp_path / "b") == ()


def test_functions_of_libraries_that_are_the_graph_s_own_may_not_keep_a_file_either(monkeypatch, tmp_path):
    in_notebook(monkeypatch)
    cg = ep.CompGraph({"last": cv2.imread, "keep": cv2.imwrite}, {"last": ("path", "y"), "keep": (("path", "x"), "z")})
    with pytest.raises(PromotionRefused, match=r"The graph calls last, which may read what keep has written"):
        ep.promote(ep.CompGraphRunner(cg, {"path": "/tmp/epypes-last.png"}), tmp_path / "b")


@pytest.mark.slow
def test_what_one_function_writes_another_one_may_not_read(monkeypatch, tmp_path):
    cell = (
        "import cv2\ndef remember(image):\n    cv2.imwrite('/tmp/epypes-seen.png', image)\n    return image + 1\n"
        "def compare(remember):\n    if remember.max() > 250:\n        return cv2.imread('/tmp/epypes-seen.png', 0)\n"
    )
    names = in_notebook(monkeypatch, cell)
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(names["remember"], names["compare"]))
    runner.run(image=np.zeros((4, 4), np.uint8))
    words = r"'compare' calls .+ \(cell \[1\], line 7\).+ cv2\.imwrite\(.+ \(cell \[1\], line 3\) has written"
    with pytest.raises(PromotionRefused, match=words):
        ep.promote(runner, tmp_path / "b")
