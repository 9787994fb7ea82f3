"""Definitions of the notebook as the text of modules: resolved by object, sliced, written, compared."""
