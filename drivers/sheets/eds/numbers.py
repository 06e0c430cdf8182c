"""Spellings of numbers in data sheets.

CiA 306-1 knows decimals, 0x and a leading $NODEID. What else occurs is read as its writer must have meant it.
"""

import ast
import math
import re
from typing import NamedTuple


class Spelled(NamedTuple):
    """A number and any oddity of its spelling; empty if there is none."""

    value: int
    oddity: str = ""


class Formula(NamedTuple):
    """``factor * node-ID + base``."""

    factor: int
    base: int
    oddity: str = ""

    def at(self, node_id: int) -> int:
        """Return its value for a node-ID, as UNSIGNED32."""
        return (self.factor * node_id + self.base) & 0xFFFF_FFFF


LENGTH_MAX = 128
"""Characters of a number or formula: 64 bits in binary take half of them. Converting digits to an integer
takes quadratic time, and nested parentheses some calls each."""
_DECIMAL = re.compile(r"[+-]?\d+")
_HEX = re.compile(r"[+-]?0[xX][0-9A-Fa-f]+")
_ODD_HEX = (
    (re.compile(r"([0-9A-Fa-f]+)[hH]"), "a trailing h"),
    (re.compile(r"(?:&[hH]|[xX]|#|\\x)([0-9A-Fa-f]+)"), "another prefix than 0x"),
    (re.compile(r"16#([0-9A-Fa-f]+)#?"), "another prefix than 0x"),
    (re.compile(r"([0-9A-Fa-f]+)"), "hexadecimal without 0x"),
)
_SUFFIX = re.compile(r"((?:0[xX][0-9A-Fa-f]+|\d+))[uUlL]+")
_FLOAT = re.compile(r"[+-]?\d+[.,]\d*(?:[eE][+-]?\d+)?|[+-]?\d+[eE][+-]?\d+")
_BINARY = re.compile(r"0[bB][01]+")
_WORDS = {"true": 1, "false": 0, "yes": 1, "no": 0, "on": 1, "off": 0}
_NODE_ID = re.compile(
    r"\$\s*\(\s*NODE_?ID\s*\)|\$?\{\s*\$?NODE_?ID\s*\}|%NODE_?ID%|[$%]\s*NODE[_\s-]?ID|\bNODE_?ID\b",
    re.IGNORECASE,
)
_STANDARD_FORMULA = re.compile(
    r"\$NODEID(?:\+(?:0[xX][0-9A-Fa-f]+|\d+))?|(?:0[xX][0-9A-Fa-f]+|\d+)\+\$NODEID"
)
_TOKEN = re.compile(r"\s*(?:(N)|([0-9A-Fa-fxXhH]+)|([-+*|()]))")
_FUNCTION_CODE = 0x80
"""Bits 7 to 10 of an identifier of the predefined connection set (CiA 301, 7.3.5)."""


def integer(text: str) -> Spelled | None:
    """Parse a whole number in any of the known spellings; None if it is none."""
    bare = text.strip()
    if len(bare) > LENGTH_MAX:
        return None
    if _DECIMAL.fullmatch(bare):
        return _decimal(bare)
    if _HEX.fullmatch(bare):
        return Spelled(int(bare, 16))
    tidy = bare.strip("\"'").lstrip("=").replace(" ", "").replace("_", "")
    if tidy != bare and tidy:
        inner = integer(tidy)
        return None if inner is None else Spelled(inner.value, inner.oddity or "blanks or quotes in it")
    return _odd_integer(tidy)


def _decimal(text: str) -> Spelled:
    """A leading zero is octal in C; in data sheets it pads, as the digits 8 and 9 behind it show."""
    value = int(text)
    digits = text.lstrip("+-")
    if digits[0] == "0" and value and not (set(digits) & set("89")) and int(digits, 8) != abs(value):
        return Spelled(value, "it looks octal")
    if digits[0] == "0" and set(digits) & set("89"):
        return Spelled(value, "a leading zero")
    return Spelled(value)


