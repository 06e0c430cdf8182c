"""The mutants of a source file: each is one defect of the kind that a slip of the hand makes.

Texts are left alone, and so is all that stands in a ``raise`` or an f-string: what a message says is not
what a limit does. A ``raise`` itself is taken away, as are calls, assignments and what is returned.
"""

import ast
from collections import Counter
from dataclasses import dataclass
from itertools import accumulate
from typing import Final

_COMPARISONS: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
"""Each to its other boundary and to its negation."""
_OPERATORS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.MatMult: ast.Add,
}
_TWINS: Final = {"min": "max", "max": "min", "any": "all", "all": "any"}
_NAME_MAX: Final = 100
"""Characters of the expression that names a mutant; longer ones are named by a part."""
_SMALL: Final = 20
"""A greater constant is doubled: one more of it is rarely a defect."""
_NAMING: Final = (ast.expr, ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Return, ast.Expr)
"""What may give a mutant its name."""
_Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, slots=True)
class Place:
    """Where a mutant is, and by which words it is found again when the lines have moved."""

    file: str
    function: str
    """Qualified name; empty at the top of a module."""
    was: str
    becomes: str
    turn: int = 1
    """The how manieth of its kind in the function, from 1."""

    def __str__(self) -> str:
        turn = f" ({self.turn})" if self.turn > 1 else ""
        return f"{self.file} {self.function or '(module)'}: {self.was} -> {self.becomes}{turn}"


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one file."""

    place: Place
    line: int
    function_line: int
    """First line of the function with its decorators, as its code object has it; 0 at the top of a module."""
    start: int
    """Of what is changed, in bytes of the file; to ``end``."""
    end: int
    changed: str

    def text(self, source: str) -> str:
        """The file's, mutated; a line stands where it stood, but for the rest of the changed statement."""
        data = source.encode()
        return (data[: self.start] + self.changed.encode() + data[self.end :]).decode()

    def __str__(self) -> str:
        return f"{self.place.file}:{self.line} {str(self.place).partition(' ')[2]}"


def mutants_of(file: str, source: str) -> list[Mutant]:
    """All of the file, in its order. Raises SyntaxError."""
    visitor = _Visitor(source)
    visitor.visit(ast.parse(source))
    turns: Counter[tuple[str, str, str]] = Counter()
    mutants = []
    for each in visitor.changes:
        key = (each.function, each.was, each.becomes)
        turns[key] += 1
        place = Place(file, *key, turns[key])
        mutants.append(Mutant(place, each.line, each.function_line, each.start, each.end, each.changed))
    return mutants


@dataclass(frozen=True, slots=True)
class _Change:
    function: str
    function_line: int
    was: str
    becomes: str
    line: int
    start: int
    end: int
    changed: str


