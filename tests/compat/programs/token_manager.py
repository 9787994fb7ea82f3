"""What a runner's token manager tells."""

from epypes.compgraph import CompGraph, CompGraphRunner

cg = CompGraph({"f": lambda x, a: x + a, "g": lambda y, b: y * b}, {"f": (("x", "a"), "y"), "g": (("y", "b"), "z")})
runner = CompGraphRunner(cg, {"a": 1, "b": 2})
tokens = runner.token_manager
assert tokens.frozen_values == {"a": 1, "b": 2}
assert tokens.frozen == {"a", "b"}
assert tokens.free == {"x", "y", "z"}
assert tokens.free_source_tokens == {"x"}
assert tokens.get_values() == {"x": None, "a": 1, "y": None, "b": 2, "z": None}
runner.run(x=4)
assert tokens.token_value("z") == tokens["z"] == 10
assert tokens.get_values(["x", "y"]) == {"x": 4, "y": 5}
tokens.freeze_token("a", 2)
runner.run(x=4)
assert runner.token_manager.get_values(deepcopy=True) == {"x": 4, "a": 2, "y": 6, "b": 2, "z": 12}
