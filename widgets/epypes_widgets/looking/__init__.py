"""What can be looked at in a run?

- ``stages``: which tokens have a picture, and in which state it is
- ``overlay``: what is drawn over a picture
- ``histogram``: how often which values are in it
- ``probe``: which values all pictures have at one pixel
- ``films``: which other payloads can be looked at

Nothing here computes a token, waits or knows widgets: all of it may be called from any thread.
"""

from __future__ import annotations

from epypes_widgets.looking.films import Payload, payloads
from epypes_widgets.looking.histogram import histogram, histogram_of
from epypes_widgets.looking.overlay import overlay, scene
from epypes_widgets.looking.probe import probe
from epypes_widgets.looking.stages import Stage, best_stage, stages, states

__all__ = [
    "Payload",
    "Stage",
    "best_stage",
    "histogram",
    "histogram_of",
    "overlay",
    "payloads",
    "probe",
    "scene",
    "stages",
    "states",
]
