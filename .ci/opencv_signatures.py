"""Write epypes/cpp/data/opencv.json: the functions of OpenCV as C++ declares them and as Python calls them.

    python .ci/opencv_signatures.py /usr/include/opencv4 epypes/cpp/data/opencv.json

Read are the headers of OpenCV and the type stubs of the installed cv2. A function is in the table if both have an
overload with the same names of parameters. Run it again for newer headers.
"""

import ast
import itertools
import json
import keyword
import re
import sys
from pathlib import Path

import cv2

HEADERS = [
    *("core.hpp", "core/base.hpp", "core/types.hpp", "core/mat.hpp", "core/utility.hpp", "core/hal/interface.h"),
    *("imgproc.hpp", "imgproc/segmentation.hpp", "features2d.hpp", "calib3d.hpp", "photo.hpp", "objdetect.hpp"),
    *("video/tracking.hpp", "video/background_segm.hpp"),
]
# What the depth and channel macros make, which are no enumerations.
TYPES = [
    f"CV_{depth}{channels}"
    for depth in ("8U", "8S", "16U", "16S", "32S", "32F", "64F")
    for channels in ("", "C1", "C2", "C3", "C4")
]
ARRAYS = {
    "OutputArray": "out",
    "OutputArrayOfArrays": "out",
    "InputOutputArray": "inout",
    "InputOutputArrayOfArrays": "inout",
}


def clean(text):
    """Return the text of a header without comments, macros and the parts that bindings leave out."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.S)
    text = re.sub(r"^[ \t]*#(?:[^\n]*\\\n)*[^\n]*", "", text, flags=re.M)
    return re.sub(r"CV_(?:NOEXCEPT|OVERRIDE|FINAL|NORETURN)|CV_DEPRECATED(?:_EXTERNAL)?", "", text)


def balanced(text, start, ends="()"):
    """Return the position after the bracket that closes the one at ``start``."""
    depth = 0
    for position in range(start, len(text)):
        depth += (text[position] == ends[0]) - (text[position] == ends[1])
        if depth == 0:
            return position + 1
    raise ValueError(text[start : start + 80])


def split(text):
    """Return the parts of a list between the commas that are in no bracket."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "(<{[") - (character in ")>}]")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]


def argument(text):
    """Return a parameter as the table has it."""
    text, _, default = (part.strip() for part in text.partition("="))
    words = re.findall(r"\bCV_(?:IN_)?OUT\b", text)
    direction = "inout" if "CV_IN_OUT" in words else "out" if words else "in"
    text = re.sub(r"\bCV_(?:IN_OUT|OUT|CARRAY|WRAP)\b|\bconst\b", " ", text).strip()
    name = re.search(r"(\w+)\s*(?:\[\])?$", text)[1]
    kind = " ".join(text[: text.rindex(name)].replace("&", "").split())
    kind = re.sub(r"\bcv::|\bstd::", "", kind).replace(" ", "")
    entry = {"name": f"{name}_" if keyword.iskeyword(name) else name, "type": kind}
    direction = ARRAYS.get(kind, direction)
    if direction != "in":
        entry["direction"] = direction
    return entry | ({"default": default} if default else {})


def declarations(text, scope):
    """Yield the functions that a text exports to Python."""
    for found in re.finditer(r"\bCV_(?:EXPORTS_W|EXPORTS_AS\s*\((\w+)\)|WRAP_AS\s*\((\w+)\)|WRAP)(?!\w)", text):
        start = text.find("(", found.end())
        head = text[found.end() : start]
        if start < 0 or ";" in head or "{" in head or "operator" in head:
            continue
        words = re.sub(r"\b(?:virtual|inline|CV_NORETURN)\b", "", head).split()
        is_static = "static" in words
        words = [word for word in words if word != "static"]
        if not words:
            continue
        name = words[-1].lstrip("&*")
        end = balanced(text, start)
        try:
            arguments = [argument(part) for part in split(text[start + 1 : end - 1]) if part != "void"]
        except (TypeError, ValueError):
            continue
        returns = (
            "".join(word for word in words[:-1] if word not in ("const",)).replace("cv::", "").replace("std::", "")
        )
        yield {
            "cpp": f"{scope}::{name}",
            "name": found[1] or found[2] or name,
            "returns": returns,
            "args": arguments,
            "static": is_static,
        }


def namespaces(text):
    """Return the text within namespace cv and nowhere deeper, and its classes by name."""
    classes, flat = {}, text
    while found := re.search(
        r"\bclass\s+CV_EXPORTS_W(?:_MAP|_SIMPLE)?\s+(\w+)[^{;]*?(?::\s*public\s+([\w:]+)[^{]*)?\{", flat
    ):
        end = balanced(flat, flat.index("{", found.start()), "{}")
        classes[found[1]] = (flat[found.end() : end - 1], found[2] or "")
        flat = flat[: found.start()] + flat[end:]
    return flat, classes


