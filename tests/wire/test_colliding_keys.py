"""Keys that collide by construction, which make building a dict or a set quadratic (failure 74)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from epypes.errors import MessageError
from epypes.wire import Envelope, Limits, decode, encode
from epypes.wire.protobuf import message_class

# Multiples of this number all have the hash 0.
MODULUS = 2**61 - 1
MANY = 8_000


def write_integer(message, key):
    message.big_integer = format(key, "x")


def write_tuple(message, key):
    write_integer(message.tuple.items.add(), key)


def write_frozen_set(message, key):
    write_integer(message.frozen_set.items.add(), key)


def write_complex(message, key):
    # hash(complex(a, b)) is hash(a) + 1000003 * hash(b).
    message.complex.real, message.complex.imaginary = -1000003.0 * key, float(key)


def map_of(keys, write):
    header = message_class("epypes.v1.Envelope")()
    entries = header.parts.add(name="scores").value.map.entries
    for key in keys:
        entry = entries.add()
        write(entry.key, key)
        entry.value.none = True
    return header


def set_of(keys, write):
    header = message_class("epypes.v1.Envelope")()
    items = header.parts.add(name="scores").value.set.items
    for key in keys:
        write(items.add(), key)
    return header


def reason_of(header):
    with pytest.raises(MessageError) as caught:
        decode([b"/", header.SerializeToString()])
    assert "scores" in str(caught.value)
    return caught.value.reason


MULTIPLES = range(MODULUS, MANY * MODULUS, MODULUS)


@pytest.mark.parametrize(
    ("container", "write", "keys"),
    [
        (map_of, write_integer, MULTIPLES),
        (map_of, write_tuple, MULTIPLES),
        (map_of, write_frozen_set, MULTIPLES),
        (map_of, write_complex, range(1, MANY)),
        (set_of, write_integer, MULTIPLES),
    ],
)
def test_keys_that_collide_by_construction_are_refused_before_decoding_becomes_quadratic(container, write, keys):
    assert reason_of(container(keys, write)) == "colliding keys"


def test_colliding_keys_inside_a_key_are_refused():
    def write_set_in_tuple(message, keys):
        items = message.tuple.items.add().frozen_set.items
        for key in keys:
            write_integer(items.add(), key)

    assert reason_of(map_of([MULTIPLES], write_set_in_tuple)) == "colliding keys"


@pytest.mark.parametrize("container", [map_of, set_of])
def test_keys_that_are_not_text_are_bounded_over_all_mappings_and_sets_of_a_message(container):
    limit = Limits().keys
    header = container(range(limit), write_integer)
    decode([b"/", header.SerializeToString()])
    header.MergeFrom(set_of([0], write_integer))
    header.parts[1].name = "more scores"
    assert reason_of(header) == "too many keys"


def test_the_sender_refuses_the_keys_that_the_receiver_would_refuse():
    with pytest.raises(MessageError, match=r"scores.*Use text as keys") as caught:
        encode(Envelope("x", {"scores": dict.fromkeys(range(Limits().keys + 1))}))
    assert caught.value.reason == "too many keys"
    with pytest.raises(MessageError, match=r"scores.*Use text as keys") as caught:
        encode(Envelope("x", {"scores": {*MULTIPLES[:100]}}))
    assert caught.value.reason == "colliding keys"


def test_honest_keys_of_every_kind_arrive():
    values = {
        "text": {f"name {n}": n for n in range(20_000)},
        "bytes": {b"%d" % n: None for n in range(1_000)},
        "offsets": dict.fromkeys(product((-2, -1, 0, 1), repeat=3)),
        "numbers": {1.5: "a", 2: "b", None: "c", False: "d", np.float32(7.5): "e", (1, frozenset({2})): "f"},
        "items": {-1, -2, 2.5, "text", (1, 2)},
    }
    back = decode(encode(Envelope("x", values))).parts
    assert dict(back) == values
