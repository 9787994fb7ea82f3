"""Random Python functions of the subset that `epypes export cpp` translates, with random inputs.

Every function is a few typed statements: the writer knows the kind of each variable (``int``, ``float``, ``bool``, a
list, or the dtype of an array that has the shape of the function's images), so that most functions run. A function that
raises on one of its inputs is not used.
"""

from __future__ import annotations

import random
import warnings
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

INTEGERS = ("uint8", "int16", "int32")
ARRAYS = (*INTEGERS, "float32", "float64", "mask")
SCALARS = ("int", "float", "bool")
HELPERS = """\
import math

import cv2
import numpy as np

LIMIT = 40
SCALE = 0.25


def floor_of(a, b=7):
    return a // b if b else -1


def spread(values, low=-3, *, high=9):
    count = 0
    for value in values:
        if not low <= value < high:
            continue
        count += 1
    return count, low + high


def inside(x, y, width=LIMIT):
    return 0 <= x < width and y % 2 == 0


def halves(image, factor=SCALE):
    return image * factor, image // 2
"""


@dataclass
class Written:
    """A function's name and source, and the kinds of its parameters and the number of its outputs."""

    name: str
    source: str
    parameters: dict[str, str]
    outputs: int
    inputs: list[dict[str, Any]] = field(default_factory=list)
    expected: list[tuple[Any, ...]] = field(default_factory=list)


