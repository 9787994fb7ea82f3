"""A snapshot finds every change of what some values reach, names the value, and puts it back."""

from __future__ import annotations

import array
import collections
import functools
import io
import itertools
import pathlib
import random
import types

import numpy as np
import pandas as pd
import pytest

from epypes.run.snapshot import Snapshot

pytestmark = pytest.mark.filterwarnings("ignore:Setting the")  # NumPy 2.5 deprecates what some tests do to arrays


class Plain:
    def __init__(self):
        self.items, self.count = [], 0

    @functools.cached_property
    def length(self):
        return len(self.items)


class Slotted:
    __slots__ = ("items", "late")

    def __init__(self):
        self.items = []


class Named(dict):
    pass


@functools.lru_cache
def table(n):
    return [n]


def move_first(ordered):
    ordered.move_to_end("a")


# By name: what makes a value, what changes it, and what shows its contents.
CHANGES = {
    "list": (lambda: [1, 2], lambda v: v.append(3), list),
    "equal number of another type": (lambda: [1], lambda v: v.__setitem__(0, True), repr),
    "sign of a zero": (lambda: [0.0], lambda v: v.__setitem__(0, -0.0), repr),
    "dict": (lambda: {"a": 1}, lambda v: v.update(b=2), dict),
    "order of a dict": (lambda: {"a": 1, "b": 2}, lambda v: v.update(a=v.pop("a")), list),
    "order of an OrderedDict": (lambda: collections.OrderedDict(a=1, b=2), move_first, list),
    "defaultdict": (lambda: collections.defaultdict(list), lambda v: v["new"], dict),
    "Counter": (lambda: collections.Counter("ab"), lambda v: v.update("a"), dict),
    "attribute of a dict": (Named, lambda v: setattr(v, "a", 1), lambda v: dict(vars(v))),
    "set": (lambda: {1, 2}, lambda v: v.add(3), set),
    "deque": (lambda: collections.deque([1, 2], maxlen=2), lambda v: v.append(3), list),
    "bytearray": (lambda: bytearray(b"ab"), lambda v: v.extend(b"c"), bytes),
    "memoryview": (lambda: memoryview(bytearray(b"ab")), lambda v: v.__setitem__(0, 0), bytes),
    "array": (lambda: array.array("d", [1, 2]), lambda v: v.append(3), list),
    "NumPy array": (lambda: np.array([1.0, np.nan]), lambda v: v.__setitem__(0, 3), bytes),
    "base of a view": (lambda: np.zeros((2, 4))[:, ::2], lambda v: v.base.__setitem__((0, 0), 3), bytes),
    "shape": (lambda: np.zeros((2, 3)), lambda v: setattr(v, "shape", (3, 2)), np.shape),
    "dtype": (lambda: np.zeros(2, "u1"), lambda v: setattr(v, "dtype", "i1"), lambda v: v.dtype),
    "objects in an array": (lambda: np.array([{}, []], object),
                            lambda v: v[1].append(1), lambda v: repr(v.tolist())),
    "mask": (lambda: np.ma.masked_array([1, 2], [False, True]), lambda v: v.mask.__setitem__(0, True), repr),
    "attribute": (Plain, lambda v: setattr(v, "count", 1), lambda v: dict(vars(v))),
    "new attribute": (Plain, lambda v: setattr(v, "other", 1), lambda v: dict(vars(v))),
    "list of an object": (Plain, lambda v: v.items.append(1), lambda v: repr(vars(v))),
    "slot": (Slotted, lambda v: v.items.append(1), lambda v: repr(v.items)),
    "empty slot": (Slotted, lambda v: setattr(v, "late", 1), lambda v: hasattr(v, "late")),
    "namespace": (lambda: types.SimpleNamespace(a=1), lambda v: setattr(v, "_b", 2) or setattr(v, "a", 3), repr),
    "inside of tuples": (lambda: (1, ({"a": [2]},)), lambda v: v[1][0]["a"].append(3), repr),
    "bound method": (lambda: [1].append, lambda v: v(2), lambda v: list(v.__self__)),
    "partial": (lambda: functools.partial(print, [1]), lambda v: v.args[0].append(2), repr),
    "value of an lru_cache": (lambda: table, lambda v: v(5).append(1), lambda v: repr(v(5))),
    "Random": (lambda: random.Random(1), lambda v: v.random(), lambda v: v.getstate()),
    "NumPy Generator": (lambda: np.random.default_rng(1), lambda v: v.random(), lambda v: v.bit_generator.state),
    "RandomState": (lambda: np.random.RandomState(1), lambda v: v.rand(), lambda v: repr(v.get_state())),
    "BytesIO": (lambda: io.BytesIO(b"ab"), lambda v: v.read(1), lambda v: v.tell()),
    "StringIO": (lambda: io.StringIO("ab"), lambda v: v.seek(2) and v.write("c"), lambda v: (v.getvalue(), v.tell())),
    "DataFrame": (lambda: pd.DataFrame({"a": [1, 2]}), lambda v: v.insert(0, "b", 3), lambda v: v.to_csv()),
    "Series": (lambda: pd.Series([1, 2]), lambda v: v.__setitem__(0, 3), lambda v: v.to_csv()),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_a_change_is_found_and_undone(case):
    make, change, contents = CHANGES[case]
    table.cache_clear()
    table(5)
    value = make()
    before = contents(value)
    snapshot = Snapshot({"other": [1], "value": value, "again": [value]})
    assert snapshot
    assert snapshot.changed() is None
    change(value)
    assert contents(value) != before
    assert snapshot.changed() == "value"
    snapshot.restore()
    assert contents(value) == before
    assert snapshot.changed() is None
    change(value)
    assert snapshot.changed() == "value", "what is put back is another copy than the one that was changed"


def generator():
    for number in range(9):  # noqa: UP028
        yield number


ITERATORS = {
    "list": lambda: iter([1, 2, 3]),
    "range": lambda: iter(range(9)),
    "count": itertools.count,
    "cycle": lambda: itertools.cycle([1, 2]),
    "repeat": lambda: itertools.repeat(1, 3),
    "zip": lambda: zip([1, 2], [3, 4], strict=True),
    "map": lambda: map(abs, [1, 2]),
    "enumerate": lambda: enumerate("abc"),
    "chain": lambda: itertools.chain([1], [2]),
    "generator": generator,
    "generator over an iterator": lambda: (number for number in iter([1, 2])),
    "bound next": lambda: itertools.count().__next__,
}


@pytest.mark.parametrize("case", ITERATORS)
def test_an_iterator_counts_as_changed_when_something_was_taken_and_stays_so(case):
    iterator = ITERATORS[case]()
    snapshot = Snapshot({"iterator": iterator})
    assert snapshot.changed() is None
    iterator() if callable(iterator) else next(iterator)
    assert snapshot.changed() == "iterator"
    snapshot.restore()
    assert snapshot.changed() == "iterator", "none can be set back, so it can't be relied on"


def test_cycles_and_shared_objects_are_walked_once():
    ring: list = [1]
    ring.append(ring)
    shared = {"ring": ring}
    snapshot = Snapshot({"a": shared, "b": shared})
    assert snapshot.changed() is None
    ring.append(2)
    assert snapshot.changed() == "a"
    snapshot.restore()
    assert len(ring) == 2
    assert ring[1] is ring


def test_what_is_put_back_is_the_very_object():
    inner: list = [1]
    outer = [inner, inner]
    snapshot = Snapshot({"outer": outer})
    inner.append(2)
    outer[0] = []
    snapshot.restore()
    assert outer[0] is outer[1] is inner == [1]


def test_an_equal_constant_in_its_place_is_no_change():
    state = {"n": 1000, "x": float("nan"), "t": (1.5, "ab"), "s": np.float64(2.5)}
    snapshot = Snapshot({"state": state})
    state.update(n=int("1000"), x=float("nan"), t=(float("1.5"), "".join("ab")), s=np.float64("2.5"))
    assert snapshot.changed() is None
    state["s"] = np.float32(2.5)
    assert snapshot.changed() == "state"


@pytest.mark.parametrize(
    "value",
    [1, "a", None, (1, 2.5), b"ab", np.float64(1), np.dtype("u1"), frozenset({1}), print, Plain, np, range(3), 1j],
    ids=str,
)
def test_constants_cost_nothing(value):
    assert not Snapshot({"value": value})


def test_what_an_array_that_is_locked_holds_is_not_copied():
    image = np.zeros((9, 9))
    image.flags.writeable = False
    assert not Snapshot({"image": image[1:]})


def test_caches_that_objects_fill_are_no_change():
    path, plain, many = pathlib.PurePath("a/b"), Plain(), np.vectorize(lambda n: n + 1)
    snapshot = Snapshot({"path": path, "plain": plain, "table": table, "many": many})
    assert (str(path), plain.length, table(77)) == ("a/b", 0, [77])
    assert hash(path)
    assert many(3) == 4
    assert snapshot.changed() is None
