"""What a trace says where the bus is not as the book has it: transfers cut off, repeated, damaged."""

import json
from binascii import crc_hqx
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.cli import app
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.reviewing.trace.node_objects import KnownNodes, SheetFile
from servobench.hil.reviewing.trace.sdo_transfer import KEPT_MAX
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from tests.draws import examples_of

READ_SPEED, SPEED = "601#406C600000000000", "581#436C6000D0070000"
FACTORS = (
    "601#2376600000000000", "581#6076600000000000",
    "601#4076600000000000", "581#43766000D0070000", "601#408F600100000000", "581#438F600100000100",
    "601#408F600200000000", "581#438F600201000000", "601#40A9600000000000", "581#43A960000047B400",
)  # fmt: skip
"""2 N m, 65536 increments a turn, and 60A9h: revolutions a minute."""


def frames(texts: Iterable[str], channel: str = "can0") -> list[LogFrame]:
    made = []
    for number, text in enumerate(texts, 1):
        can_id, _, data = text.partition("#")
        payload = b"" if data == "R" else bytes.fromhex(data)
        made.append(LogFrame(number, number * 1000, channel, int(can_id, 16), payload, remote=data == "R"))
    return made


def traced(*texts: str, known: KnownNodes | None = None) -> list[TraceEntry]:
    return list(decode(frames(texts), known))


def texts(*lines: str) -> list[str]:
    return [entry.text for entry in traced(*lines)]


def test_a_request_that_is_repeated_is_one_transfer() -> None:
    (entry,) = traced(READ_SPEED, READ_SPEED, SPEED)
    assert entry.text == "read 606Ch:00 Velocity actual value = 2000 [asked 2 times]"
    assert (entry.frames, entry.first, entry.last) == (3, 1, 3)


def test_transfers_without_an_end_and_without_a_beginning() -> None:
    assert texts(READ_SPEED, "601#4041600000000000", SPEED, READ_SPEED) == [
        "read 606Ch:00 Velocity actual value: not answered to its end",
        "read 606Ch:00 Velocity actual value = 2000 [nobody is seen to ask]",
        "read 6041h:00 Statusword: not answered to its end",
        "read 606Ch:00 Velocity actual value: not answered to its end",
    ]
    assert texts("581#0011223344556677") == [
        "answer 00 11 22 33 44 55 66 77 of a transfer whose beginning is not in the log"
    ]


def test_who_aborts_is_told() -> None:
    begin = "601#2108200010000000"
    told = "client aborts, abort code 05040000h (Timeout of transfer communication detected)"
    assert told in texts(begin, "601#8008200000000405")[0]
    assert "server aborts" in texts(begin, "581#8008200000000405")[0]


def segmented(*segments: str) -> list[str]:
    return ["601#4008100000000000", "581#4108100009000000", *segments]


def test_a_segment_sent_again_counts_once_and_one_that_is_missing_is_told() -> None:
    first, again = (
        ["601#6000000000000000", "581#0061626364656667"],
        ["601#7000000000000000", "581#1B68690000000000"],
    )
    (whole,) = traced(*segmented(*first, *first, *again))
    assert (whole.data, dict(whole.details)["notes"]) == (b"abcdefghi", [])
    (gap,) = traced(*segmented(*again))
    assert dict(gap.details)["notes"] == ["segments are missing"]
    (short,) = traced(*segmented("601#6000000000000000", "581#0B68690000000000"))
    assert dict(short.details)["notes"] == ["9 bytes were announced, 2 came"]


def block(crc: int, acknowledged: tuple[int, ...] = (2,)) -> list[str]:
    """A download of 10 bytes; the first sub-block is acknowledged up to that, the rest is sent again."""
    data = b"abcdefghij".ljust(14, b"\0")
    pieces = [data[:7], data[7:]]
    lines = ["601#C60020000A000000", "581#A40020007F000000"]
    sent = 0
    for count in acknowledged:
        left = pieces[sent:]
        for number, piece in enumerate(left, 1):
            lines.append(f"601#{number | (0x80 if number == len(left) else 0):02X}{piece.hex()}")
        lines.append(f"581#A2{count:02X}7F0000000000")
        sent += count
    return [*lines, f"601#D1{crc.to_bytes(2, 'little').hex()}0000000000", "581#A100000000000000"]


