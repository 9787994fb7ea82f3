"""Ids of new messages."""

from __future__ import annotations

import os
import re
import threading

from epypes.wire import Envelope, new_id

WAIT_S = 60.0


def test_an_id_is_32_hexadecimal_digits():
    assert re.fullmatch("[0-9a-f]{32}", new_id())
    assert re.fullmatch("[0-9a-f]{32}", Envelope(type="image").id)


def test_ids_are_unique_over_threads():
    found: list[list[str]] = [[] for _ in range(8)]

    def ask(mine: list[str]) -> None:
        mine.extend(new_id() for _ in range(2_000))

    threads = [threading.Thread(target=ask, args=(mine,)) for mine in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert len(set().union(*found)) == 16_000


def test_a_forked_child_makes_other_ids_than_its_parent():
    # So that there are some left.
    new_id()
    read, write = os.pipe()
    child = os.fork()
    if not child:
        os.write(write, "".join(new_id() for _ in range(100)).encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as stream:
        text = stream.read()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    its = {text[begin : begin + 32] for begin in range(0, len(text), 32)}
    assert len(its) == 100
    assert its.isdisjoint({new_id() for _ in range(300)})
