"""One word for one thing: a public class name stands in one module, an option is declared once."""

import ast
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = ("design", "drivers", "virtual_bus", "hil")
OPTIONS = "hil/terminal/options.py"

OTHER_MEANING = {
    "--gamma": "of hil design speed: the gain to keep, rad/s per N m",
    "--motor": "a nameplate",
    "--node": "several nodes, or the node-ID for $NODEID of a data sheet",
    "--out": "a folder, or a measured network",
}
"""Options of servobench.hil.terminal.options whose name another command has for something else."""


def product() -> dict[str, str]:
    """Path -> text of every module of the product."""
    files = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in files}


def shared_classes(sources: Mapping[str, str]) -> set[str]:
    """Public classes that stand in two modules."""
    names = Counter(
        node.name
        for text in sources.values()
        for node in ast.parse(text).body
        if isinstance(node, ast.ClassDef)
    )
    return {name for name, count in names.items() if count > 1 and not name.startswith("_")}


def declared(source: str) -> Iterator[tuple[str, str]]:
    """Name and help text of each ``typer.Option``, ``flag`` and ``valued`` in a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("typer.Option", "flag", "valued"):
            if not isinstance(node.args[0], ast.Constant):  # options out of a table
                continue
            texts = [ast.unparse(word.value) for word in node.keywords if word.arg == "help"]
            texts += map(ast.unparse, node.args[-1:])
            yield ast.literal_eval(node.args[0]), texts[0]


def declared_twice(sources: Mapping[str, str], other_meaning: Iterable[str]) -> set[str]:
    """Options with the same name and text in two places, or of :data:`OPTIONS` and of another module too."""
    every = {path: list(declared(text)) for path, text in sources.items()}
    twice = {name for (name, _), count in Counter(chain(*every.values())).items() if count > 1}
    shared = {name for name, _ in every.get(OPTIONS, [])} - set(other_meaning)
    return twice | {
        name for path, options in every.items() if path != OPTIONS for name, _ in options if name in shared
    }


def test_a_class_name_means_one_thing() -> None:
    assert shared_classes(product()) == set()


def test_an_option_is_declared_once() -> None:
    assert declared_twice(product(), OTHER_MEANING) == set()


def test_a_name_that_stands_twice_is_found() -> None:
    assert shared_classes({"a.py": "class Axis: ...", "b.py": "class Axis: ..."}) == {"Axis"}
    assert shared_classes({"a.py": "class _Axis: ...", "b.py": "class _Axis: ...\nclass Axis: ..."}) == set()


def test_an_option_that_is_declared_twice_is_found() -> None:
    bus = 'x = typer.Option("--bus", help="Which.")\n'
    assert declared_twice({"a.py": bus, "b.py": bus}, ()) == {"--bus"}
    assert declared_twice({OPTIONS: bus, "b.py": bus.replace("Which", "Where")}, ()) == {"--bus"}
    assert declared_twice({OPTIONS: bus, "b.py": bus.replace("Which", "Where")}, ("--bus",)) == set()
