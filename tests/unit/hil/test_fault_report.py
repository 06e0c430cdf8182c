"""What is written beside a run that bus or drive ended."""

from pathlib import Path

from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.recording.fault_report import FAULT_FILE, last_frames, write_fault_report
from tests.recorded_frames import write_frames

FRAMES = "(1.000000) can0 080#\n(1.000135) can0 181#2706000000000000\n(1.002000) can0 081#1023028000000000\n"


def test_error_emergencies_and_frames(tmp_path: Path) -> None:
    write_frames(tmp_path, FRAMES)
    emergencies = [Emergency(1, 0x7392, 0x20, bytes(5), Instant(10 * NS_PER_MS))]
    write_fault_report(
        tmp_path, "axis1 is in fault", emergencies, {1: (0xFB, "EPOS4")}, Instant(30 * NS_PER_MS)
    )
    text = (tmp_path / FAULT_FILE).read_text()
    assert "  axis1 is in fault" in text
    assert "20.000  node 1: EMCY 7392h (main sensor counts the wrong way; sensor)" in text
    assert "2.000  080#                  SYNC" in text
    assert "1.865  181#2706000000000000  TPDO1 of node 1" in text
    assert "EMCY of node 1, 2310h continuous over-current" in text


def test_only_the_end_of_a_long_log_is_read(tmp_path: Path) -> None:
    write_frames(tmp_path, "".join(f"({n}.000000) can0 080#\n" for n in range(1000)))
    frames = last_frames(tmp_path, 10)
    assert len(frames) == 10
    assert frames[-1].split()[0] == "0.000"
    assert frames[0].split()[0] == "9000.000"


def test_without_frames_and_emergencies(tmp_path: Path) -> None:
    write_fault_report(tmp_path, "the bus is gone", [], {}, Instant(0))
    text = (tmp_path / FAULT_FILE).read_text()
    assert "  none" in text
    assert "The last 0 frames" in text


def test_a_folder_that_is_gone_is_borne(tmp_path: Path) -> None:
    write_fault_report(tmp_path / "gone", "x", [], {}, Instant(0))
    assert last_frames(tmp_path / "gone") == []
