"""A sheet that was made for one node, used for another."""

import pytest

from tests.unit.drivers.eds_maker import Pdo, sheet
from tests.unit.drivers.sound_sheet import repairs, value


def pdos(rpdo: str, tpdo: str, second: str) -> list[Pdo]:
    return [Pdo(0x1400, cob_id=rpdo), Pdo(0x1800, cob_id=tpdo), Pdo(0x1801, cob_id=second)]


@pytest.mark.parametrize(
    ("rpdo", "tpdo", "second"),
    [("0x220", "0x1A0", "0x2A0"), ("0x220", "0x400001A0", "0xC00002A0"), ("544", "416", "672")],
    ids=["plain", "with flags", "decimal"],
)
def test_cob_ids_of_one_node_follow_the_node_id(rpdo: str, tpdo: str, second: str) -> None:
    found = sheet(pdos(rpdo, tpdo, second))
    flags = [int(text, 0) & 0xE000_0000 for text in (tpdo, second)]
    assert value(found, 0x1400, 1) == 0x205
    assert [value(found, index, 1) for index in (0x1800, 0x1801)] == [0x185 | flags[0], 0x285 | flags[1]]
    assert "3 COB-IDs are those of node 32" in repairs(found)
    assert found.dictionary.get_variable(0x1800, 1).relative  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("rpdo", "tpdo", "second"),
    [
        ("0x220", "0x1A0", "0x2A1"),
        ("0x200", "0x180", "0x280"),
        ("0x220", "$NODEID+0x180", "0x2A0"),
        ("0x220", "0x1A0", "0x123"),
    ],
    ids=["of two nodes", "without a node", "too few", "an identifier of its own"],
)
def test_other_identifiers_stay_as_they_are(rpdo: str, tpdo: str, second: str) -> None:
    found = sheet(pdos(rpdo, tpdo, second))
    assert value(found, 0x1400, 1) == int(rpdo, 0)
    assert "COB-IDs" not in repairs(found)
