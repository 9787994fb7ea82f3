"""Views of graphs, runners, runs, plans and pipelines, which any painter can read."""
