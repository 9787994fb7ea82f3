"""How is a connection of pika driven, step by step, by whoever waits?"""

from __future__ import annotations

from pika.adapters.select_connection import IOLoop

from epypes.transport.channels.turns import nothing


class PikaLoop:
    """Pika's own loop, as `turns.Loop`."""

    def __init__(self) -> None:
        self.io = IOLoop()
        self.io.activate_poller()

    def step(self, timeout_s: float) -> None:
        """Take a step; see `turns.Loop.step`."""
        alarm = self.io.call_later(timeout_s, nothing)
        try:
            self.io.poll()
            self.io.process_timeouts()
        finally:
            self.io.remove_timeout(alarm)

    def wake(self) -> None:
        """Have a step end soon; see `turns.Loop.wake`."""
        self.io.add_callback_threadsafe(nothing)

    def suits(self) -> bool:
        """Return whether the calling thread may take steps; see `turns.Loop.suits`."""
        return True

    def close(self) -> None:
        """Take no more steps; see `turns.Loop.close`."""
        self.io.close()
