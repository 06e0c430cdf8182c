"""Spellings of numbers and formulas."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.sheets.eds.numbers import formula, integer, is_formula
from tests.draws import examples_of


@given(st.integers(-(2**63), 2**64))
@examples_of(100)
def test_what_the_standard_knows_is_read_and_is_not_odd(number: int) -> None:
    assert integer(str(number)) == (number, "")
    assert integer(f"{number:#x}") == (number, "")
    if number >= 0:
        assert integer(f"0x{number:016X}") == (number, "")


@pytest.mark.parametrize(
    ("text", "value", "odd"),
    [
        ("0", 0, ""),
        ("007", 7, ""),
        ("010", 10, "it looks octal"),
        ("08", 8, "a leading zero"),
        ("FFh", 255, "a trailing h"),
        ("1F", 0x1F, "hexadecimal without 0x"),
        ("&HFF", 255, "another prefix than 0x"),
        ("0b101", 5, "binary"),
        ("1.0", 1, "a decimal fraction"),
        ("1e3", 1000, "a decimal fraction"),
        ("10UL", 10, "a suffix of C"),
        ("yes", 1, "a word"),
    ],
)
def test_other_spellings_are_read_and_said_to_be_odd(text: str, value: int, odd: str) -> None:
    assert integer(text) == (value, odd)


@pytest.mark.parametrize("text", ["", "-", "x", "1.5", "0x", "ten", "1-2", "n/a", "0xG"])
def test_what_is_no_number_is_none(text: str) -> None:
    assert integer(text) is None


@given(st.integers(0, 0xFFFF_FFFF), st.integers(1, 127))
@examples_of(100)
def test_a_formula_adds_the_node_id(base: int, node_id: int) -> None:
    for text in (f"$NODEID+0x{base:X}", f"0x{base:X}+$NODEID"):
        found = formula(text)
        assert found is not None
        assert (found.at(node_id), found.oddity) == ((base + node_id) & 0xFFFF_FFFF, "")


@pytest.mark.parametrize(
    ("text", "is_one"), [("$NODEID", True), ("0x180", False), ("node", False), ("%NODEID%", True)]
)
def test_what_depends_on_the_node(text: str, is_one: bool) -> None:
    assert is_formula(text) == is_one


@pytest.mark.parametrize("text", ["$NODEID+", "$NODEID*$NODEID", "($NODEID", "$NODEID+zz", "+"])
def test_broken_formulas_are_none(text: str) -> None:
    assert formula(text) is None