class Writer:
    """Writes one function from a source of random choices."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.names: dict[str, list[str]] = {}
        self.lines: list[str] = []
        self.count = 0
        self.indent = 1
        self.in_loop = False
        # Views of arrays that are written to later.
        self.views: list[str] = []
        # What few people write, and has no translation: in few functions, since one such place is enough.
        self.is_odd = rng.random() < 0.15
        self.depth = rng.choice((1, 1, 2, 2, 3))

    # -- small choices -------------------------------------------------------------------------------------------------

    def one(self, *options: Any) -> Any:
        return self.rng.choice(options)

    def any_of(self, kind: str) -> str | None:
        return self.rng.choice(self.names[kind]) if self.names.get(kind) else None

    def fresh(self) -> str:
        self.count += 1
        return f"v{self.count}"

    def number(self) -> str:
        return str(self.one(0, 1, 2, 3, 5, 7, -1, -2, -3, -7, 11, 200))

    def real(self) -> str:
        return self.one("0.5", "-0.5", "1.5", "2.5", "-2.5", "0.1", "1e3", "-7.25", "3.0")

    def expression(self, kind: str, depth: int = 2) -> str:
        if depth <= 0 or self.rng.random() < 0.15:
            name = self.any_of(kind)
            if name:
                return name
        if kind in SCALARS:
            return getattr(self, f"{kind}_")(depth - 1)
        if kind in ("ints", "floats"):
            return self.list_(kind, depth - 1)
        return self.array(kind, depth - 1)

    # -- numbers -------------------------------------------------------------------------------------------------------

    def int_(self, d: int) -> str:
        if d < 0:
            return self.any_of("int") or self.number()
        e = self.expression
        options = [
            lambda: f"({e('int', d)} {self.one('+', '-', '*', '&', '|', '^')} {e('int', d)})",
            lambda: f"({e('int', d)} {self.one('//', '%')} {self.divisor()})",
            lambda: f"({e('int', d)} {self.one('//', '%')} {self.one(2, 3, 7, -2, -5)})",
            lambda: f"({e('int', 0)} ** {self.one(0, 1, 2, 3)})",
            lambda: f"({e('int', 0)} {self.one('<<', '>>')} {self.one(0, 1, 3)})",
            lambda: f"{self.one('-', '~', '+')}{e('int', 0)}",
            lambda: f"abs({e('int', d)})",
            lambda: f"{self.one('min', 'max')}({e('int', d)}, {e('int', d)})",
            lambda: f"({e('int', d)} if {e('bool', d)} else {e('int', d)})",
            lambda: f"({e('bool', d)} + {e('bool', d)})",
            lambda: f"{self.one('int', 'round', 'math.floor', 'math.ceil')}({e('float', d)})",
            lambda: f"int({e('bool', d)})",
            lambda: f"floor_of({e('int', d)}{self.one('', ', 3', ', b=-4')})",
            lambda: f"LIMIT * {e('int', d)}",
        ]
        if self.is_odd:
            options += [
                lambda: f"divmod({e('int', d)}, {self.one(3, -4)})[{self.one(0, 1, -1)}]",
                lambda: f"({e('int', d)} {self.one('and', 'or')} {e('int', d)})",
            ]
        if self.any_of("ints"):
            values = self.any_of("ints")
            options += [
                lambda: f"len({values})",
                lambda: f"{self.one('sum', 'len')}({values})",
                lambda: f"{values}[{self.one(0, -1)}]",
                lambda: f"spread({values}{self.one('', ', -1', ', low=2', ', high=50')})[{self.one(0, 1)}]",
                lambda: f"sum({self.one('x', 'x * x', 'x // 2', '-x')} for x in {values} if x {self.one('>', '!=')} 1)",
            ]
        array = self.some_array()
        if array:
            name, kind = array
            part = self.part(name)
            options += [
                lambda: f"{name}.shape[{self.one(0, 1, -1)}]",
                lambda: f"int({name}[{self.place()}])",
                lambda: f"int(np.{self.one('argmax', 'argmin')}({name}))",
                lambda: f"{name}.size",
                lambda: f"len({name})",
                lambda: f"int(np.count_nonzero({name} {self.one('>', '<=')} {self.one(0, 3, 99)}))",
            ]
            if kind in INTEGERS:
                options += [
                    lambda: f"int({part}.{self.one('sum', 'min', 'max')}())",
                    lambda: f"int(np.{self.one('sum', 'max', 'min')}({part}))",
                ]
            if kind == "mask":
                options += [lambda: f"int({name}.sum())", lambda: f"int(np.sum({part}))"]
            if kind == "uint8":
                options += [lambda: f"cv2.countNonZero({name})"]
        return self.rng.choice(options)()

    def float_(self, d: int) -> str:
        if d < 0:
            return self.any_of("float") or self.real()
        e = self.expression
        options = [
            lambda: f"({e('float', d)} {self.one('+', '-', '*')} {e(self.one('float', 'int'), d)})",
            lambda: f"({e(self.one('float', 'int'), d)} / {self.divisor()})",
            lambda: f"({e('float', d)} {self.one('//', '%')} {self.one('2.5', '-0.75', '3', '-2')})",
            lambda: f"({e('float', 0)} ** 2)",
            lambda: f"abs({e('float', d)})",
            lambda: f"-{e('float', 0)}",
            lambda: f"math.sqrt(abs({e('float', d)}))",
            lambda: f"{self.one('min', 'max')}({e('float', d)}, {e('float', d)})",
            lambda: f"float({e(self.one('int', 'bool'), d)})",
            lambda: f"({e('float', d)} if {e('bool', d)} else {e('float', d)})",
            lambda: f"({e('int', d)} / {self.one(2, 3, -7)})",
            lambda: f"(SCALE * {e('int', d)})",
            lambda: f"max(0.0, min({e('float', d)}, 1.0))",
        ]
        array = self.some_array()
        if array:
            name, kind = array
            options += [
                lambda: f"float({self.part(name)}.mean())",
                lambda: f"float(np.mean({name}))",
                lambda: f"float({name}[{self.place()}])",
                lambda: f"float({name}.{self.one('min', 'max')}())" if kind != "mask" else f"float({name}.mean())",
            ]
        if self.any_of("floats"):
            values = self.any_of("floats")
            options += [
                lambda: f"sum({values})",
                lambda: f"{values}[-1]",
                lambda: f"{self.one('min', 'max')}({values})",
            ]
        return self.rng.choice(options)()

    def bool_(self, d: int) -> str:
        if d < 0:
            return self.any_of("bool") or self.one("True", "False")
        e = self.expression
        compared = self.one("int", "float")
        other = self.one("int", "float") if self.is_odd else compared
        options = [
            lambda: f"({e(compared, d)} {self.comparison()} {e(other, d)})",
            lambda: (
                f"({e('int', d)} {self.comparison()} {e('int', d)} {self.comparison()} {e(other if self.is_odd else 'int', d)})"
            ),
            lambda: f"({e('bool', d)} {self.one('and', 'or')} {e('bool', d)})",
            lambda: f"({e('bool', d)} {self.one('==', '!=', '^', '&', '|')} {e('bool', d)})",
            lambda: f"(not {e(self.one('bool', 'int', 'float'), d)})",
            lambda: f"inside({e('int', d)}, {e('int', d)}{self.one('', ', 3', ', width=100')})",
            lambda: f"({e('int', d)} {self.one('in', 'not in')} ({self.number()}, {self.number()}, 4))",
            lambda: f"bool({e('int', d)})",
        ]
        if self.any_of("mask"):
            options += [lambda: f"bool({self.any_of('mask')}.{self.one('any', 'all')}())"]
        if self.any_of("ints"):
            options += [lambda: f"bool({self.any_of('ints')})"]
            if self.is_odd:
                options += [lambda: f"({e('int', d)} in {self.any_of('ints')})"]
        return self.rng.choice(options)()

    def divisor(self) -> str:
        """Return a number that is not zero, nearly always."""
        if self.is_odd:
            return f"({self.expression('int', 0)} or {self.one(3, -4)})"
        return f"({self.expression('int', 0)} * 2 + {self.one(1, 5, -3)})"

    def comparison(self) -> str:
        return self.one("<", "<=", ">", ">=", "==", "!=")

    def list_(self, kind: str, d: int) -> str:
        item = kind[:-1]
        others = self.any_of(kind)
        options = [
            lambda: f"[{', '.join(self.expression(item, d) for _ in range(self.one(1, 2, 3)))}]",
            lambda: (
                f"[{self.one('x', 'x + 1', 'x * 2', 'x - 3')} for x in range({self.one('4', '-2, 5', '7, 0, -2')})]"
                if item == "int"
                else f"[x / {self.one(2, 3)} for x in range(4)]"
            ),
        ]
        if others:
            options += [
                lambda: f"{others}[{self.one(':', '1:', ':-1', '::-1', '::2', '-2:')}]",
                lambda: f"sorted({others}{self.one('', ', reverse=True')})",
            ]
        if others and self.is_odd:
            options += [
                lambda: f"({others} + [{self.expression(item, d)}])",
                lambda: (
                    f"[x for x in {others} if x {self.comparison()} {self.expression(item, 0)}] + [{self.number() if item == 'int' else self.real()}]"
                ),
            ]
        return self.rng.choice(options)()

    # -- arrays --------------------------------------------------------------------------------------------------------

    def some_array(self) -> tuple[str, str] | None:
        found = [(name, kind) for kind in ARRAYS for name in self.names.get(kind, ())]
        return self.rng.choice(found) if found else None

    def place(self) -> str:
        return self.one("0, 0", "-1, 2", "1, -1", "2, 1", "-2, -2")

    def part(self, name: str) -> str:
        return name + self.one(
            "", "[1:]", "[:, 1:3]", "[::2, ::-1]", "[-2:, :-1]", "[0]", "[:, -1]", "[1:2, 0:99]", "[::-1]"
        )

    def literal(self, kind: str) -> str:
        if kind.startswith("float"):
            return self.real()
        return str(self.one(0, 1, 2, 3, 7, 100)) if kind == "uint8" else self.number()

    def array(self, kind: str, d: int) -> str:
        if d < 0:
            name = self.any_of(kind)
            if name:
                return name
            source, other = self.some_array()
            if kind == "mask":
                return f"({source} > {self.one(0, 1, 5)})" if other != "mask" else f"~{source}"
            if kind in INTEGERS and other.startswith("float"):
                return f"np.clip({source}, 0, 99).astype(np.{kind})"
            return f"{source}.astype(np.{kind})"
        if kind == "mask":
            return self.mask(d)
        e = self.expression
        literal = self.literal
        options = [
            lambda: f"({e(kind, d)} {self.one('+', '-', '*')} {e(kind, d)})",
            lambda: f"({e(kind, d)} {self.one('+', '-', '*')} {literal(kind)})",
            lambda: f"({literal(kind)} {self.one('+', '-', '*')} {e(kind, d)})",
            lambda: (
                f"({e(kind, d)} {self.one('//', '%')} {self.one('2', '3', '7') if kind == 'uint8' else self.one('2', '3', '-4')})"
            ),
            lambda: f"(-{e(kind, d)})",
            lambda: f"np.abs({e(kind, d)})",
            lambda: f"np.{self.one('minimum', 'maximum')}({e(kind, d)}, {self.one(e(kind, d), literal(kind))})",
            lambda: f"np.where({e('mask', d)}, {e(kind, d)}, {self.one(e(kind, d), literal(kind))})",
            lambda: f"np.clip({e(kind, d)}, {self.one('0, 100', '3, 50', '10, 20')})",
            lambda: f"{e(kind, 0)}{self.one('[::-1]', '[:, ::-1]', '[::-1, ::-1]')}",
            lambda: f"{e(kind, 0)}.copy()",
            lambda: f"np.{self.one('zeros_like', 'ones_like')}({e(kind, 0)})",
            lambda: f"np.full({self.some_array()[0]}.shape, {literal(kind)}, np.{kind})",
            lambda: f"np.sort({e(kind, d)}, axis={self.one(0, 1, -1) if self.is_odd else -1})",
            lambda: f"cv2.{self.one('min', 'max')}({e(kind, 0)}, {e(kind, 0)})",
        ]
        if kind in INTEGERS:
            options += [
                lambda: f"{e(self.one(*INTEGERS), d)}.astype(np.{kind})",
                lambda: f"np.clip({e(self.one('float32', 'float64'), d)}, 0, 127).astype(np.{kind})",
                lambda: f"({e(kind, d)} {self.one('&', '|', '^')} {e(kind, d)})",
                lambda: f"(~{e(kind, d)})",
                lambda: f"({e(kind, d)} {self.one('<<', '>>')} {self.one(1, 2)})",
                lambda: f"{e('mask', d)}.astype(np.{kind})",
            ]
        else:
            options += [
                lambda: f"({e(kind, d)} / {literal(kind)})",
                lambda: f"{e(self.one(*INTEGERS), d)}.astype(np.{kind})",
                lambda: f"np.sqrt(np.abs({e(kind, d)}))",
                lambda: f"({e(kind, d)} ** 2)",
            ]
        if kind == "float64":
            options += [
                lambda: f"({e(self.one(*INTEGERS), d)} / {self.one(2, 3, -7)})",
                lambda: f"({e(self.one(*INTEGERS), d)} * {self.one(0.5, -1.5)})",
                lambda: f"({e('int32', d)} + {e('float32', d)})",
                lambda: f"halves({e('uint8', d)}{self.one('', ', factor=0.5')})[0]",
            ]
        if kind == "float32":
            options += [
                lambda: f"({e('uint8', d)} * {e('float32', d)})",
                lambda: f"({e('int16', d)} + {e('float32', d)})",
            ]
        if kind == "int32":
            options += [
                lambda: f"({e('int16', d)} + {e('int32', d)})",
                lambda: f"np.where({e('mask', d)}, {e('uint8', d)}, {e('int32', d)})",
            ]
        if kind == "int16":
            options += [lambda: f"({e('uint8', d)} - {e('int16', d)})", lambda: f"({e('mask', d)} * {e('int16', d)})"]
        if kind == "uint8":
            options += self.vision(d)
        return self.rng.choice(options)()

    def mask(self, d: int) -> str:
        e = self.expression
        kind = self.one(*ARRAYS[:-1])
        options = [
            lambda: f"({e(kind, d)} {self.comparison()} {e(kind, d)})",
            lambda: f"({e(kind, d)} {self.comparison()} {self.one(self.literal(kind), '300', '-1')})",
            lambda: f"({e('mask', d)} {self.one('&', '|', '^')} {e('mask', d)})",
            lambda: f"(~{e('mask', d)})",
            lambda: f"np.logical_{self.one('and', 'or', 'xor')}({e('mask', d)}, {e('mask', d)})",
            lambda: f"(({e(kind, d)} > {self.literal(kind)}) & ({e(kind, d)} <= 90))",
        ]
        return self.rng.choice(options)()

    def vision(self, d: int) -> list[Any]:
        """Functions of OpenCV whose results are the same bits in all its versions."""
        e = self.expression
        image = lambda: e("uint8", d)  # noqa: E731
        kernel = "np.ones((3, 3), np.uint8)"
        shape = "cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))"
        options = [
            f"cv2.{self.one('add', 'subtract', 'absdiff', 'bitwise_and', 'bitwise_or', 'bitwise_xor')}({image()}, {image()})",
            f"cv2.bitwise_not({image()}, mask={e('mask', d)}.astype(np.uint8))",
            f"cv2.threshold({image()}, {self.one(10, 99.5)}, 255, cv2.{self.one('THRESH_BINARY', 'THRESH_TOZERO_INV')})[1]",
            f"cv2.{self.one('dilate', 'erode')}({image()}, {self.one('None', kernel, shape)}{self.one('', ', iterations=2')})",
            f"cv2.morphologyEx({image()}, cv2.MORPH_{self.one('OPEN', 'CLOSE', 'GRADIENT')}, {self.one(kernel, shape)})",
            f"cv2.medianBlur({image()}, {self.one(3, 5)})",
            f"cv2.blur({image()}, (3, 3), borderType=cv2.BORDER_{self.one('REPLICATE', 'REFLECT')})",
            f"cv2.flip({image()}, {self.one(0, 1, -1)})",
            f"cv2.copyMakeBorder({image()}, 1, 1, 2, 2, cv2.BORDER_CONSTANT, value={self.one('7', '(9,)')})[1:-1, 2:-2]",
            f"cv2.inRange({image()}, {self.one('10, 99', '(5,), (80,)')})",
            f"cv2.resize({image()}, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)[::2, ::2]",
            f"cv2.boxFilter({image()}, -1, (3, 3), normalize=False)",
        ]
        return [lambda text=text: text for text in options]

    # -- statements ----------------------------------------------------------------------------------------------------

    def emit(self, text: str) -> None:
        self.lines.append("    " * self.indent + text)

    def assign(self, kind: str) -> None:
        text = self.expression(kind, self.depth)
        old = self.names.get(kind, [])
        if old and self.rng.random() < 0.3:
            self.emit(f"{self.rng.choice(old)} = {text}")
            return
        if self.indent > 1:  # a new name in a branch would not exist after it
            if old:
                self.emit(f"{self.rng.choice(old)} = {text}")
            return
        name = self.fresh()
        self.emit(f"{name} = {text}")
        self.names.setdefault(kind, []).append(name)

    def block(self, count: int) -> None:
        before = {kind: list(names) for kind, names in self.names.items()}
        self.indent += 1
        length = len(self.lines)
        for _ in range(count):
            self.statement()
        if len(self.lines) == length:
            self.emit("pass")
        self.indent -= 1
        self.names = before

    def kinds(self) -> tuple[str, ...]:
        return (*SCALARS, "ints", "floats", *(ARRAYS if self.some_array() else ()))

    def statement(self) -> None:
        options = ["assign"] * 6 + ["augmented", "swap", "pair"]
        if self.indent < 3:
            options += ["branch", "branch", "ranged", "counted", "each"]
        if self.some_array():
            options += ["place_in", "place_in", "masked", "view"]
        if self.any_of("ints"):
            options += ["append"]
        if self.in_loop:
            options += ["leave"]
        getattr(self, f"do_{self.rng.choice(options)}")()

    def do_assign(self) -> None:
        self.assign(self.rng.choice(self.kinds()))

    def do_augmented(self) -> None:
        name = self.any_of("int")
        if name:
            self.emit(f"{name} {self.one('+=', '-=', '//=', '%=', '|=')} {self.one(2, 3, -5)}")
        name = self.any_of("float")
        if name:
            self.emit(f"{name} {self.one('+=', '*=', '/=')} {self.one('0.5', '3', '-2.5')}")

    def do_swap(self) -> None:
        kind = self.one(*SCALARS)
        if len(self.names.get(kind, ())) > 1:
            a, b = self.rng.sample(self.names[kind], 2)
            self.emit(f"{a}, {b} = {b}, {a}")

    def do_pair(self) -> None:
        if self.indent > 1:
            return
        a, b = self.fresh(), self.fresh()
        self.emit(f"{a}, {b} = {self.expression('int')}, {self.expression('float')}")
        self.names.setdefault("int", []).append(a)
        self.names.setdefault("float", []).append(b)

    def do_branch(self) -> None:
        self.emit(f"if {self.expression(self.one('bool', 'bool', 'int'))}:")
        self.block(2)
        if self.rng.random() < 0.4:
            self.emit(f"elif {self.expression('bool')}:")
            self.block(1)
        if self.rng.random() < 0.6:
            self.emit("else:")
            self.block(1)

    def loop(self, head: str, kind: str, *names: str) -> None:
        self.emit(head)
        before, self.in_loop = self.in_loop, True
        for name in names:
            self.names.setdefault(kind, []).append(name)
        self.block(2)
        for name in names:
            self.names[kind].remove(name)
        self.in_loop = before
        if self.is_odd:
            self.emit("else:")
            self.block(1)

    def do_ranged(self) -> None:
        name = self.fresh()
        self.loop(f"for {name} in range({self.one('3', '2, 5', '5, 0, -2', '-1, 2', '0')}):", "int", name)

    def do_each(self) -> None:
        values, name = self.any_of("ints"), self.fresh()
        if values:
            index = self.fresh()
            head = self.one(f"for {name} in {values}[:4]:", f"for {index}, {name} in enumerate({values}[:4]):")
            self.loop(head, "int", name, *([index] if "enumerate" in head else []))

    def do_counted(self) -> None:
        name = self.fresh()
        self.emit(f"{name} = {self.one(2, 3)}")
        further = f" and {self.expression('bool', 1)}"
        self.emit(f"while {name} > 0{self.one('', further)}:")
        self.indent += 1
        self.emit(f"{name} -= 1")
        self.indent -= 1
        before, self.in_loop = self.in_loop, True
        self.block(2)
        self.in_loop = before

    def do_leave(self) -> None:
        self.emit(f"if {self.expression('bool', 1)}:")
        self.emit(f"    {self.one('break', 'continue')}")

    def do_append(self) -> None:
        name = self.any_of("ints")
        if not name.startswith("v") and self.indent == 1:
            name = self.fresh()
            self.emit(f"{name} = []")
            self.names["ints"].append(name)
        if name.startswith("v") or self.is_odd:
            text = self.one("reverse()", "sort()", "copy()") if self.is_odd else f"append({self.expression('int', 1)})"
            self.emit(f"{name}.{text}")

    def changeable(self) -> tuple[str, str] | None:
        """Return an array of the function's own: inputs are read-only."""
        if self.indent > 1:
            found = [(n, k) for k in ARRAYS[:-1] for n in self.names.get(k, ()) if n.startswith("own")]
            return self.rng.choice(found) if found else None
        name, kind = self.some_array()
        if kind == "mask":
            return None
        own = f"own{self.fresh()}"
        self.emit(f"{own} = {name}.copy()")
        self.names[kind].append(own)
        return own, kind

    def do_place_in(self) -> None:
        found = self.changeable()
        if found:
            name, kind = found
            where = self.one("1:3, ::2", "0", "::-1", "-2:", ":, 1", "1, 2", "...")
            self.emit(f"{name}[{where}] {self.one('=', '=', '+=', '-=', '*=')} {self.literal(kind)}")

    def do_masked(self) -> None:
        found = self.changeable()
        if found:
            name, kind = found
            mask = self.expression("mask", 1)
            self.emit(f"{name}[{mask}] {self.one('=', '=', '+=')} {self.literal(kind)}")

    def do_view(self) -> None:
        found = self.changeable()
        if found and self.indent == 1:
            name, kind = found
            view = f"part{self.fresh()}"
            self.emit(f"{view} = {name}[{self.one('1:', ':, 1:', '::2', '0:2, 1:')}]")
            other = self.one("[::-1]", ".T", ".T + 1", "[:, ::2]", ".astype(np.int32)", "")
            shape = self.one("", "", ".reshape(-1)", ".ravel()", "[:, 0].reshape(-1, 1)", ".reshape(1, -1, 1)")
            listed = self.one(
                f"{view}s = [({name}{other}){shape}]", f"{view}s = [{name}{other}, {name}]", f"{view}s = [{view}]"
            )
            self.emit(listed)
            self.views.append(f"{view}s[0]")
            self.emit(
                self.one(f"{view} += {self.literal(kind)}", f"{view}[0] = {self.literal(kind)}", f"{name}[1] = 5")
            )

    # -- the whole -----------------------------------------------------------------------------------------------------

    def returned(self) -> list[str]:
        kept = [name for names in self.names.values() for name in names]
        chosen = self.rng.sample(kept, min(len(kept), 3))
        chosen += self.views
        array = self.some_array()
        if array:
            name, kind = array
            reductions = "sum", "min", "max", "mean"
            chosen.append(
                self.one(
                    self.part(name),
                    f"{name}.{self.one(*reductions)}(axis={self.one(0, 1)})"
                    if kind != "mask"
                    else f"{name}.sum(axis=0)",
                    f"{name}[{self.expression('mask', 1)}]",
                    f"{name}.{self.one(*reductions)}()" if kind != "mask" else f"{name}.any()",
                    f"np.{self.one('argmax', 'argmin')}({name}{f', axis={self.one(0, 1)}' if self.is_odd else ''})",
                    f"{name}.T",
                    f"{name}.shape",
                    f"np.sort({name}[{self.expression('mask', 1)}])",
                )
            )
        else:
            chosen.append(self.expression(self.one(*SCALARS)))
        return chosen

    def function(self, name: str) -> Written:
        kinds = [self.one(*SCALARS[:2]) for _ in range(self.one(1, 2, 3))]
        if self.rng.random() < 0.2:
            kinds.append("ints")
        if self.rng.random() < 0.65:
            kinds += self.rng.sample(ARRAYS, self.one(1, 2, 3))
        parameters = dict(zip("abcdefgh", kinds, strict=False))
        for parameter, kind in parameters.items():
            self.names.setdefault(kind, []).append(parameter)
        for _ in range(self.one(1, 2, 3, 4, 5)):
            self.statement()
        returned = self.returned()
        head = f"def {name}({', '.join(parameters)}):"
        body = [*self.lines, f"    return {', '.join(returned)}"]
        return Written(name, "\n".join([head, *body]), parameters, len(returned))


