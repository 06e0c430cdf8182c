"""Which objects of a drive are read, what is said of them beside its data sheet, and how a DCF holds them."""

from typing import Any

import pytest
from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable

from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.errors import TransferAborted
from servobench.drivers.sheets.dictionary import variables_in
from servobench.hil.commissioning.files import dcf_text
from servobench.hil.commissioning.steps_static import differing, dump, missing
from servobench.hil.restoring.journal import ObjectKey


class Node:
    """A network with one node; what it does not have is aborted."""

    def __init__(self, held: dict[tuple[int, int], bytes]) -> None:
        self.held = held
        self.asked: list[tuple[int, int]] = []

    def upload(self, node: int, index: int, sub: int) -> bytes:
        assert node == 3
        self.asked.append((index, sub))
        if (index, sub) not in self.held:
            raise TransferAborted(f"{index:04X}h:{sub:02X}", "06020000h")
        return self.held[index, sub]


def variable(index: int, sub: int, access: str = "rw", kind: int = 0x06, default: Any = 0) -> ODVariable:
    made = ODVariable(f"object {index:04X}", index, sub)
    made.access_type, made.data_type, made.default = access, kind, default
    return made


def sheet(*members: ODVariable) -> ObjectDictionary:
    """0001h is a type, no object; members with a sub-index share a record."""
    made: Any = ObjectDictionary()  # type: ignore[no-untyped-call]
    for member in (variable(0x0001, 0), *members):
        if member.subindex == 0:
            made.add_object(member)
            continue
        if member.index not in made.indices:
            made.add_object(ODRecord("record", member.index))
        made[member.index].add_member(member)
    return made  # type: ignore[no-any-return]


def test_a_sheet_says_what_is_read() -> None:
    told = sheet(
        variable(0x6040, 0),
        variable(0x2000, 2),
        variable(0x2000, 1),
        variable(0x1010, 0, access="wo"),
        variable(0x1F50, 0, kind=0x0F),
        variable(0x1000, 0, access="const"),
    )
    node = Node({(0x1000, 0): b"\x92", (0x2000, 1): b"\1", (0x6040, 0): b"\0\0"})
    calls: list[int] = []
    read = dump(node, 3, told, lambda: calls.append(len(node.asked)))  # type: ignore[arg-type]
    assert node.asked == [(0x1000, 0), (0x2000, 1), (0x2000, 2), (0x6040, 0)]
    assert read == node.held
    assert calls == [1]
    assert [(each.index, each.subindex) for each in variables_in(told)] == [
        (0x1000, 0), (0x1010, 0), (0x1F50, 0), (0x2000, 1), (0x2000, 2), (0x6040, 0),
    ]  # fmt: skip
    assert missing(read, told) == ["2000h:02 object 2000"]


def test_without_a_sheet_the_usual_objects_are_asked_for() -> None:
    held = {(0x1018, 0): b"\4", (0x1018, 2): b"\7", (0x1A00, 0): b"\xff", (0x6041, 0): b"\0"}
    node = Node(held | {(0x1003, 0): b""})
    read = dump(node, 3, None, lambda: None)  # type: ignore[arg-type]
    assert read == node.held
    asked = set(node.asked)
    assert {(0x1018, sub) for sub in range(5)} <= asked
    assert (0x1018, 5) not in asked
    assert (0x1A00, 64) in asked
    assert (0x1A00, 65) not in asked, "a mapping has no more than 64 entries"
    assert (0x1003, 1) not in asked
    last = (0x1019, 0x1029, 0x1200, 0x1407, 0x1607, 0x1807, 0x1A07, 0x6403, 0x6404, 0x60FE)
    beyond = (0x0FFF, 0x101A, 0x1028, 0x102A, 0x1201, 0x1408, 0x1608, 0x1808, 0x1A08)
    assert {(index, 0) for index in last} <= asked
    assert not {(index, 0) for index in beyond} & asked
    whole = [index for index, sub in node.asked if sub == 0]
    assert list(dict.fromkeys(whole)) == sorted(set(whole))


def test_whoever_waits_is_asked_every_16_objects_also_of_a_drive_that_has_none() -> None:
    """An operator who stops the commissioning is heard there."""
    node, calls = Node({}), list[int]()
    dump(node, 3, None, lambda: calls.append(len(set(node.asked))))  # type: ignore[arg-type]
    assert calls == list(range(1, len(set(node.asked)) + 1, 16))


RECORDS = (
    0x1003, 0x1010, 0x1011, 0x1014, 0x1016, 0x1018, 0x1029, 0x1200, 0x1400, 0x1607, 0x1A07, 0x607D, 0x608F,
    0x6091, 0x6092, 0x6096, 0x6099, 0x60C2,
)  # fmt: skip


@pytest.mark.parametrize("record", RECORDS)
def test_of_a_record_each_entry_is_read(record: int) -> None:
    node = Node({(record, 0): b"\2", (record, 1): b"a", (record, 2): b"b"})
    assert dump(node, 3, None, lambda: None) == node.held  # type: ignore[arg-type]


def test_settings_that_differ_are_told_with_both_values() -> None:
    told = sheet(
        variable(0x6065, 0, default=100),
        variable(0x6066, 0, default=5),
        variable(0x6067, 0, default=-1),
        variable(0x6068, 0, default=-2),
        variable(0x6064, 0, access="ro", default=1),
        variable(0x1000, 0, access="const", default=1),
        variable(0x1008, 0, default="name"),
        variable(0x2001, 0, default=1),
        variable(0x2002, 0, default=1),
        variable(0x2003, 0, default=1),
        variable(0x2004, 0, default=1),
    )
    held = {
        (0x6065, 0): (300).to_bytes(2, "little"),
        (0x6066, 0): b"\5\0",
        (0x6067, 0): b"\xff\xff",
        (0x6068, 0): b"\xfd\xff",
        (0x6064, 0): b"\2",
        (0x1000, 0): b"\2",
        (0x1008, 0): b"x",
        (0x2001, 0): b"",
        (0x2002, 0): bytes(8),
        (0x2003, 0): bytes(9),
    }
    assert differing(held, told) == [
        "2002h:00 object 2002: 0, default 1",
        "6065h:00 object 6065: 300, default 100",
        "6068h:00 object 6068: -3, default -2",
    ]


def test_a_setting_of_three_bytes_keeps_its_sign_in_a_dcf() -> None:
    trim, integer24 = ObjectKey(0x2000, 0), 0x10
    held, before = (value.to_bytes(3, "little", signed=True) for value in (-2, 7))
    described = sheet(variable(trim.index, trim.sub, kind=integer24))
    text = dcf_text({trim: held}, {trim: before}, described, 1, 500_000, Identity("drive", 1, 2, 3, 4, 402))
    assert "DefaultValue=7\nParameterValue=-2\n" in text
