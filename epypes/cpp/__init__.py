"""The graph of a bundle as a C++ project that replays the bundle's samples.

`export_cpp` writes it: ``record`` runs the samples once (``recorded``), ``Project`` translates the functions
(``project``, ``statements``, ``expressions``, ``arrays``, ``opencv``), `write_project` renders the templates of Jinja2
(``writer``). The interface of a written project, all in the namespace that is named after the bundle:

- ``struct Hyperparameters``, ``Inputs``, ``Outputs``: one member per token, in the order of pipeline.toml. Each has
  ``static void each(self, visit)``, which calls ``visit(name, member)`` for every member: reading, writing and
  comparing are written once, for any type. ``Hyperparameters::check()`` throws std::invalid_argument.
- ``class Graph``: ``run(inputs) -> Outputs``, for one thread; ``set(hyperparameters)`` and ``hyperparameters()`` from
  any thread. ``Graph::functions`` has the names in run order, ``seconds()`` how long each took in the last run,
  ``total_seconds()`` the whole run: the difference is the overhead of the graph.
- ``values.hpp``: ``values::read``, ``write``, ``compare``, ``text`` and ``parse`` for every type of a token.
- One function per function of the graph, under its name; several results are a std::tuple.

``Recording.tokens`` has a `TokenType` by token: its name in C++, its C++ type (``cpp``) and its type (``type``, see
``types``). An image of a dtype that OpenCV has, with two dimensions or a third one of channels, is a cv::Mat; any other
array is a ``numpy::Array<T, N>`` of array.hpp; None or an array is a cv::Mat that may be empty. A template
in ``templates/`` has the name of the file that it becomes, and speaks of what ``writer._values`` returns.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epypes.cpp.project import CppFunction, Project
from epypes.cpp.recorded import record
from epypes.cpp.types import TokenType
from epypes.cpp.writer import write_project
from epypes.errors import BundleError

__all__ = ["CppExport", "CppFunction", "TokenType", "export_cpp"]


@dataclass(frozen=True, slots=True)
class CppExport:
    """A C++ project that was written.

    Attributes
    ----------
    path
        Its folder.
    functions
        The functions of the graph in run order: whether each is translated, or why it is to be written by hand.
    """

    path: Path
    functions: Sequence[CppFunction]

    def __str__(self) -> str:
        width = max([len("function"), *(len(each.function) for each in self.functions)])
        lines = [f"{'function':{width}}  translated  by hand, why"]
        for each in self.functions:
            translated = "" if each.is_by_hand else "yes"
            lines.append(f"{each.function:{width}}  {translated:10}  {each.reason_with_line}".rstrip())
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, as JSON has them."""
        functions = [
            {"function": each.function, "translated": not each.is_by_hand, "reason": each.reason, "line": each.line}
            for each in self.functions
        ]
        return {"path": str(self.path), "functions": functions}


def export_cpp(
    bundle_or_graph: Any,
    to: str | Path,
    *,
    outputs: Sequence[str] | None = None,
    samples: Sequence[Any] = (),
    service: bool = False,
) -> CppExport:
    """Write a graph as a C++ project (CMake, C++17, OpenCV) whose tests replay the recorded samples.

    Functions are translated where that is sure to compute the same; any other is declared, and stands in by_hand.cpp
    with its Python source, for you to write. The samples are run once in this process, by the bundle's own code.

    Parameters
    ----------
    bundle_or_graph
        The folder of a bundle, or a runner or pipeline that has run, which is promoted into a temporary folder first.
    to
        The folder to write. What an earlier export has written there is replaced, but for by_hand.cpp, which only
        gets the functions that it lacks.
    outputs, samples
        As for `promote`, of a runner or a pipeline.
    service
        Whether to add a program that serves the graph behind ZeroMQ, as ``epypes serve`` does (``service``).

    Returns
    -------
    CppExport
        The functions, each with whether it is translated.

    Raises
    ------
    BundleError
        The folder is no bundle, a token has values that C++ has no type for, ``to`` is something else, or NumPy is
        older than 2.
    PromotionRefused
        The graph can't be promoted.
    """
    if isinstance(bundle_or_graph, str | Path):
        return _export(Path(bundle_or_graph), Path(to), service)
    from epypes.bundle.promote import promote

    with tempfile.TemporaryDirectory() as folder:
        # The project is named after the bundle, which is named after its folder.
        bundle = promote(bundle_or_graph, Path(folder) / Path(to).resolve().name, outputs, samples=samples)
        return _export(bundle.path, Path(to), service)


def _export(bundle: Path, to: Path, is_served: bool) -> CppExport:
    try:
        project = Project(record(bundle))
        project.translate()
        write_project(project, to, is_served=is_served)
    except BundleError as error:
        # Its text says what to do: the frames below are of no use to the caller.
        raise error.with_traceback(None) from error.__cause__
    return CppExport(to, tuple(project.functions))