def random_value(rng: random.Random, kind: str, shape: tuple[int, int]) -> Any:
    """Return a value of a kind; the extremes of its type are frequent."""
    if kind == "int":
        return rng.choice([0, 1, -1, 2, 3, -3, 7, -8, 13, rng.randint(-60, 60)])
    if kind == "float":
        return rng.choice([0.0, 0.5, -0.5, 1.5, 2.5, -2.5, 1e-3, rng.uniform(-50, 50), float(rng.randint(-9, 9))])
    if kind == "bool":
        return rng.random() < 0.5
    if kind == "ints":
        return [rng.randint(-9, 30) for _ in range(rng.randint(1, 5))]
    numbers = np.random.default_rng(rng.randrange(2**32))
    if kind == "mask":
        return numbers.random(shape) < 0.4
    if kind.startswith("float"):
        return (numbers.integers(-1200, 1200, shape) / 4).astype(kind)
    limits = np.iinfo(kind)
    values = numbers.integers(limits.min, limits.max, shape, dtype=kind, endpoint=True)
    small = numbers.integers(0, 10, shape).astype(kind)
    return np.where(numbers.random(shape) < 0.5, values, small)


def _same_kind(first: Any, other: Any) -> bool:
    if isinstance(first, np.ndarray):
        return isinstance(other, np.ndarray) and (first.dtype, first.ndim) == (other.dtype, other.ndim)
    if isinstance(first, tuple) and type(other) is tuple:
        return len(first) == len(other) and all(map(_same_kind, first, other))
    return type(first) is type(other)


