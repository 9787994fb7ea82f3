"""A running service as a notebook sees it, over HTTP: looked at, changed, tuned."""
