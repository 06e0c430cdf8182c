"""Which files of the tree a file reaches by its imports, and by those of what it imports.

A text that is the dotted name of a module counts as an import: it is imported late, or run by ``python -m``.
Who names the folder of scripts runs ``hil``.
"""

import ast
import hashlib
from functools import cache
from typing import Final

from tests.code_mutants.workshop import ROOT

ROOMS: Final = ("design", "drivers", "hil", "virtual_bus")


@cache
def reached(file: str) -> dict[str, int]:
    """Each file with how many imports away it is; the file itself with 0."""
    away = {file: 0}
    queue = [file]
    for at in queue:
        for linked in sorted(_links(at) - away.keys()):
            away[linked] = away[at] + 1
            queue.append(linked)
    return away


@cache
def digest(file: str) -> str:
    """Of all that the file reaches: what a test file says of the product holds until this changes."""
    whole = hashlib.sha256()
    for each in sorted(reached(file)):
        whole.update(each.encode() + b"\0" + (ROOT / each).read_bytes())
    return whole.hexdigest()


@cache
def _modules() -> dict[str, str]:
    paths = (path for top in (*ROOMS, "tests") for path in (ROOT / top).rglob("*.py"))
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}
    named = {name if name.startswith("tests") else f"servobench.{name}": path for name, path in files.items()}
    named["servobench"] = ROOT / "servobench" / "__init__.py"
    return {name.removesuffix(".__init__"): path.relative_to(ROOT).as_posix() for name, path in named.items()}


@cache
def _links(file: str) -> set[str]:
    modules = _modules()
    names = set()
    for node in ast.walk(ast.parse((ROOT / file).read_bytes())):
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{each.name}" for each in node.names}
            names |= {name if name in modules else str(node.module) for name in inner}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            command = {"servobench.hil.cli"} if node.value == "scripts" else set()
            names |= {node.value} if "." in node.value else command
    return {modules[name] for name in names & modules.keys()}
