"""Which camera of this process has a device: until that one is closed or dropped, no other one opens the device.

One gives way: a camera that an earlier run of a notebook's cell has made, and that nothing reads. A cell that is run
again makes its camera while the name still refers to the former one.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from weakref import WeakValueDictionary

from epypes.acquisition.frames import Frame, frames_read
from epypes.errors import CameraUnavailable

_OWN: Final = ("epypes", "epypes_widgets")
_lock: Final = threading.Lock()


class DeviceOwner:
    """A camera that has a device for itself while it is open; a loop over it is one use of it."""

    def __init__(self) -> None:
        self._cell, self._made_at = _cell_and_place()
        self._loops = 0
        self._last_reader: threading.Thread | None = None

    def close(self) -> None:
        """Let go of the device."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames without end, until `close` is called; CameraUnavailable if the camera gives none."""
        self._loops += 1
        try:
            yield from frames_read(self)
        finally:
            self._loops -= 1

    def _own(self, device: str) -> None:
        """Have a device for this camera alone, until `_disown`.

        Raises
        ------
        CameraUnavailable
            Another camera of this process has it.
        """
        owner = self._owner_of(device)
        if owner is not self and 0 < owner._cell < self._cell and not owner._is_read:
            owner.close()
            owner = self._owner_of(device)
        if owner is not self:
            way_out = "Close that camera first: camera.close()."
            if owner._is_read:
                way_out = "End the loop, the acquisition or the panel that reads it first."
            raise CameraUnavailable(device, f"Camera {device!r} is open already, by {owner._made_at}. {way_out}")

    def _owner_of(self, device: str) -> DeviceOwner:
        """Return the camera that has a device: this one, if there was none."""
        with _lock:
            return _owners.setdefault(device, self)

    def _disown(self) -> None:
        """Let other cameras have what this one has."""
        with _lock:
            for device in [device for device, owner in _owners.items() if owner is self]:
                del _owners[device]

    @property
    def _is_read(self) -> bool:
        """Whether a loop, or another thread than this one, reads it."""
        last = self._last_reader
        return self._loops > 0 or (last not in (None, threading.current_thread()) and last.is_alive())


# By the device.
_owners: Final[WeakValueDictionary[str, DeviceOwner]] = WeakValueDictionary()


def _cell_and_place() -> tuple[int, str]:
    """Return the number of the run of a notebook's cell, 0 outside of notebooks, and the caller's line."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _OWN:
        frame = frame.f_back
    path = frame.f_code.co_filename
    name = None if shell is None else shell.compile.format_code_name(path)
    where = Path(path).name if name is None else " ".join(name)
    return 0 if shell is None else shell.execution_count, f"line {frame.f_lineno} of {where}"
