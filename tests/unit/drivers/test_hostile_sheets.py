"""Data sheets that nobody means well with: read or refused in time and text linear in their size.

Time is counted in calls of functions, Python's and C's, so that a busy machine changes nothing.
"""

import sys
from collections.abc import Callable

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.dictionary import LoadedDictionary, parse_dictionary
from tests.unit.drivers.sound_sheet import parse, repairs
from tests.unit.drivers.sound_sheet import value as value_of

HEAD = "[DeviceInfo]\n[1000]\nParameterName=x\nObjectType=7\nDataType=7\nAccessType=ro\n"
SMALL = 10_000
"""Octets. Growth is judged from here to four times as much."""

HOSTILE: dict[str, Callable[[int], str]] = {
    "odd options": lambda n: HEAD + "".join(f"Defaulx{i:05d}=1\n" for i in range(n // 15)),
    "no options": lambda n: HEAD + "a\n" * (n // 2),
    "foreign text": lambda n: HEAD + "Denotation=" + "\xe4\xf6" * (n // 2),
    "dollars": lambda n: HEAD + "DefaultValue=" + "$ " * (n // 2),
    "semicolons": lambda n: HEAD + "DefaultValue=" + ";x" * (n // 2),
    "sums": lambda n: HEAD + "DefaultValue=$NODEID" + "+1" * (n // 2),
    "brackets": lambda n: HEAD + "[1000" + " " * n + "x",
    "twice": lambda n: HEAD + "Denotation=" + "y" * (n // 2) + "\n" + "Denotation=z\n" * (n // 26),
    "own data types": lambda n: "".join(f"[{i:X}]\nDataType=0x99\n" for i in range(0x1000, 0x1000 + n // 20)),
    "long section": lambda n: HEAD + "[" + "q" * (n // 2) + "]\n" + "a\n" * (n // 4),
}


def calls_and_text(text: str) -> tuple[int, int]:
    """Calls that reading it took, and characters of what is told of it."""
    calls = 0

    def count(_frame: object, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        loaded: LoadedDictionary | None = parse(text.encode("latin-1"))
    except BadInput:
        loaded = None
    finally:
        sys.setprofile(before)
    return calls, 0 if loaded is None else len(repairs(loaded))


@pytest.mark.parametrize("kind", HOSTILE)
def test_work_and_words_grow_with_the_size(kind: str) -> None:
    (calls, told), (calls_4, told_4) = (calls_and_text(HOSTILE[kind](SMALL * times)) for times in (1, 4))
    assert calls_4 < 5 * calls
    assert told_4 < 5 * told + 1000


@pytest.mark.parametrize(
    "value",
    ["9" * 1_000_000, "0x" + "F" * 1_000_000, "-" + "0" * 1_000_000],
    ids=["decimal", "hexadecimal", "zeros"],
)
@pytest.mark.parametrize("data_type", ["7", "8"], ids=["UNSIGNED32", "REAL32"])
def test_a_number_of_a_million_digits_is_left_out(value: str, data_type: str) -> None:
    text = HEAD.replace("DataType=7", f"DataType={data_type}") + f"DefaultValue={value}"
    found = parse(text)
    assert value_of(found, 0x1000) is None
    assert f"left out, for no number has {len(value)} characters" in repairs(found)


@pytest.mark.parametrize("value", ["inf", "nan", "1e999"])
def test_a_real_is_finite(value: str) -> None:
    found = parse(HEAD.replace("DataType=7", "DataType=8") + f"DefaultValue={value}")
    assert value_of(found, 0x1000) is None


def test_more_entries_than_any_drive_has_are_refused() -> None:
    text = "".join(
        f"[{i:X}]\nParameterName=x\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=254\n"
        for i in range(0x2000, 0x2000 + 400)
    )
    with pytest.raises(BadInput, match="more than 100000 entries, the last of 2188h"):
        parse_dictionary(text.encode(), "many.eds", 1)


def test_more_faults_than_any_sheet_has_are_refused() -> None:
    with pytest.raises(BadInput, match=r"poem\.eds: found 'more than 20000 faults, the last in line 2000\d'"):
        parse_dictionary((HEAD + "a\n" * 20_001).encode(), "poem.eds", 1)


def test_names_do_nothing_to_a_terminal() -> None:
    found = parse(HEAD.replace("ParameterName=x", "ParameterName=\x1b[2Ja\u202eb\u009b1m"))
    assert found.dictionary[0x1000].name == "\\x1b[2Ja\\u202eb\\x9b1m"
