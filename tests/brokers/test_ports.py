"""Does a broker of the tests have its port for itself?"""

from __future__ import annotations

from tests.brokers.ports import first_ephemeral, free_ports


def test_the_ports_of_a_broker_are_none_that_the_system_gives_to_others():
    ports = free_ports("127.0.0.1", 50)
    assert len(set(ports)) == 50
    assert max(ports) < first_ephemeral()
