"""Tuning a runner, or a running service, by hand in a notebook.

::

    from epypes_widgets import tune

    panel = tune(runner, canny_lo=(0, 255), blur_kernel=ep.Param(1, 31, odd=True))
    panel

or, for one function, ``interact(edges, image, lo=(0, 255))``. ``panel`` has the panel, ``tune`` and ``interact``;
``functions`` makes the runner of plain functions. From a control to the screen:

- ``controls``: the widgets that move hyperparameters, and which are held; ``scale``: the values along a slider;
  ``column``: how they stand on the page
- ``messages``: what is done with each message of the view
- ``session``: what is wanted of a runner or a running service, and what it has computed; ``frame_states``: what the
  frames of a sequence begin with
- ``worker``: the thread that computes; ``tuning``: what it does
- ``screen``: what is shown; ``frames``, ``stages``, ``histogram``, ``tiles``: tokens of a run for the screen
- ``view``: the script in the browser, and the frames on their way to it

What a hyperparameter may be: ``ranges``, ``tooltips``, ``values``. What is remembered: ``history`` and
``history_table``, ``settings`` (TOML files), ``code`` (the line that does the same), ``static`` (the picture in a saved
notebook). What buttons start: ``search``, ``promotion``. Test images: ``images``, ``cases``; in their place a camera:
``feed``. ``picking`` chooses one setting of a sweep.
"""

from __future__ import annotations

from epypes.optional import optional_import

with optional_import():
    from epypes_widgets.panel import Panel, interact, tune
    from epypes_widgets.picking import Picker, pick

__all__ = ["Panel", "Picker", "interact", "pick", "tune"]
