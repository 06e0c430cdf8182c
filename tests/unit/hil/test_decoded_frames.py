"""Whole entries of a trace: every field, of each kind of frame, and what one frame says of those after it."""

import struct
from pathlib import Path

import pytest

from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.reviewing.trace.decoder import BusDecoder, decode
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.reviewing.trace.node_objects import KnownNodes, SheetFile
from servobench.hil.reviewing.trace.object_value import ObjectValue
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from tests.unit.drivers.eds_maker import NODE, Pdo, sheet_text
from tests.unit.hil.test_trace_decoder import FACTORS, READ_SPEED, frames, traced

READ_TORQUE, TORQUE = "601#4077600000000000", "581#4B776000F4010000"
READ_UNIT = "601#40A9600000000000"
NO_FACTORS = FACTORS[4:8]
"""65536 increments a turn, and nothing of the unit of speeds."""


def entry_of(text: str, **flags: bool) -> TraceEntry:
    """Of one frame, the third of its log, which the bench has sent."""
    can_id, _, data = text.partition("#")
    frame = LogFrame(3, 5_000, "can7", int(can_id, 16), bytes.fromhex(data), sent="T", **flags)
    (entry,) = BusDecoder(KnownNodes(), "can7").take(frame)
    return entry


def expected(
    text: str, kind: str, node: int | None, said: str, details: tuple[tuple[str, object], ...] = ()
) -> TraceEntry:
    can_id, _, data = text.partition("#")
    return TraceEntry(
        5_000, 5_000, 3, 3, 1, "can7", int(can_id, 16), "T", kind, node, said,
        data=bytes.fromhex(data), details=details,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "kind", "node", "said", "details"),
    [
        ("000#0105", "nmt", 5, "start, node 5", ()),
        ("000#0100", "nmt", None, "start, all nodes", ()),
        ("080#", "sync", None, "SYNC", ()),
        ("080#07", "sync", None, "SYNC 7", (("counter", 7),)),
        ("080#00", "sync", None, "SYNC 0", (("counter", 0),)),
        ("080#0708", "sync", None, "SYNC", ()),
        ("100#000000000000", "time", None, "1984-01-01 00:00:00.000", ()),
        (
            "085#0000000000000000", "emcy", 5,
            "EMCY 0000h (no error), register 00h (none), manufacturer 0000000000", (("error_code", 0),),
        ),
        ("085#30", "emcy", 5, "EMCY of 1 bytes; it has 8", (("error_code", None),)),
        (
            "085#3081", "emcy", 5, "EMCY of 2 bytes; it has 8: 8130h (life guard or heartbeat error)",
            (("error_code", 0x8130),),
        ),
        ("705#00", "heartbeat", 5, "boot-up", ()),
        ("77F#05", "heartbeat", 127, "operational", ()),
        ("705#85", "guarding", 5, "operational, toggle 1", ()),
        ("7E5#0401000000000000", "lss", None, "switch all to state configuration", ()),
        ("7E4#4400000000000000", "lss", None, "answer: selected", ()),
        ("185#3712", "pdo", 5, "TPDO1 37 12 (its mapping is not known)", (("pdo", "TPDO1"),)),
        ("57F#", "pdo", 127, "RPDO4  (its mapping is not known)", (("pdo", "RPDO4"),)),
        ("180#01", "other", None, "no identifier of CANopen", ()),
        ("101#01", "other", None, "no identifier of CANopen", ()),
        ("6FF#01", "other", None, "no identifier of CANopen", ()),
        ("605#0102", "sdo", 5, "request of 2 bytes; it has 8", ()),
        ("585#01020304050607", "sdo", 5, "answer of 7 bytes; it has 8", ()),
        (
            "605#6000000000000000", "sdo", 5,
            "request 60 00 00 00 00 00 00 00 of a transfer whose beginning is not in the log", (),
        ),
    ],
)  # fmt: skip
def test_a_frame_is_one_entry_of_its_service(
    text: str, kind: str, node: int | None, said: str, details: tuple[tuple[str, object], ...]
) -> None:
    assert entry_of(text) == expected(text, kind, node, said, details)


