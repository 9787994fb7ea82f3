"""Which packages, at which versions, did a replay really import?"""

from __future__ import annotations

import sys
from importlib import metadata
from typing import Final

# setuptools puts this into every interpreter through a .pth file: nobody imported it.
_STARTUP_HOOKS: Final = frozenset({"_distutils_hack"})


def imported_requirements() -> tuple[str, ...]:
    """Return the distributions that this process has imported from, pinned, sorted by name.

    Two distributions that bring the same module (opencv-python and its headless twin) are told apart by what is
    installed.
    """
    by_module = metadata.packages_distributions()
    tops = {name.partition(".")[0] for name in list(sys.modules)}
    names = {distribution for top in tops - _STARTUP_HOOKS for distribution in by_module.get(top, ())}
    # An editable install of EPypes itself is not listed by module.
    names.add("epypes")
    return tuple(f"{name}=={metadata.version(name)}" for name in sorted(names, key=str.lower))
