"""One line of a trace: how a value is read and shown, what a program gets, and which lines are wanted."""

import math
import struct

import pytest

from servobench.drivers.canopen.objects301 import DataType
from servobench.hil.reviewing.trace.object_value import ObjectValue, value_of
from servobench.hil.reviewing.trace.trace_entry import TraceEntry, TraceSelection

ZERO_NS = 5_000_000_000
HALF_NS = 500_000_000


@pytest.mark.parametrize(
    ("data", "kind", "value"),
    [
        # an integer is as long as what type and data both have
        ("FF", DataType.INTEGER8, -1),
        ("FF7F", DataType.INTEGER8, -1),
        ("FF7F", DataType.INTEGER16, 0x7FFF),
        ("FFFF", DataType.INTEGER32, -1),
        ("00000080", DataType.INTEGER32, -(1 << 31)),
        ("00000000000000FF", DataType.INTEGER64, -(1 << 56)),
        ("FFFF", DataType.UNSIGNED8, 0xFF),
        ("FFFF", DataType.UNSIGNED16, 0xFFFF),
        ("01", DataType.UNSIGNED32, 1),
        ("0100000001", DataType.UNSIGNED32, 1),
        ("01", DataType.BOOLEAN, 1),
        ("0000C03F", DataType.REAL32, 1.5),
        ("000000000000F83F", DataType.REAL64, 1.5),
        ("0000C0", DataType.REAL32, 0xC00000),
        # texts
        ("61620000", DataType.VISIBLE_STRING, "ab"),
        ("6100620000000000", DataType.UNICODE_STRING, "ab"),
        ("", DataType.VISIBLE_STRING, ""),
        ("", DataType.UNICODE_STRING, ""),
        ("6109620A0D", DataType.OCTET_STRING, "61 09 62 0a 0d"),
        ("61", DataType.DOMAIN, "61"),
        # without a type: a text only where it is longer than an integer
        ("6162636465666768", None, 0x6867666564636261),
        ("616263646566676869", None, "abcdefghi"),
        ("616263646566676800", None, "abcdefgh"),
        ("20202020202020207E", None, "~".rjust(9)),
        ("20202020202020207F", None, "20 20 20 20 20 20 20 20 7f"),
        ("1F2020202020202020", None, "1f 20 20 20 20 20 20 20 20"),
        ("0100", None, 1),
        ("", None, None),
        ("", DataType.UNSIGNED8, None),
    ],
)
def test_octets_are_read_by_their_type_or_by_their_look(
    data: str, kind: DataType | None, value: float | str | None
) -> None:
    assert value_of(bytes.fromhex(data), kind) == value


@pytest.mark.parametrize("size", [32, 33, 128, 129])
def test_a_long_value_is_cut_and_tells_its_length(size: int) -> None:
    octets = " ".join(["01"] * 32)
    assert value_of(b"\x01" * size, DataType.OCTET_STRING) == (
        octets if size == 32 else f"{octets} ... ({size} bytes)"
    )
    assert value_of(b"a" * size, None) == ("a" * size if size <= 128 else f"{'a' * 128} ... ({size} bytes)")


SPEED = ObjectValue(0x606C, 0, "Velocity actual value", 2000, 209.4395102, "rad/s")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (SPEED, "606Ch:00 Velocity actual value = 209.44 rad/s (2000)"),
        (ObjectValue(0x2000, 0x1F, "", 5), "2000h:1F = 5"),
        (ObjectValue(0x2000, 1, "", None), "2000h:01 = no data"),
        (ObjectValue(0x2000, 1, "", "abc"), "2000h:01 = abc"),
        (ObjectValue(0x2000, 1, "", 0.25, hexadecimal=True), "2000h:01 = 0.25"),
        (
            ObjectValue(0x6041, 0, "Statusword", 0x237, words="on", hexadecimal=True),
            "6041h:00 Statusword = 237h (on)",
        ),
        (ObjectValue(0x6041, 0, "", 0, hexadecimal=True), "6041h:00 = 0h"),
        (ObjectValue(0x6041, 0, "", -1, hexadecimal=True), "6041h:00 = -1"),
        (ObjectValue(0x6079, 0, "", 0, 0.0, "V", "none"), "6079h:00 = 0 V (0) (none)"),
    ],
)
def test_a_value_is_shown_in_si_before_what_was_sent(value: ObjectValue, text: str) -> None:
    assert str(value) == text
    assert value.shown == text.partition(" = ")[2]


