"""The spellings of numbers in data sheets.

CiA 306-1 knows decimals, 0x and a leading $NODEID. What else occurs is read as its writer must have meant it.
"""

import math
import re
from typing import NamedTuple


class Spelled(NamedTuple):
    """A number and what is odd about the way it is written; empty if nothing is."""

    value: int
    oddity: str = ""


class Formula(NamedTuple):
    """``factor * node-ID + base``."""

    factor: int
    base: int
    oddity: str = ""

    def at(self, node_id: int) -> int:
        """Its value for a node-ID, as UNSIGNED32."""
        return (self.factor * node_id + self.base) & 0xFFFF_FFFF


LENGTH_MAX = 128
"""Characters of a number or formula: 64 bits in binary take half of them. Turning digits into an integer
takes the square of their number, and nested parentheses a call each."""
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


def integer(text: str) -> Spelled | None:
    """A whole number in any of the spellings that occur; None if it is none."""
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
    """A REAL and what is odd about it; ``0x...`` is left to the caller, who knows the width."""
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
    """It depends on the node-ID."""
    return _NODE_ID.search(text) is not None


def formula(text: str) -> Formula | None:
    """An expression of $NODEID and numbers with + - * | and parentheses; None if it is none.

    A number without 0x is hexadecimal if only so it is a multiple of 80h, as the base of a COB-ID is:
    ``$NODEID+180`` is 180h, ``$NODEID+384`` is 384.
    """
    compact = text.strip()
    if len(compact) > LENGTH_MAX:
        return None
    parser = _Parser(_NODE_ID.sub(" N ", compact.strip("\"'")))
    parsed = parser.expression()
    if parsed is None or not parser.at_end():
        return None
    factor, base = parsed
    oddity = parser.oddity
    if not oddity and not _STANDARD_FORMULA.fullmatch(compact):
        oddity = "not written as $NODEID+0x..."
    return Formula(factor, base, oddity)


class _Parser:
    """Recursive descent over linear expressions in N, each a pair (factor, base)."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self.oddity = ""

    def at_end(self) -> bool:
        return not self._text[self._at :].strip()

    def expression(self) -> tuple[int, int] | None:
        left = self._product()
        while left is not None:
            match = self._peek()
            if match is None or match[3] == ")":
                return left
            sign = match[3]
            if sign in ("+", "-", "|"):
                self._at = match.end()
            elif sign is None:
                self.oddity = "a sign is missing"
            right = self._product()
            if right is None:
                return None
            left = self._combined(left, right, sign)
        return None

    def _combined(self, left: tuple[int, int], right: tuple[int, int], sign: str | None) -> tuple[int, int]:
        if sign == "-":
            return left[0] - right[0], left[1] - right[1]
        if sign == "|" and not left[0] and not right[0]:
            return 0, left[1] | right[1]
        return left[0] + right[0], left[1] + right[1]

    def _product(self) -> tuple[int, int] | None:
        left = self._atom()
        while left is not None:
            match = self._peek()
            if match is None or match[3] != "*":
                return left
            self._at = match.end()
            right = self._atom()
            if right is None or (left[0] and right[0]):
                return None
            scale = right[1] if left[0] else left[1]
            left = (left[0] * scale, left[1] * scale) if left[0] else (right[0] * scale, right[1] * scale)
        return None

    def _atom(self) -> tuple[int, int] | None:
        match = self._peek()
        if match is None:
            return None
        self._at = match.end()
        if match[1]:
            return 1, 0
        if match[2]:
            return self._number(match[2])
        if match[3] != "(":
            return None
        inner = self.expression()
        closing = self._peek()
        if closing is None or closing[3] != ")":
            return None
        self._at = closing.end()
        return inner

    def _number(self, text: str) -> tuple[int, int] | None:
        spelled = integer(text)
        if spelled is None:
            return None
        value, oddity = spelled
        if text.isdigit() and value % _FUNCTION_CODE and int(text, 16) % _FUNCTION_CODE == 0:
            value, oddity = int(text, 16), "hexadecimal without 0x"
        self.oddity = self.oddity or oddity
        return 0, value

    def _peek(self) -> re.Match[str] | None:
        return _TOKEN.match(self._text, self._at)
