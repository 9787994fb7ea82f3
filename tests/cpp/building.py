"""Bundles of source text with many functions, and the C++ projects that are exported from them."""

from __future__ import annotations

import ast
import inspect
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.wire import save_sample


def bundle_of(folder: Path, source: str, inputs: Mapping[str, Sequence[tuple[Any, ...]]], call: Any) -> Path:
    """Write a bundle whose graph has each of these functions once, none connected to another.

    ``inputs`` has the values of a function's parameters, one tuple per sample; a function that has fewer samples than
    others repeats its last. Tokens are ``NAME_PARAMETER`` and ``NAME_out``, or ``NAME_0`` and so on where the function
    returns a tuple.
    """
    names: dict[str, Any] = {}
    exec(source, names)
    count = max(map(len, inputs.values()))
    given: list[dict[str, Any]] = [{} for _ in range(count)]
    made: list[dict[str, Any]] = [{} for _ in range(count)]
    lines = []
    for name, samples in inputs.items():
        parameters = [*inspect.signature(names[name]).parameters]
        tokens = [f"{name}_{parameter}" for parameter in parameters]
        outputs: list[str] = []
        for number in range(count):
            values = samples[min(number, len(samples) - 1)]
            value = call(names[name], dict(zip(parameters, values, strict=True)))
            is_tuple = type(value) is tuple and len(value) > 1
            outputs = [f"{name}_{place}" for place in range(len(value))] if is_tuple else [f"{name}_out"]
            given[number] |= dict(zip(tokens, values, strict=True))
            made[number] |= dict(zip(outputs, value if is_tuple else (value,), strict=True))
        lines.append(f"    {name!r}: ({tuple(tokens)!r}, {tuple(outputs) if len(outputs) > 1 else outputs[0]!r}),")
    (folder / "samples").mkdir(parents=True)
    functions = "".join(f"    {name!r}: {name},\n" for name in inputs)
    graph = f"func_dict = {{\n{functions}}}\nfunc_io = {{\n" + "\n".join(lines) + "\n}\n"
    (folder / "pipeline.py").write_text(f'"""Functions of a test."""\n\n{source}\n\n{graph}')
    ports = f"inputs = {[*given[0]]!r}\noutputs = {[*made[0]]!r}".replace("'", '"')
    text = f'[bundle]\nformat = 1\nname = "{folder.name}"\n[ports]\n{ports}\n'
    (folder / "pipeline.toml").write_text(text)
    (folder / "requirements.txt").write_text("")
    for number, (values, results) in enumerate(zip(given, made, strict=True)):
        save_sample(folder / "samples" / f"{number:03}.npz", values, results)
    write_manifest(folder)
    return folder


@dataclass(frozen=True)
class Replayed:
    """An exported project that was compiled, and what its replay has found.

    Attributes
    ----------
    export
        What was exported.
    program
        The replay.
    lines
        By function, the lines of what is not bit-identical.
    """

    export: ep.CppExport
    program: Path
    lines: dict[str, list[str]]

    @property
    def translated(self) -> list[str]:
        """The functions that are translated."""
        return [each.function for each in self.export.functions if not each.is_by_hand]

    @property
    def by_hand(self) -> dict[str, str]:
        """The reasons of those that are not, by function."""
        return {each.function: each.reason for each in self.export.functions if each.is_by_hand}

    @property
    def wrong(self) -> dict[str, list[str]]:
        """The translated functions that compute something else, with the lines that show it."""
        return {name: self.lines[name] for name in self.translated if self.lines[name]}


def export_and_replay(bundle: Path, *options: str) -> Replayed:
    """Export a bundle, compile its replay, and run it."""
    export = ep.export_cpp(bundle, bundle.with_name(f"{bundle.name}_cpp"))
    program = build(export.path, *options, target="replay") / "replay"
    return Replayed(export, program, replay(export, program))


def build(project: Path, *options: str, target: str = "all") -> Path:
    """Configure and compile a project; return the folder of its programs."""
    built = project.with_name(f"{project.name}_build")
    for command in (["-S", str(project), "-B", str(built), *options], ["--build", str(built), "--target", target]):
        done = subprocess.run(["cmake", *command], capture_output=True, text=True)
        assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-6000:]}"
    return built


def replay(export: ep.CppExport, program: Path, *options: str | Path) -> dict[str, list[str]]:
    """Run a replay; return by function the lines of what is not bit-identical."""
    done = subprocess.run([program, *options], capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 1), done.stdout[-3000:] + done.stderr[-3000:]
    names = {each.name: each.function for each in export.functions}
    lines: dict[str, list[str]] = {function: [] for function in names.values()}
    compared = set()
    for line in done.stdout.splitlines():
        if line.startswith("recorded with OpenCV "):
            continue
        sample, name, rest = line.split(", ", 2)
        compared.add(name)
        if name in names and not rest.endswith(": bit-identical"):
            lines[names[name]].append(f"{sample}, {rest}")
    assert compared >= names.keys(), f"not replayed: {names.keys() - compared}\n{done.stdout[-3000:]}"
    return lines


def each_alone(source: str, inputs: Mapping[str, Sequence[tuple[Any, ...]]]) -> tuple[str, dict[str, Any]]:
    """Return a module where a function that returns a tuple is one function for each of its items, and the inputs.

    So one item that has no translation hides none of the others.
    """
    body: list[ast.stmt] = []
    found: dict[str, Any] = {}
    for node in ast.parse(source).body:
        body.append(node)
        last = node.body[-1] if isinstance(node, ast.FunctionDef) else None
        returned = last.value if isinstance(last, ast.Return) else None
        is_one = sum(isinstance(each, ast.Return) for each in ast.walk(node)) == 1
        if (
            not isinstance(node, ast.FunctionDef)
            or node.name not in inputs
            or not (is_one and isinstance(returned, ast.Tuple))
        ):
            found |= {node.name: inputs[node.name]} if isinstance(node, ast.FunctionDef) and node.name in inputs else {}
            continue
        for place, item in enumerate(returned.elts):
            alone = ast.FunctionDef(f"{node.name}_{place}", node.args, [*node.body[:-1], ast.Return(item)], [])
            body.append(alone)
            found[alone.name] = inputs[node.name]
    return ast.unparse(ast.fix_missing_locations(ast.Module(body, []))), found
