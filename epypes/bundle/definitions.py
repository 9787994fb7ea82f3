"""The former home of what stands in ``resolve``."""

from epypes.bundle.resolve import annotated_names, defaults_of, functions_of, layers, statements_of_class

__all__ = ["annotated_names", "defaults_of", "functions_of", "layers", "statements_of_class"]