def enumerators(text):
    """Yield the names of the enumerators in a text."""
    for found in re.finditer(r"\benum\s+(?:(?:class|struct)\s+)?(\w+)?\s*\{([^}]*)\}", text):
        for part in split(found[2]):
            yield part.partition("=")[0].strip()


def stubs():
    """Return what the stubs of cv2 have: by name, lists of parameters; of methods after their class and a dot."""
    tree = ast.parse((Path(cv2.__file__).parent / "__init__.pyi").read_text())
    found = {}
    for prefix, node in itertools.chain(
        (("", node) for node in tree.body),
        ((f"{owner.name}.", node) for owner in tree.body if isinstance(owner, ast.ClassDef) for node in owner.body),
    ):
        if isinstance(node, ast.FunctionDef) and "UMat" not in ast.unparse(node.args):
            names = [arg.arg for arg in node.args.args if arg.arg not in ("self", "cls")]
            needed = len(node.args.args) - len(node.args.defaults) - (len(node.args.args) - len(names))
            entry = {"py": names, "needed": needed, "none": "None" in ast.unparse(node.returns or ast.Constant(0))}
            found.setdefault(f"{prefix}{node.name}", []).append(entry)
    return found


def joined(function, overloads):
    """Return a function with the order in which Python takes its parameters; None if no overload of Python fits."""
    outputs = {arg["name"] for arg in function["args"] if arg.get("direction") == "out" and "Array" not in arg["type"]}
    for overload in overloads:
        # Python takes arrays that are written to as well, where it is not C++ alone that has the parameter.
        own = {arg["name"] for arg in function["args"] if arg["name"] in overload["py"] or arg["name"] not in outputs}
        # A newer version has further parameters with defaults at the end.
        if own == set(overload["py"]) or (
            own < set(overload["py"]) and not {*overload["py"][: overload["needed"]]} - own
        ):
            order = [name for name in overload["py"] if name in own]
            return {**function, "py": order, "needed": overload["needed"]} | (
                {"none": True} if overload["none"] else {}
            )
    return None


def qualified(text, constants):
    """Return a default value as it is written outside of the namespace cv."""
    if text in constants:
        return constants[text]
    if "::" in text and text.replace("::", "_") in constants:
        return constants[text.replace("::", "_")]
    if "(" in text and not text.startswith("cv::"):
        head, _, rest = text.partition("(")
        parts = [qualified(part, constants) for part in split(rest.removesuffix(")"))]
        head = head.removeprefix("std::").replace("<flann::", "<cv::flann::")
        return f"{'std::' if head.startswith(('vector', 'string')) else 'cv::'}{head}({', '.join(parts)})"
    for operator in "+|":
        if operator in text:
            return f" {operator} ".join(qualified(part.strip(), constants) for part in text.split(operator))
    return f"cv::{text}" if re.match(r"[A-Z]\w*::", text) else text


def main(include, target):
    """Write the table of the headers in a folder."""
    python, functions, classes, constants = stubs(), {}, {}, {}
    for header in HEADERS:
        path = Path(include) / "opencv2" / header
        flat, own = namespaces(clean(path.read_text()))
        for function in declarations(flat, "cv"):
            add(functions, function, python.get(function["name"], []))
        for name in enumerators(flat):
            if hasattr(cv2, name):
                constants[name] = name if name.startswith("CV_") else f"cv::{name}"
        for owner, (body, base) in own.items():
            methods = {}
            for function in declarations(body, f"cv::{owner}"):
                name = "__init__" if function["name"] == owner else function["name"]
                add(methods, function | {"name": name}, python.get(f"{owner}.{name}", []))
            if methods or base:
                classes[owner] = {"base": base.split("::")[-1], "methods": methods}
            for name in enumerators(body):
                if hasattr(cv2, f"{owner}_{name}"):
                    constants[f"{owner}_{name}"] = f"cv::{owner}::{name}"
    constants |= {name: name for name in TYPES if hasattr(cv2, name)}
    overloads = [*functions.values(), *(each for owner in classes.values() for each in owner["methods"].values())]
    for arg in (arg for each in itertools.chain(*overloads) for arg in each["args"] if "default" in arg):
        arg["default"] = qualified(arg["default"], constants)
    table = {"constants": constants, "functions": functions, "classes": classes}
    lines = [
        f'"{part}": {{\n'
        + ",\n".join(f"{json.dumps(key)}: {json.dumps(table[part][key])}" for key in sorted(table[part]))
        + "\n}"
        for part in table
    ]
    Path(target).write_text("{\n" + ",\n".join(lines) + "\n}\n")


def add(table, function, overloads):
    """Add a function if Python has it."""
    entry = joined(function, overloads)
    if entry is not None:
        name = entry.pop("name")
        entry = {key: value for key, value in entry.items() if value is not False}
        table.setdefault(name, []).append(entry)


main(*sys.argv[1:])
