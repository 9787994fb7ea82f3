"""How is a runner tuned by hand in a notebook?

::

    from epypes_widgets import tune

    panel = tune(runner, canny_lo=(0, 255), blur_kernel=ep.Param(1, 31, odd=True))
    panel

- ``ranges``: which values may each hyperparameter take
- ``controls``: what moves it
- ``worker``: when is it computed
- ``looking``: what can be looked at in a run
- ``frames``: which picture goes to the screen, and when
- ``picture``: what the screen shows
- ``panel``: all of it, for a user
"""

from __future__ import annotations

from epypes_widgets.panel import Panel, tune

__all__ = ["Panel", "tune"]
