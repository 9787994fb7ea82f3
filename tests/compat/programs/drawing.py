"""The networkx graph of a runner, with the styles that Graphviz drew."""

from epypes.compgraph import CompGraph, CompGraphRunner, FunctionPlaceholder, get_networkx_graph

cg = CompGraph({"f": lambda x, k: x, "g": FunctionPlaceholder()}, {"f": (("x", "k"), "y"), "g": ("y", "z")})
runner = CompGraphRunner(cg, {"k": 1})
graph = runner.to_networkx()
assert set(graph) == {"f", "g", "x", "k", "y", "z"}
assert set(graph.edges) == {("x", "f"), ("k", "f"), ("f", "y"), ("y", "g"), ("g", "z")}
assert dict(graph.nodes["k"]) == {"bipartite": 1, "style": "filled", "fillcolor": "gray"}
assert dict(graph.nodes["f"]) == {"bipartite": 0, "shape": "rect"}
assert graph.nodes["g"]["style"] == "dashed"
styled = get_networkx_graph(runner, style_attrs={"fontname": "Arial"})
assert styled.nodes["x"]["fontname"] == "Arial"
