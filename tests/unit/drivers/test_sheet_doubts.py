"""What in a data sheet contradicts itself."""

import pytest

from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.fitness import doubts
from tests.unit.drivers.eds_maker import U8, U32, Pdo, sheet, sub


def told(pdos: list[Pdo], also: str = "") -> str:
    loaded = sheet(pdos, also=also)
    return "\n".join(doubts(loaded.dictionary, capability_of(loaded)))


def record(index: int, count: int, access: str, *subs: int) -> str:
    head = f"[{index:04X}]\nParameterName=R\nObjectType=9\nSubNumber={len(subs) + 1}\n"
    return head + sub(index, 0, U8, access, str(count)) + "".join(sub(index, n, U32, "rw", "") for n in subs)


@pytest.mark.parametrize(
    ("word", "telling"),
    [
        (0x20010032, "2001h:00/50 is no object of its own with a length"),
        (0x60410020, "6041h:00/32 has 16 bits"),
        (0x00050008, "0005h:00/8 is no placeholder that it offers"),
    ],
)
def test_a_mapping_that_cannot_be(word: int, telling: str) -> None:
    assert f"the mapping of TPDO1 in the file cannot be: {telling}" in told([Pdo(0x1800, (word,))])


def test_a_mapping_too_long_for_a_pdo() -> None:
    longest = (0x60640020, 0x606C0020, 0x60410010)
    assert told([Pdo(0x1800, longest)]).endswith("has 80 bits, and a PDO holds 64")


def test_a_count_that_is_not_the_highest_sub_index() -> None:
    assert told([], record(0x2200, 2, "ro", 1)).endswith("2200h says 2 and has 1")
    assert told([], record(0x2200, 4, "const", 1, 5)).endswith("2200h says 4 and has 5")


def test_a_count_that_somebody_may_write_says_nothing() -> None:
    assert told([], record(0x2200, 0, "rw", 1)) == ""


def test_of_many_the_first_are_named() -> None:
    many = "".join(record(index, 9, "ro", 1) for index in range(0x2200, 0x2207))
    assert told([], many).endswith("2203h says 9 and has 1; and 3 more")