def test_a_sub_block_that_is_sent_again_and_its_crc() -> None:
    crc = crc_hqx(b"abcdefghij", 0)
    for acknowledged in ((2,), (1, 1), (0, 2)):
        (entry,) = traced(*block(crc, acknowledged))
        assert (entry.data, dict(entry.details)["notes"]) == (b"abcdefghij", []), acknowledged
        assert (entry.frames, entry.last) == (len(block(crc, acknowledged)),) * 2
    (wrong,) = traced(*block(crc ^ 1))
    assert "its CRC is" in wrong.text
    lines = block(crc)
    del lines[2]
    (gap,) = traced(*lines)
    assert "segments are missing" in gap.text


def test_every_frame_of_a_block_from_the_server_counts() -> None:
    """An upload of 10 bytes, whose second segment comes again after the first acknowledgement."""
    lines = [
        "601#A00020007F000000", "581#C60020000A000000", "601#A300000000000000",
        "581#0161626364656667", "581#8268696A00000000", "601#A2017F0000000000",
        "581#8168696A00000000", "601#A2017F0000000000",
    ]  # fmt: skip
    crc = crc_hqx(b"abcdefghij", 0).to_bytes(2, "little").hex()
    lines += [f"581#D1{crc}0000000000", "601#A100000000000000"]
    (entry,) = traced(*lines)
    assert (entry.data, dict(entry.details)["notes"]) == (b"abcdefghij", [])
    assert (entry.frames, entry.first, entry.last) == (len(lines), 1, len(lines))


@pytest.mark.long
def test_a_transfer_without_end_does_not_fill_the_memory() -> None:
    def endless() -> Iterable[LogFrame]:
        yield LogFrame(1, 0, "", 0x601, bytes.fromhex("2000200000000000"))
        for number in range(KEPT_MAX // 7 + 1000):
            yield LogFrame(2 + number, 0, "", 0x601, bytes((number % 2 << 4,)) + b"firmwar")

    (entry,) = decode(endless())
    assert len(entry.data) == KEPT_MAX
    assert f"the first {KEPT_MAX} are kept" in entry.text


def test_si_values_only_where_the_drive_has_told_its_units() -> None:
    assert traced(READ_SPEED, SPEED)[0].values[0].si is None
    speed = traced(*FACTORS, READ_SPEED, SPEED)[-1].values[0]
    assert speed.si == pytest.approx(2000 * 2 * 3.141592653589793 / 60)
    torque = traced(*FACTORS, "601#4077600000000000", "581#4B776000F4010000")[-1].values[0]
    assert torque.unit == "N m"
    assert torque.si == pytest.approx(1.0)
    turned = KnownNodes(overrides={("can0", 1): ScaleOverride(velocity_sign=-1.0)})
    assert traced(*FACTORS, READ_SPEED, SPEED, known=turned)[-1].values[0].si == -(speed.si or 0)


def test_two_buses_have_their_own_nodes() -> None:
    other = [frame._replace(channel="can1") for frame in frames((READ_SPEED, SPEED))]
    entries = list(decode([*frames((*FACTORS, READ_SPEED, SPEED)), *other]))
    assert [entry.values[0].si is None for entry in entries[-2:]] == [False, True]


def test_a_pdo_shorter_than_its_mapping_is_told() -> None:
    mapping = ("601#2F001A0002000000", "581#60001A0000000000")
    words = [f"601#23001A{sub:02X}{word}" for sub, word in ((1, "10004160"), (2, "20006C60"))]
    lines = [line for word in words for line in (word, f"581#60001A{word[10:12]}00000000")]
    assert traced(*lines, *mapping, "181#37020000")[-1].text == (
        "TPDO1 6041h:00 Statusword = 237h (operation enabled) (it has 32 bits, 48 are mapped)"
    )


def test_frames_that_are_no_canopen_are_told_as_such() -> None:
    assert texts("17F#00", "705#R", "705#85", "000#01", "080#", "181#01", "085#0011", "085#001122") == [
        "no identifier of CANopen",
        "asked for its state",
        "operational, toggle 1",
        "NMT command of 1 bytes; it has 2",
        "SYNC",
        "TPDO1 01 (its mapping is not known)",
        "EMCY of 2 bytes; it has 8: 1100h (generic error)",
        "EMCY of 3 bytes; it has 8: 1100h (generic error)",
    ]


@examples_of(100)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x581, 0x601, 0x7E4, 0x7E5, 0x81, 0x181, 0x0, 0x100]), st.binary(max_size=8)
        )
    )
)
def test_no_frames_make_it_fail_and_each_is_in_one_entry(content: list[tuple[int, bytes]]) -> None:
    made = [LogFrame(number, None, "", can_id, data) for number, (can_id, data) in enumerate(content, 1)]
    entries = list(decode(made))
    assert sum(entry.frames for entry in entries) == len(made)
    json.dumps([entry.as_json(0) for entry in entries])