def _is_small(value: Any) -> bool:
    if isinstance(value, int):
        return abs(value) < 2**53
    if isinstance(value, (list, tuple)):
        return all(map(_is_small, value))
    return not isinstance(value, np.ndarray) or 0 not in value.shape or value.ndim == 1


def call(function: Any, inputs: dict[str, Any]) -> Any:
    """Call a function as a runner does: its arrays are read-only, its lists its own."""
    given = {}
    for name, value in inputs.items():
        if isinstance(value, np.ndarray):
            value = value.copy()
            value.flags.writeable = False
        given[name] = list(value) if isinstance(value, list) else value
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*in cast")  # what the result is depends on the processor
        return function(**given)


def functions(seed: int, count: int, samples: int = 3) -> list[Written]:
    """Return functions that run, and give values of the same types, on each of their inputs."""
    rng = random.Random(seed)
    found: list[Written] = []
    number = 0
    while len(found) < count:
        number += 1
        written = Writer(rng).function(f"f{number}")
        names: dict[str, Any] = {}
        exec(f"{HELPERS}\n\n{written.source}\n", names)
        try:
            for _ in range(samples):
                shape = rng.randint(3, 6), rng.randint(3, 6)
                inputs = {name: random_value(rng, kind, shape) for name, kind in written.parameters.items()}
                made = call(names[written.name], inputs)
                written.inputs.append(inputs)
                written.expected.append(made)
        except (ArithmeticError, ValueError, IndexError, TypeError, RuntimeWarning, cv2.error):
            continue
        if all(_same_kind(written.expected[0], made) and _is_small(made) for made in written.expected):
            found.append(written)
    return found
