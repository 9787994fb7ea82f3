"""Serve a graph in a process of its own, call it from Python, and change a hyperparameter while it runs."""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
from skimage import data

import epypes as ep
from epypes.service import Client


def blurred(image, kernel=5):
    return cv2.GaussianBlur(image, (kernel, kernel), 0)


def edges(blurred, low=70, high=200):
    return cv2.Canny(blurred, low, high)


def main(folder):
    """Promote the graph to a bundle, serve it, and call the service three times."""
    bundle = folder / "edges"
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(blurred, edges))
    runner.run(image=data.camera())  # the sample by which the bundle is verified
    ep.promote(runner, bundle, outputs=["edges"])

    command = [sys.executable, "-m", "epypes", "serve", bundle, "--http", "127.0.0.1:*"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        ready, page = service.stdout.readline(), service.stdout.readline()
        print(ready.split()[0])
        try:
            with Client(bundle) as client, ep.connect(page.removeprefix("Live page: ").strip()) as control:
                for low in (70, 20, 150):
                    control.set(low=low)
                    answer = client.call({"image": data.coins()})
                    count = (answer.tokens["edges"] > 0).sum()
                    print(f"low = {low}: {count} edge pixels in {answer.round_trip_ns / 1e6:.1f} ms")
        finally:
            service.terminate()
            print(service.communicate()[0].splitlines()[-1])


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        main(Path(scratch))
