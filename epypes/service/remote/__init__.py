"""A running service in a notebook, over HTTP: shown, changed and tuned."""