class _Visitor(ast.NodeVisitor):
    """Walks a module, and notes the mutants of each node on its way."""

    def __init__(self, source: str) -> None:
        self.changes: list[_Change] = []
        self._source = source.encode()
        lengths = (len(line) for line in self._source.splitlines(keepends=True))
        self._starts = list(accumulate(lengths, initial=0))
        """Of each line, in bytes."""
        self._functions: list[str] = []
        self._first_lines = [0]
        self._around: list[ast.expr | ast.stmt] = []
        """What the expression at hand stands in, the outermost first: it gives a mutant its name."""

    # ---- what is left alone, and where we are ---------------------------------------------------------

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._functions.append(node.name)
        self._walk(node.body)
        self._functions.pop()

    def visit_FunctionDef(self, node: _Function) -> None:
        self._functions.append(node.name)
        self._first_lines.append(min(each.lineno for each in [*node.decorator_list, node]))
        for default in [*node.args.defaults, *node.args.kw_defaults]:
            if default is not None:
                self.visit(default)
        self._walk(node.body)
        self._first_lines.pop()
        self._functions.pop()

    visit_AsyncFunctionDef = visit_FunctionDef  # noqa: N815

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """A text."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """A note to the reader and to the type checker."""

    def visit_Import(self, node: ast.Import) -> None:
        """Nothing to mutate."""

    def generic_visit(self, node: ast.AST) -> None:
        if not isinstance(
            node, ast.expr | ast.Assign | ast.AnnAssign | ast.AugAssign | ast.Return | ast.Expr
        ):
            super().generic_visit(node)
            return
        self._around.append(node)
        super().generic_visit(node)
        self._around.pop()

    def _walk(self, nodes: list[ast.stmt]) -> None:
        for node in nodes:
            self.visit(node)

    # ---- statements -----------------------------------------------------------------------------------

    def visit_Raise(self, node: ast.Raise) -> None:
        self._remove(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call):
            self._remove(node)
        self.generic_visit(node)

    def visit_Break(self, node: ast.Break) -> None:
        self._remove(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self._remove(node)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is None:
            self._remove(node)
            return
        if not isinstance(node.value, ast.Constant):
            self._note(node, node, "return None")
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        made = self._functions[-1:] == ["__init__"]  # without it nothing would work at all
        if not made and all(isinstance(each, ast.Attribute) for each in node.targets):
            self._remove(node)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._around.append(node)
            self.visit(node.value)
            self._around.pop()

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._remove(node)
        other = _OPERATORS[type(node.op)]
        self._note(node, node, ast.unparse(ast.AugAssign(node.target, other(), node.value)))
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        self._negate(node.test)
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        self._negate(node.test)
        self.generic_visit(node)

    # ---- expressions ----------------------------------------------------------------------------------

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._around.append(node)
        self._negate(node.test)
        self._around.pop()
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for at, operator in enumerate(node.ops):
            for other in _COMPARISONS[type(operator)]:
                ops = [*node.ops[:at], other(), *node.ops[at + 1 :]]
                self._replace(node, ast.Compare(node.left, ops, node.comparators))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        self._replace(node, ast.BoolOp(other(), node.values))
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if not isinstance(node.left, ast.Constant | ast.JoinedStr) or not isinstance(
            getattr(node.left, "value", None), str
        ):
            self._replace(node, ast.BinOp(node.left, _OPERATORS[type(node.op)](), node.right))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self._replace(node, node.operand)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name in _TWINS:
            self._replace(node, ast.Call(ast.Name(_TWINS[name]), node.args, node.keywords))
        elif name == "abs":
            self._replace(node, node.args[0])
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._replace(node, ast.Constant(not value))
        elif isinstance(value, int):
            self._replace(node, ast.Constant(value + 1 if value < _SMALL else 2 * value))
        elif isinstance(value, float):
            self._replace(node, ast.Constant(2.0 * value if value else 1.0))

    def _negate(self, test: ast.expr) -> None:
        """What is no comparison, which has its own negation, nor a negation."""
        if not isinstance(test, ast.Compare | ast.UnaryOp | ast.Constant):
            self._replace(test, ast.UnaryOp(ast.Not(), test))

    # ---- notes ----------------------------------------------------------------------------------------

    def _remove(self, node: ast.stmt) -> None:
        self._note(node, node, "pass")

    def _replace(self, node: ast.expr, other: ast.expr) -> None:
        changed = ast.unparse(ast.fix_missing_locations(other))
        shown: ast.expr | ast.stmt = node
        for outer in reversed(self._around):
            start, end = self._span(outer)
            if end - start > _NAME_MAX:
                break
            shown = outer
        self._note(node, shown, f"({changed})")

    def _note(self, node: ast.expr | ast.stmt, shown: ast.expr | ast.stmt, changed: str) -> None:
        """``shown`` names the mutant: ``node`` itself, or what stands around it."""
        start, end = self._span(node)
        shown_start, shown_end = self._span(shown)
        was = self._words(shown_start, shown_end)
        head, tail = self._source[shown_start:start].decode(), self._source[end:shown_end].decode()
        self.changes.append(
            _Change(
                ".".join(self._functions),
                self._first_lines[-1],
                was if len(was) <= _NAME_MAX else f"{was[: _NAME_MAX - 4]} ...",
                " ".join(f"{head}{changed}{tail}".split()),
                node.lineno,
                start,
                end,
                changed,
            )
        )

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """Where it begins and ends, in bytes of the source, as the columns of :mod:`ast` count."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = self._starts[node.lineno - 1] + node.col_offset
        return start, self._starts[node.end_lineno - 1] + node.end_col_offset

    def _words(self, start: int, end: int) -> str:
        return " ".join(self._source[start:end].decode().split())
