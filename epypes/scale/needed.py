"""Which package is missing, and how is it installed?"""

from __future__ import annotations

import importlib
from typing import Any

from epypes.errors import ScaleError


def needed(module: str, extra: str = "scale") -> Any:
    """Return a module of a package that an extra brings.

    Raises
    ------
    ScaleError
        It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise ScaleError(f"Package {package!r} is missing. Run: pip install 'epypes[{extra}]'") from error