def test_a_value_for_programs_has_only_what_there_is() -> None:
    assert SPEED.as_json() == {
        "index": 0x606C,
        "sub": 0,
        "name": "Velocity actual value",
        "raw": 2000,
        "si": 209.4395102,
        "unit": "rad/s",
    }
    plain = {"index": 1, "sub": 2, "name": "n"}
    assert ObjectValue(1, 2, "n", None).as_json() == plain | {"raw": None}
    assert ObjectValue(1, 2, "n", 7, words="w").as_json() == plain | {"raw": 7, "words": "w"}
    assert ObjectValue(1, 2, "n", 0.5).as_json() == plain | {"raw": 0.5}
    for number, text in ((math.inf, "inf"), (-math.inf, "-inf"), (math.nan, "nan")):
        raw = value_of(struct.pack("<f", number), DataType.REAL32)
        assert ObjectValue(1, 2, "n", raw).as_json() == plain | {"raw": text}


def entry(
    at_ns: int | None = ZERO_NS, kind: str = "sdo", node: int | None = 1, frames: int = 1
) -> TraceEntry:
    began = None if at_ns is None else at_ns - HALF_NS
    return TraceEntry(at_ns, began, 3, 9, frames, "can0", 0x581, "R", kind, node, "text", data=b"\x01\xab")


def test_an_entry_for_programs_counts_its_times_from_zero() -> None:
    plain = {
        "at_s": 0.5,
        "stamp_ns": ZERO_NS + HALF_NS,
        "kind": "sdo",
        "node": 1,
        "can_id": 0x581,
        "channel": "can0",
        "sent": "R",
        "frame": 9,
        "text": "text",
        "data": "01ab",
    }
    one = entry(ZERO_NS + HALF_NS)
    assert one.as_json(ZERO_NS) == plain
    several = {"began_s": 0.0, "first_frame": 3, "frames": 2}
    assert entry(ZERO_NS + HALF_NS, frames=2).as_json(ZERO_NS) == plain | several
    rich = one._replace(values=(SPEED,), details=(("asked", 2), ("text", "other")), sent="")
    told = plain | {"values": [SPEED.as_json()], "asked": 2, "text": "other", "sent": None}
    assert rich.as_json(ZERO_NS) == told
    timeless = plain | several | {"at_s": None, "stamp_ns": None, "began_s": None}
    assert entry(None, frames=2).as_json(ZERO_NS) == timeless


ENTRIES = [
    entry(None, "sdo", 1),
    entry(ZERO_NS, "nmt", None),
    entry(ZERO_NS + HALF_NS, "nmt", 1),
    entry(ZERO_NS + HALF_NS, "sync", None),
    entry(ZERO_NS + 2 * HALF_NS, "sdo", 2),
]


@pytest.mark.parametrize(
    ("selection", "wanted"),
    [
        (TraceSelection(), [0, 1, 2, 3, 4]),
        (TraceSelection(node=1), [0, 1, 2]),
        (TraceSelection(node=2), [1, 4]),
        (TraceSelection(node=3), [1]),
        (TraceSelection(kinds=frozenset(("sdo",))), [0, 4]),
        (TraceSelection(kinds=frozenset(("sdo", "sync"))), [0, 3, 4]),
        (TraceSelection(node=2, kinds=frozenset(("nmt",))), [1]),
        (TraceSelection(from_s=0.0), [1, 2, 3, 4]),
        (TraceSelection(from_s=0.5), [2, 3, 4]),
        (TraceSelection(from_s=0.5000001), [4]),
        (TraceSelection(to_s=0.5), [1, 2, 3]),
        (TraceSelection(to_s=0.4999999), [1]),
        (TraceSelection(to_s=-1.0), []),
        (TraceSelection(from_s=0.5, to_s=0.5), [2, 3]),
        (TraceSelection(node=1, from_s=0.5, to_s=9.0), [2]),
    ],
)
def test_lines_are_selected_by_node_kind_and_time(selection: TraceSelection, wanted: list[int]) -> None:
    """A command to all nodes is one to each; what has no time is in no span of it."""
    assert list(selection.of(ENTRIES, ZERO_NS)) == [ENTRIES[place] for place in wanted]