def hil_trace(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["trace", *arguments])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "bus.log"
    lines = (*FACTORS, READ_SPEED, SPEED, "000#0100", "702#05", "080#")
    path.write_text(
        "".join(f"(0000000100.{n:06d}) can0 {text}\n" for n, text in enumerate(lines)) + "rubbish\n"
    )
    return path


def test_the_command_selects_by_node_kind_and_time(log: Path) -> None:
    assert "606Ch:00 Velocity actual value = 209.44 rad/s (2000)" in hil_trace(str(log)).stdout
    assert [line.split()[3] for line in hil_trace(str(log), "--node", "2").stdout.splitlines()] == [
        "nmt",
        "heartbeat",
    ]
    assert len(hil_trace(str(log), "--kind", "sync,nmt").stdout.splitlines()) == 2
    last = hil_trace(str(log), "--from", "0.000013", "--json").stdout.splitlines()
    assert [json.loads(line)["kind"] for line in last] == ["heartbeat", "sync"]
    assert hil_trace(str(log), "--to", "0").stdout == ""
    first = json.loads(hil_trace(str(log), "--json").stdout.splitlines()[0])
    assert (first["began_s"], first["at_s"]) == (0.0, 1e-6)
    assert "1 line or packet is no CAN frame: line 16: 'rubbish'" in hil_trace(str(log)).stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--kind", "pdo,xyz"], "expected of nmt, sync"),
        (["--live"], "--bus SPEC, and no RUN or LOG"),
        (["--bus", "hub:a"], "a RUN or LOG, or --live"),
        (["--eds", "200=a.eds"], "a node-ID 1..127 before the ="),
        (["--eds", "none.eds"], "none.eds"),
        (["--eds", "²=a.eds"], "²=a.eds"),
    ],
)
def test_the_command_refuses_what_it_cannot_do(log: Path, arguments: list[str], said: str) -> None:
    result = hil_trace(str(log), *arguments)
    assert (result.exit_code, said in result.stderr) == (2, True), result.stderr


def test_of_several_data_sheets_a_node_gets_that_of_its_identity(tmp_path: Path) -> None:
    head = "[FileInfo]\n[DeviceInfo]\nVendorNumber=0x{0}\nProductNumber=1\n"
    head += "[MandatoryObjects]\nSupportedObjects=1\n1=0x1000\n"
    entry = "[1000]\nParameterName=Made by {0}\nObjectType=7\nDataType=7\nAccessType=ro\n"
    sheets = []
    for vendor in (11, 22):
        path = tmp_path / f"{vendor}.eds"
        path.write_text((head + entry).format(vendor))
        sheets.append(SheetFile(path))
    identity = (
        "601#4018100100000000",
        "581#4318100122000000",
        "601#4018100200000000",
        "581#4318100201000000",
    )
    entries = traced(*identity, "601#4000100000000000", "581#4300100001000000", known=KnownNodes(sheets))
    assert entries[-1].values[0].name == "Made by 22"


def test_the_log_of_another_program_needs_no_times(tmp_path: Path) -> None:
    path = tmp_path / "shown.log"
    path.write_text("  can0  705   [1]  05\n  can0  705   [1]  04\n")
    assert [entry.at_ns for entry in decode(BusLog(path))] == [None, None]
    assert hil_trace(str(path)).stdout.split()[0] == "#1"