@pytest.mark.parametrize(
    ("text", "kind", "node", "said"),
    [
        ("000#", "other", None, "no identifier of CANopen"),
        ("080#", "other", None, "no identifier of CANopen"),
        ("085#", "other", None, "no identifier of CANopen"),
        ("605#", "other", None, "no identifier of CANopen"),
        ("585#", "other", None, "no identifier of CANopen"),
        ("185#", "pdo", 5, "TPDO1 asked for by a remote frame"),
        ("705#", "guarding", 5, "asked for its state"),
    ],
)
def test_a_remote_frame_asks_for_a_pdo_or_a_state(text: str, kind: str, node: int | None, said: str) -> None:
    assert entry_of(text, remote=True) == expected(text, kind, node, said)


@pytest.mark.parametrize(
    ("flags", "kind", "said"),
    [
        ({"extended": True}, "other", "29-bit identifier: no CANopen"),
        ({"fd": True}, "other", "CAN FD frame: no CANopen"),
        ({"extended": True, "fd": True}, "other", "CAN FD frame: no CANopen"),
        ({"error": True}, "error", "bus error"),
        ({"error": True, "extended": True}, "error", "bus error"),
    ],
)
def test_other_frames_have_no_node(flags: dict[str, bool], kind: str, said: str) -> None:
    assert entry_of("080#00", **flags) == expected("080#00", kind, None, said)


def test_a_node_that_was_asked_for_its_state_answers_once() -> None:
    entries = traced("705#R", "706#05", "705#05", "705#05")
    assert [(entry.kind, entry.text) for entry in entries] == [
        ("guarding", "asked for its state"),
        ("heartbeat", "operational"),
        ("guarding", "operational, toggle 0"),
        ("heartbeat", "operational"),
    ]


# ---- SDO ----------------------------------------------------------------------------------------------


def details(index: int, direction: str, length: int, **other: object) -> tuple[tuple[str, object], ...]:
    plain = {
        "index": index,
        "sub": 0,
        "direction": direction,
        "transfer": "expedited",
        "length": length,
        "finished": True,
        "abort_code": None,
        "notes": [],
    }
    return tuple((plain | other).items())


def test_a_transfer_is_one_entry_of_its_first_and_last_frame() -> None:
    asked, answered = frames((READ_TORQUE, TORQUE))
    other = LogFrame(9, 9_000, "can0", 0x080, b"", sent="T")
    first = asked._replace(sent="T")
    sync, entry = decode([first, other, answered._replace(number=12, at_ns=12_000, sent="R")])
    assert sync.kind == "sync"
    assert entry == TraceEntry(
        at_ns=12_000, began_ns=1_000, first=1, last=12, frames=2, channel="can0", can_id=0x581, sent="R",
        kind="sdo", node=1, text="read 6077h:00 Torque actual value = 500",
        values=(ObjectValue(0x6077, 0, "Torque actual value", 500),), data=b"\xf4\x01",
        details=details(0x6077, "upload", 2),
    )  # fmt: skip


def test_a_transfer_that_is_aborted_tells_the_value_that_was_to_be_written() -> None:
    (entry,) = traced("601#2B406000FFFF0000", "581#8040600011000906")
    assert entry.text == (
        "write 6040h:00 Controlword = FFFFh (fault reset): server aborts, "
        "abort code 06090011h (Subindex does not exist)"
    )
    assert entry.details == details(0x6040, "download", 2, finished=False, abort_code=0x0609_0011)
    (nothing,) = traced("601#4000200000000000", "581#8000200034120000")
    assert nothing.text == ("read 2000h:00: server aborts, abort code 00001234h (not in the standard)")
    assert (nothing.values, nothing.data) == ((), b"")


def test_what_is_odd_with_a_transfer_stands_behind_it() -> None:
    begin = ["601#2100200009000000", "581#6000200000000000"]
    (short,) = traced(*begin, "601#0B61620000000000", "581#2000000000000000")
    assert short.text == ("write 2000h:00 = 25185 [segmented, 2 bytes; 9 bytes were announced, 2 came]")
    assert short.details == details(
        0x2000, "download", 2, transfer="segmented", notes=["9 bytes were announced, 2 came"]
    )
    (cut,) = traced(*begin)
    assert cut.text == "write 2000h:00: not answered to its end [segmented, 0 bytes]"
    assert cut.details == details(0x2000, "download", 0, transfer="segmented", finished=False)
    (again,) = traced(begin[0], begin[0])
    assert again.text == "write 2000h:00: not answered to its end [segmented, 0 bytes; asked 2 times]"


def test_transfers_that_the_log_cuts_off_are_told_at_its_end_by_node() -> None:
    entries = traced("603#4041600000000000", "602#4041600000000000", "080#")
    assert [(entry.kind, entry.node, entry.last) for entry in entries] == [
        ("sync", None, 3), ("sdo", 2, 2), ("sdo", 3, 1),
    ]  # fmt: skip


