"""The house rules as functions: a source file's text in, its offences out."""

import ast
import re
from collections.abc import Iterator

FILE_LINES_MAX = 400
FUNCTION_LINES_MAX = 70

_BROAD = frozenset({"Exception", "BaseException"})
_LEFTOVER = re.compile(r"\b(?:TODO|FIXME|XXX|HACK)\b|\bxfail\b")
_UNNAMED_EXEMPTION = re.compile(r"#\s*type:\s*ignore(?!\[)|#\s*noqa(?!:)")
_MACHINE_PATH = re.compile(r"(?<![\w.~$}/-])/(?:work|farm|root|home|opt|Users)/\w")
_PACKAGE_INDEX = re.compile(r"https?://|--(?:extra-)?index-url|--find-links|--trusted-host", re.IGNORECASE)

_Function = ast.FunctionDef | ast.AsyncFunctionDef
_Documented = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
_MayBeDocumented = ast.Module | _Documented
_NO_SUBJECT = re.compile(r"\W*(?:Of|As|What|Whether)\b")


def too_long(source: str) -> Iterator[str]:
    """Files of 400 lines and more, functions of 70 and more."""
    lines = source.count("\n")
    if lines >= FILE_LINES_MAX:
        yield f"{lines} lines in the file"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, _Function) and node.end_lineno is not None:
            length = node.end_lineno - node.lineno + 1
            if length >= FUNCTION_LINES_MAX:
                yield f"line {node.lineno}: {length} lines in {node.name}"


def imports_of(source: str, forbidden: frozenset[str]) -> Iterator[str]:
    """Imports, anywhere in the file, of a module or package in ``forbidden``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
        else:
            continue
        for name in names:
            if name.removeprefix("servobench.").partition(".")[0] in forbidden:
                yield f"line {node.lineno}: imports {name}"


def broad_excepts(source: str) -> Iterator[str]:
    """Handlers of everything that do not raise it again."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ExceptHandler) and _is_broad(node.type) and not _reraises(node):
            yield f"line {node.lineno}: broad except"


def _is_broad(caught: ast.expr | None) -> bool:
    if caught is None:
        return True
    kinds = caught.elts if isinstance(caught, ast.Tuple) else [caught]
    return any(isinstance(kind, ast.Name) and kind.id in _BROAD for kind in kinds)


def _reraises(handler: ast.ExceptHandler) -> bool:
    return any(isinstance(node, ast.Raise) for node in handler.body)


def missing_docstrings(source: str) -> Iterator[str]:
    """A module, or a public class or function at its top, without a docstring."""
    module = ast.parse(source)
    if module.body and ast.get_docstring(module) is None:
        yield "no docstring of the module"
    for node in module.body:
        if (
            isinstance(node, _Documented)
            and not node.name.startswith("_")
            and ast.get_docstring(node) is None
        ):
            yield f"line {node.lineno}: no docstring of {node.name}"


def docstrings(source: str) -> Iterator[str]:
    """Docstrings of modules, classes, functions and, after an assignment, of attributes."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for before, item in zip([node, *body], body, strict=False):
            may = _MayBeDocumented if before is node else ast.Assign | ast.AnnAssign
            if isinstance(before, may) and isinstance(item, ast.Expr):
                text = item.value.value if isinstance(item.value, ast.Constant) else None
                if isinstance(text, str):
                    yield text


def begins_without_a_subject(docstring: str) -> bool:
    """A docstring that begins with Of, As, What or Whether: it names neither an action nor a thing."""
    return _NO_SUBJECT.match(docstring) is not None


def cleanup_in_del(source: str) -> Iterator[str]:
    """``__del__`` methods: cleanup belongs into ``with``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, _Function) and node.name == "__del__":
            yield f"line {node.lineno}: __del__"


def leftovers(text: str) -> Iterator[str]:
    """Notes of unfinished work, and tests marked as expected to fail."""
    return _matches(_LEFTOVER, text)


def unnamed_exemptions(text: str) -> Iterator[str]:
    """An exemption from a checker that does not name the rule."""
    return _matches(_UNNAMED_EXEMPTION, text)


def machine_paths(text: str) -> Iterator[str]:
    """Absolute paths of one machine."""
    return _matches(_MACHINE_PATH, text)


def package_indexes(text: str) -> Iterator[str]:
    """Where packages come from is the machine's business, not the project's."""
    return _matches(_PACKAGE_INDEX, text)


def _matches(pattern: re.Pattern[str], text: str) -> Iterator[str]:
    for number, line in enumerate(text.splitlines(), start=1):
        if found := pattern.search(line):
            yield f"line {number}: {found.group().strip()}"
