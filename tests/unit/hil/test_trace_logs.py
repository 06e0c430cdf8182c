"""Logs of other programs as frames: each way in which candump writes, captures cut off, what is no frame."""

import gzip
from pathlib import Path
from struct import pack

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.hil.reviewing.trace.log_lines import frame_of_line

AT = 1_436_509_052_249_713_000
DATA = bytes.fromhex("11223344")


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("(1436509052.249713) can0 123#11223344", (AT, 0x123, DATA)),
        ("(1436509052.249713) can0 123#11.22.33.44", (AT, 0x123, DATA)),
        ("(1436509052.249713000) can0 123#11223344", (AT, 0x123, DATA)),
        ("  can0  123   [4]  11 22 33 44", (None, 0x123, DATA)),
        (" (1436509052.249713)  can0  123   [4]  11 22 33 44", (AT, 0x123, DATA)),
        (" (2015-07-10 06:17:32.249713)  can0  123   [4]  11 22 33 44", (AT, 0x123, DATA)),
        (" (000.000150)  can0  123   [4]  11 22 33 44", (150_000, 0x123, DATA)),
        (" (000.000150)  can0  123   [4]  11 22 33 44   '.\"3D'", (150_000, 0x123, DATA)),
        ("\x1b[33m (000.000150)\x1b[0m  can0  123   [0] ", (150_000, 0x123, b"")),
    ],
)
def test_a_line_of_candump(line: str, frame: tuple[int | None, int, bytes]) -> None:
    at_ns, can_id, data = frame
    assert frame_of_line(f"{line}\n".encode(), 7) == LogFrame(7, at_ns, "can0", can_id, data)


def test_flags_of_candump_lines() -> None:
    def read(line: str) -> LogFrame:
        frame = frame_of_line(line.encode(), 1)
        assert frame is not None
        return frame

    assert read("(1.0) can0 705#R").remote
    assert read("(1.0) can0 705#R1").remote
    assert read("  can0  705   [1]  remote request").remote
    assert read("(1.0) can0 00000705#00").extended
    assert read("(1.0) can0 123##1223344").fd
    assert read("(1.0) can0 123##1223344").data == bytes.fromhex("223344")
    error = read("  can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME")
    assert (error.error, error.extended, error.can_id, error.data[1]) == (True, False, 0x004, 0x08)
    assert read("(1.0) can0 123#00 T").sent == "T"
    assert read("  can0  RX - -  123   [1]  00").sent == "R"
    assert read("  can0  TX B E  123   [1]  00").sent == "T"


@pytest.mark.parametrize(
    "line",
    [
        "hello",
        "(1436509052.249713) can0 123#112",
        "(1436509052.249713) can0 923#11",
        "(1436509052.249713) can0 123#112233445566778899",
        "(1436509052.249713) can0 1234#11",
        "  can0  123   [4]  11 22 33",
        "  can0  123   [4]  11 22 33 zz",
        " (2015-13-40 06:17:32.249713)  can0  123   [0]",
        "(1436509052.249713) can0 123#R11",
    ],
)
def test_what_is_no_frame(line: str) -> None:
    assert frame_of_line(line.encode(), 1) is None


def test_malformed_lines_are_counted_and_the_first_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    good = b"(1436509052.249713) can0 123#11223344\n"
    path.write_bytes(good + b"\n\tcontroller-problem\n" + b"x" * 5000 + b"\n\xff\xfe\x1b[2J\n" + good)
    log = BusLog(path)
    assert [frame.number for frame in log] == [1, 6]
    assert (log.frames, log.malformed) == (2, 2)
    assert log.notes() == [f"2 lines or packets are no CAN frame, the first line 4: '{'x' * 60}'"]


def test_times_between_frames_are_summed_up_and_times_that_go_back_are_told(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("".join(f" (000.000{n})  can0  123   [0]\n" for n in (300, 200, 100)))
    assert [frame.at_ns for frame in BusLog(path, differences=True)] == [300_000, 500_000, 600_000]
    log = BusLog(path)
    assert [frame.at_ns for frame in log] == [300_000, 200_000, 100_000]
    assert "goes back 2 times" in log.notes()[0]


def test_gzip_is_unpacked_and_a_cut_one_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    lines = "".join(f"(1436509052.{n:06d}) can0 {n % 0x800:03X}#{n:08X}\n" for n in range(5000)).encode()
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress(lines))
    assert len(list(BusLog(path))) == 5000
    path.write_bytes(gzip.compress(lines)[:9000])
    log = BusLog(path)
    assert 100 < len(list(log)) < 5000
    assert "cannot be read to its end" in log.notes()[-1]


def captured(frames: int) -> bytes:
    text = pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 227)
    for number in range(frames):
        data = pack(">IBBH", 0x123, 1, 0, 0) + b"\x07"
        text += pack("<IIII", number, 5, len(data), len(data)) + data
    return text


@pytest.mark.parametrize("cut", [0, 1, 8, 16, 20, 24])
def test_a_capture_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.pcap"
    whole = captured(3)
    path.write_bytes(whole[: len(whole) - cut])
    log = BusLog(path)
    assert [frame.at_ns for frame in log] == [n * 10**9 + 5000 for n in range(3 if not cut else 2)]
    assert bool(log.damage) is bool(cut)


def test_a_packet_of_another_network_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(captured(2).replace(pack("<I", 227), pack("<I", 1)))
    log = BusLog(path)
    assert (list(log), log.malformed) == ([], 2)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.log"):
        with pytest.raises(BadInput, match="a log of candump"):
            list(BusLog(path))


def test_no_bytes_make_a_reader_fail(tmp_path: Path) -> None:
    """Every single octet of a capture and of a log struck in turn."""
    path = tmp_path / "a"
    line = b"(1436509052.249713) can0 123#11223344\n"
    for whole in (captured(2), line * 2, pcapng()):
        for place in range(len(whole)):
            for strike in (0xFF, whole[place] ^ 0x40):
                path.write_bytes(whole[:place] + bytes((strike,)) + whole[place + 1 :])
                log = BusLog(path)
                assert len(list(log)) + log.malformed <= len(whole)


def pcapng() -> bytes:
    """A section, an interface called can7 with stamps in ns, and a frame that was sent."""
    head = pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    options = pack("<HH4sHHB3xHH", 2, 4, b"can7", 9, 1, 9, 0, 0)
    interface = pack("<IIHHI", 1, 20 + len(options), 227, 0, 0) + options + pack("<I", 20 + len(options))
    data = pack(">IBBH", 0x123, 4, 0, 0) + DATA
    told = pack("<HHIHH", 2, 4, 2, 0, 0)
    length = 32 + len(data) + len(told)
    packet = pack("<IIIIIII", 6, length, 0, AT >> 32, AT & 0xFFFF_FFFF, len(data), len(data))
    return head + interface + packet + data + told + pack("<I", length)


def test_pcapng_tells_interface_stamp_and_direction(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(pcapng())
    assert list(BusLog(path)) == [LogFrame(1, AT, "can7", 0x123, DATA, sent="T")]
