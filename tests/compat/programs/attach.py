"""A node attached to a pipeline makes another pipeline."""

from epypes.compgraph import CompGraph
from epypes.node import Node
from epypes.pipeline import Pipeline, attach

cg = CompGraph({"scale": lambda x, k: x * k}, {"scale": (("x", "k"), "y")})
first = Pipeline("first", cg, {"k": 3})
second = attach(first, Node("shift", lambda y, by: y + by), ("y", "by"), "z", "second")
first.run(x=2)
second.run(x=2, by=10)
assert first["y"] == 6
assert second["z"] == 16
assert second.name == "second"
assert set(second.cgraph.nodes) == {"scale", "shift"}
