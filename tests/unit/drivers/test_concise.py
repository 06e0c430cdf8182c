"""Concise DCFs beside bytes that were put together by hand, after CiA 302-3."""

from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.concise import ConciseEntry, concise_bytes, is_concise, read_concise

BYTES = bytes.fromhex("03000000 0018 01 04000000 81010080 7260 00 02000000 9001 0820 05 00000000")
ENTRIES = [
    ConciseEntry((0x1800, 1), b"\x81\1\0\x80"),
    ConciseEntry((0x6072, 0), b"\x90\1"),
    ConciseEntry((0x2008, 5), b""),
]


def test_entries_are_written_and_read_as_the_standard_has_them(tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes(BYTES)
    assert concise_bytes(ENTRIES) == BYTES
    assert read_concise(path) == ENTRIES
    assert (is_concise(path), is_concise(Path("A.BIN")), is_concise(Path("bin"))) == (True, True, False)


@pytest.mark.parametrize("cut", [*range(len(BYTES)), len(BYTES) + 1])
def test_a_file_with_less_or_more_than_its_entries_is_refused(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes((BYTES + b"\0")[:cut])
    with pytest.raises(BadInput, match="expected a concise DCF"):
        read_concise(path)


def test_a_count_beyond_the_file_costs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes(b"\xff" * 4 + BYTES[4:])
    with pytest.raises(BadInput, match="entry 4"):
        read_concise(path)
    path.write_bytes(BYTES[:7] + b"\xff" * 4 + BYTES[11:])
    with pytest.raises(BadInput, match="entry 1"):
        read_concise(path)