def _odd_integer(text: str) -> Spelled | None:
    if text.lower() in _WORDS:
        return Spelled(_WORDS[text.lower()], "a word")
    suffixed = _SUFFIX.fullmatch(text)
    if suffixed:
        return Spelled(int(suffixed[1], 16 if suffixed[1][:2].lower() == "0x" else 10), "a suffix of C")
    if _BINARY.fullmatch(text):
        return Spelled(int(text, 2), "binary")
    if _FLOAT.fullmatch(text):
        number = float(text.replace(",", "."))
        return Spelled(int(number), "a decimal fraction") if number.is_integer() else None
    for pattern, oddity in _ODD_HEX:
        match = pattern.fullmatch(text)
        if match:
            return Spelled(int(match[1], 16), oddity)
    return None


def real(text: str) -> tuple[float, str] | None:
    """Parse a REAL, with any oddity of its spelling; ``0x...`` is left to the caller, who knows the width."""
    if len(text) > LENGTH_MAX:
        return None
    tidy = text.strip().strip("\"'").rstrip("fF").strip()
    oddity = "" if tidy == text.strip() else "quotes or a suffix"
    for spelled, odd in ((tidy, oddity), (tidy.replace(",", "."), "a decimal comma")):
        try:
            value = float(spelled)
        except ValueError:
            continue
        return (value, odd) if math.isfinite(value) else None
    return None


def is_formula(text: str) -> bool:
    """Return True if it depends on the node-ID."""
    return _NODE_ID.search(text) is not None


def formula(text: str) -> Formula | None:
    """Parse an expression of $NODEID and numbers with + - * | and parentheses; None if it is none.

    A number without 0x is hexadecimal if only so it is a multiple of 80h, as the base of a COB-ID is:
    ``$NODEID+180`` is 180h, ``$NODEID+384`` is 384.
    """
    compact = text.strip()
    if len(compact) > LENGTH_MAX:
        return None
    spelled = _as_python(_NODE_ID.sub(" N ", compact.strip("\"'")).strip())
    if spelled is None:
        return None
    expression, oddity = spelled
    try:
        factor, base = _linear(ast.parse(expression, mode="eval").body)
    except (SyntaxError, ValueError):
        return None
    if not oddity and not _STANDARD_FORMULA.fullmatch(compact):
        oddity = "not written as $NODEID+0x..."
    return Formula(factor, base, oddity)


def _as_python(text: str) -> tuple[str, str] | None:
    """Rewrite an expression in N as Python, every number in decimals, with the oddities of its spelling; None
    if it is none. A missing sign becomes a plus."""
    pieces: list[str] = []
    oddity, at = "", 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        number = integer(token[2]) if token is not None and token[2] else None
        if token is None or (token[2] and number is None):
            return None
        at = token.end()
        begins_operand = token[3] in (None, "(")
        if pieces and begins_operand and (pieces[-1] in ("N", ")") or pieces[-1].isdecimal()):
            pieces.append("+")
            oddity = oddity if token[3] else "a sign is missing"
        if number is not None:
            number = _with_function_code(token[2], number)
            oddity = oddity or number.oddity
        pieces.append(token[1] or token[3] if number is None else str(number.value))
    return "".join(pieces), oddity


def _with_function_code(text: str, number: Spelled) -> Spelled:
    """Digits alone are hexadecimal if only so they are the base of a COB-ID."""
    if text.isdecimal() and number.value % _FUNCTION_CODE and int(text, 16) % _FUNCTION_CODE == 0:
        return Spelled(int(text, 16), "hexadecimal without 0x")
    return number


def _linear(node: ast.expr) -> tuple[int, int]:
    """Return the factor of N and the addend. | binds less than + and -, as in C, and adds to the part with
    the node-ID.

    Raises ValueError for an expression not linear in N.
    """
    if isinstance(node, ast.Name):
        return 1, 0
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return 0, node.value
    if isinstance(node, ast.BinOp):
        (factor, base), (other, added) = _linear(node.left), _linear(node.right)
        if isinstance(node.op, ast.Mult) and not (factor and other):
            return factor * added + other * base, base * added
        if isinstance(node.op, ast.Sub):
            return factor - other, base - added
        if isinstance(node.op, ast.BitOr) and not factor and not other:
            return 0, base | added
        if isinstance(node.op, ast.Add | ast.BitOr):
            return factor + other, base + added
    raise ValueError("not linear in the node-ID")