def speed_after(*lines: str) -> float | None:
    """In rad/s, of 2000 raw ones, where the factors of positions are known."""
    return traced(*NO_FACTORS, *lines, READ_SPEED, "581#436C6000D0070000")[-1].values[0].si


def test_an_object_that_is_not_there_is_known_to_be_lacking() -> None:
    """Increments a second are told only once 60A9h is known not to be there."""
    increments_s = pytest.approx(2000 * 2 * 3.141592653589793 / 65536)
    assert speed_after() is None
    assert speed_after(READ_UNIT, "581#80A9600000000206") == increments_s
    assert speed_after(READ_UNIT, "581#80A9600011000906") == increments_s
    assert speed_after(READ_UNIT, "581#80A9600001000106") is None, "write only"
    assert speed_after("601#23A9600000000000", "581#80A9600000000206") is None, "a write says nothing"
    told = (READ_UNIT, "581#80A9600000000206", READ_UNIT, "581#43A960000047B400")
    assert speed_after(*told) == pytest.approx(2000 * 2 * 3.141592653589793 / 60)


def torque_after(*lines: str) -> float | None:
    return traced(*lines, READ_TORQUE, TORQUE)[-1].values[0].si


def test_only_a_value_that_is_whole_is_held_for_the_objects_to_come() -> None:
    write, confirm = "601#23766000D0070000", "581#6076600000000000"
    assert torque_after() is None
    assert torque_after(write, confirm) == pytest.approx(1.0)
    assert torque_after(write) is None, "not confirmed"
    assert torque_after(write, "581#8076600011000906") is None
    assert torque_after(confirm) is None, "nobody is seen to write"
    segmented = ["601#4076600000000000", "581#4176600004000000", "601#6000000000000000"]
    assert torque_after(*segmented, "581#07D0070000000000") == pytest.approx(1.0)
    assert torque_after(*segmented, "581#09D0070000000000") is None, "three bytes of four"
    nothing = ["601#2176600000000000", "581#6076600000000000", "601#0F00000000000000", "581#2000000000000000"]
    assert torque_after(write, confirm, *nothing) == pytest.approx(1.0)


def test_a_mapping_that_is_told_holds_from_then_on() -> None:
    pdo = "181#3712"
    told = ["601#40001A0000000000", "581#4F001A0001000000", "601#40001A0100000000", "581#43001A0110004160"]
    first, *_, last = traced(pdo, *told, pdo)
    assert first.text == "TPDO1 37 12 (its mapping is not known)"
    assert last == TraceEntry(
        6_000, 6_000, 6, 6, 1, "can0", 0x181, "", "pdo", 1,
        "TPDO1 6041h:00 Statusword = 1237h (operation enabled)",
        (ObjectValue(0x6041, 0, "Statusword", 0x1237, words="operation enabled", hexadecimal=True),),
        b"\x37\x12", (("pdo", "TPDO1"),),
    )  # fmt: skip
    moved = ["601#4000180100000000", "581#4300180192010000"]
    entries = traced(*told, *moved, "192#3712", pdo)
    assert [entry.text for entry in entries[-2:]] == [
        last.text,
        "TPDO1 37 12 (its mapping is not known)",
    ]


def test_a_pdo_that_lacks_one_bit_of_its_mapping_is_told() -> None:
    """33 bits: four octets are one too few, five are enough."""
    told = [
        "601#40001A0000000000", "581#4F001A0002000000", "601#40001A0100000000", "581#43001A0110004160",
        "601#40001A0200000000", "581#43001A0211000020",
    ]  # fmt: skip
    short, whole = traced(*told, "181#37120000", "181#3712000000")[-2:]
    state = "TPDO1 6041h:00 Statusword = 1237h (operation enabled)"
    assert (short.text, len(short.values)) == (f"{state} (it has 32 bits, 33 are mapped)", 1)
    assert (whole.text, len(whole.values)) == (f"{state}, 2000h:00 = 0", 2)


# ---- data sheets --------------------------------------------------------------------------------------


