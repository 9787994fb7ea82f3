"""The place of vertices and the way of edges, by Graphviz where it can."""
