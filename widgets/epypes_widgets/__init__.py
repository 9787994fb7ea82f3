"""How is a runner tuned by hand in a notebook?

::

    from epypes_widgets import tune

    panel = tune(runner, canny_lo=(0, 255), blur_kernel=ep.Param(1, 31, odd=True))
    panel

``panel`` is all of it, for a user. Between the hand and the screen:

- ``messages``: what is done when the view says something
- ``tuning``: what happens from a value that is set to a picture
- ``worker``: when is it computed, and on which thread
- ``hand``: where do the controls stand, and which are held
- ``screen``: what is the view told
- ``session``: what has been asked of the runner, and what has it computed
- ``places``: what can be tuned, and what is otherwise for a running service
- ``frames``, ``shown``: what goes to the screen, and what does the user want to see
- ``picture``, ``sender``, ``latency``: how it gets there, when, and how fast
- ``view``: what runs in the browser

What is remembered:

- ``history``, ``historyframe``: at which values did the hand stop
- ``stored``: how that is kept in a database
- ``settings``: how values get into a file, and back
- ``verdicts``: which test images pass
- ``searching``: what becomes of a search of hyperparameters
- ``code``: which line of code does the same
- ``promotion``, ``writeback``: what becomes of a promotion, and of values that are written back
- ``still``, ``static``, ``pictures``: what stays in a saved notebook

What is chosen from a sweep:

- ``picking``: which of many settings does the runner get

What is looked at, and moved:

- ``looking``: what can be looked at in a run
- ``controls``: what moves a hyperparameter
- ``tips``: what is said about it
- ``ranges``, ``pairs``, ``guesses``, ``movable``: which values may it take
- ``cuts``: which of them have to do with which picture
- ``values``: when are two values the same, and how are they said
"""

from __future__ import annotations

from epypes.optional import optional_import

with optional_import():
    from epypes_widgets.making import tune
    from epypes_widgets.panel import Panel
    from epypes_widgets.picking import Picker, pick

__all__ = ["Panel", "Picker", "pick", "tune"]