@pytest.fixture
def sheets(tmp_path: Path) -> list[Path]:
    """One has the statusword in TPDO1, the other the speed; their makers are 123h and 124h."""
    files = []
    for number, word in enumerate((0x6041_0010, 0x606C_0020)):
        text = sheet_text([Pdo(0x1800, (word,))]).replace(
            "VendorNumber=0x123", f"VendorNumber={0x123 + number}"
        )
        path = tmp_path / f"{number}.eds"
        path.write_text(text.replace("[DeviceInfo]", "[DeviceInfo]\nProductNumber=7"))
        files.append(path)
    return files


PDO1 = f"{0x180 + NODE:03X}#37120000"
STATE, SPEED = "TPDO1 6041h:00 Object 6041 = 1237h (operation enabled)", "TPDO1 606Ch:00 Object 606C = 4663"


def first_pdo(known: KnownNodes, channel: str = "can0") -> str:
    return next(iter(decode(frames([PDO1], channel), known))).text


def test_the_first_pdo_of_a_node_is_read_by_its_sheet(sheets: list[Path]) -> None:
    state, speed = sheets
    assert first_pdo(KnownNodes([SheetFile(state)])) == STATE, "the only one is that of every node"
    assert first_pdo(KnownNodes([SheetFile(state, NODE)])) == STATE
    assert first_pdo(KnownNodes([SheetFile(state, NODE), SheetFile(speed, NODE)])) == STATE, "the first"
    assert first_pdo(KnownNodes([SheetFile(state, NODE + 1), SheetFile(speed)])) == SPEED
    unknown = "TPDO1 37 12 00 00 (its mapping is not known)"
    assert first_pdo(KnownNodes([SheetFile(state, NODE + 1)])) == unknown
    assert first_pdo(KnownNodes([SheetFile(state), SheetFile(speed)])) == unknown, "whose is whose?"


def test_a_sheet_for_one_bus_comes_before_one_for_all(sheets: list[Path]) -> None:
    state, speed = sheets
    known = KnownNodes([SheetFile(state, NODE), SheetFile(speed, NODE, "can1")])
    assert [first_pdo(known, channel) for channel in ("can0", "can1", "")] == [STATE, SPEED, STATE]


def test_a_dcf_is_for_its_own_node(sheets: list[Path], tmp_path: Path) -> None:
    dcf = tmp_path / "own.dcf"
    for node, said in ((NODE, STATE), (NODE + 1, SPEED)):
        dcf.write_text(sheets[0].read_text() + f"[DeviceComissioning]\nNodeID={node}\n")
        assert first_pdo(KnownNodes([SheetFile(dcf), SheetFile(sheets[1])])) == said


def identity(vendor: int, product: int) -> list[str]:
    return [
        line
        for sub, number in ((1, vendor), (2, product))
        for line in (
            f"{0x600 + NODE:X}#401810{sub:02X}00000000",
            f"{0x580 + NODE:X}#431810{sub:02X}{struct.pack('<I', number).hex()}",
        )
    ]


@pytest.mark.parametrize(
    ("vendor", "product", "said"),
    [
        (0x123, 7, STATE),
        (0x124, 7, SPEED),
        (0x124, 8, "TPDO1 37 12 00 00 (its mapping is not known)"),
        (0x125, 7, "TPDO1 37 12 00 00 (its mapping is not known)"),
    ],
)
def test_of_several_sheets_a_node_gets_the_one_of_its_maker_and_product(
    sheets: list[Path], vendor: int, product: int, said: str
) -> None:
    known = KnownNodes([SheetFile(sheet) for sheet in sheets])
    entries = traced(PDO1, *identity(vendor, product), PDO1, known=known)
    assert entries[0].text == "TPDO1 37 12 00 00 (its mapping is not known)"
    assert entries[-1].text == said


def test_a_node_keeps_the_sheet_that_it_has(sheets: list[Path]) -> None:
    known = KnownNodes([SheetFile(sheets[0], NODE), SheetFile(sheets[1])])
    assert traced(*identity(0x124, 7), PDO1, known=known)[-1].text == STATE


def test_the_scale_of_one_bus_comes_before_that_of_all() -> None:
    every, own = ScaleOverride(rated_torque_nm=1.0), ScaleOverride(rated_torque_nm=3.0)
    known = KnownNodes(overrides={("", 1): every, ("can1", 1): own, ("can0", 2): own})
    rated = [
        list(decode(frames((READ_TORQUE, TORQUE), channel), known))[-1].values[0].si
        for channel in ("can0", "can1")
    ]
    assert rated == [0.5, 1.5]
    assert traced(READ_TORQUE, TORQUE, known=KnownNodes())[-1].values[0].si is None
