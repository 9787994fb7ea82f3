"""Who sends events and reads answers on another host: ``python -m tests.brokers.peer SUB PUB COUNT PACE_MS``.

On standard output: READY, then a line of JSON whenever something has changed; the last one when all is answered and the
broker keeps nothing more, or when the input has ended.
"""

from __future__ import annotations

import json
import sys
import threading

import epypes as ep
from tests.brokers.traffic import Reader, event, left


class Sender:
    """Sends on a thread, which waits for the broker's word on each event."""

    def __init__(self, outbox, count, pace_s):
        self.confirmed, self._ended = [], threading.Event()
        self._thread = threading.Thread(target=self._send, args=(outbox, count, pace_s), daemon=True)
        self._thread.start()

    def _send(self, outbox, count, pace_s):
        for number in range(count):
            if self._ended.wait(pace_s):
                return
            outbox.put(event(number))
            self.confirmed.append(f"event-{number}")


def main(sub, pub, count, pace_ms):
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    outbox, said = ep.Mailbox("block"), ""
    with Reader(pub) as reader, ep.Publisher(sub, outbox) as publisher:
        print("READY", flush=True)  # noqa: T201
        sender = Sender(outbox, count, pace_ms / 1000)
        while not ended.wait(0.05):
            said = told(sender, reader, publisher, said)
            if len(sender.confirmed) == count and reader.look() >= count and left(sub) == 0:
                break
        told(sender, reader, publisher, "")


def told(sender, reader, publisher, before):
    """Say how it stands, if it has changed; return what was said last."""
    confirmed, ids = list(sender.confirmed), reader.ids()
    line = json.dumps(
        {
            "confirmed": len(confirmed),
            "answered": len(ids),
            "twice": [name for name, number in ids.items() if number > 1],
            "unanswered": [name for name in confirmed if name not in ids],
            "replicas": len({answer.epoch for answer in reader.answers}),
            "duplicates": reader.subscriber.duplicates,
            "reconnects": [publisher.reconnects, reader.subscriber.reconnects],
            "connected": [publisher.is_connected, reader.subscriber.is_connected],
            "trouble": publisher.trouble,
        }
    )
    if line != before:
        print(line, flush=True)  # noqa: T201
    return line


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(int, sys.argv[3:]))
