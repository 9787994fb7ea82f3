"""How is a bundle exchanged once at a time, however many ask for it?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from epypes.errors import DeployRefused
from epypes.service.http.served import Served

_BUSY: Final = "A bundle is being exchanged already. Wait until that has ended, and look at what is served then."


async def exchanging(served: Served, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call what exchanges a bundle, or changes it, on a thread of its own; return its result.

    Raises
    ------
    DeployRefused
        Another such call is under way.
    """
    if served.exchanges.is_full:
        raise DeployRefused("The bundle", [_BUSY])
    return await served.exchanges(function, *arguments)
