"""Files of a recording that grow at their end: what is whole of them, and what is kept if writing fails."""

import os
from errno import ENOSPC
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.recording.append_file import AppendFile, Tail, read_tail
from servobench.hil.recording.run_metadata import Reserve, read_summary, write_summary
from tests.unit.hil.test_summary import summary_with

DTYPE: Final = np.dtype([("at", "<i8"), ("value", "<u4")])


def some(*values: int) -> np.ndarray:
    return np.array([(value, 2 * value) for value in values], DTYPE)


@pytest.mark.parametrize(
    ("there", "kept"),
    [
        (b"", b""),
        (b"half", b""),
        (b"one\n", b"one\n"),
        (b"one\ntw", b"one\n"),
        (b"\n", b"\n"),
        # the last line feed is looked for in blocks of 65 536 bytes from the end
        (b"one\n" + b"x" * 65_535, b"one\n"),
        (b"one\n" + b"x" * 65_536, b"one\n"),
        (b"one\n" + b"x" * 200_000, b"one\n"),
        (b"x" * 200_000, b""),
    ],
)
def test_a_file_goes_on_behind_its_last_whole_line(tmp_path: Path, there: bytes, kept: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(there)
    file = AppendFile(path, fresh=False)
    assert path.read_bytes() == kept
    file.write(b"more")
    file.write(b"\n")
    file.close()
    assert path.read_bytes() == kept + b"more\n"
    AppendFile(path).close()
    assert path.read_bytes() == b"", "a fresh one begins anew"


def test_a_file_begins_anew_with_what_it_is_given(tmp_path: Path) -> None:
    path = tmp_path / "file"
    file = AppendFile(path)
    file.write(b"a long line\n")
    file.restart(b"ab")
    file.write(b"c")
    file.close()
    assert path.read_bytes() == b"abc"


def test_what_cannot_be_written_whole_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk takes three bytes of the second entry, and no more."""
    path = tmp_path / "file"
    file = AppendFile(path)
    file.write(b"one\n")
    write, room = os.pwrite, [3]

    def full(descriptor: int, data: bytes, at: int) -> int:
        if not room[0]:
            raise OSError(ENOSPC, "full")
        count = write(descriptor, data[: room[0]], at)
        room[0] -= count
        return count

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match="full"):
        file.write(b"second\n")
    assert path.read_bytes() == b"one\n"
    with pytest.raises(OSError, match="Bad file descriptor"):
        file.close()


# ---- rows that are not in their file yet --------------------------------------------------------------


def sequences(path: Path, stored: int) -> list[int]:
    return [int(row["at"]) for row in read_tail(path, DTYPE, stored)]


def test_a_tail_has_the_rows_behind_those_that_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "tail"
    assert sequences(path, 0) == []
    tail = Tail(path, DTYPE)
    assert sequences(path, 0) == []
    tail.append(some(1, 2))
    tail.append(some(3))
    assert sequences(path, 0) == [1, 2, 3]
    assert sequences(path, 2) == [3]
    assert sequences(path, 5) == []
    tail.restart(3, some(4, 5))
    assert (sequences(path, 3), sequences(path, 4), sequences(path, 2)) == ([4, 5], [5], [])
    tail.restart(5)
    assert sequences(path, 5) == []
    tail.remove()
    assert not path.exists()


@pytest.mark.parametrize(
    ("cut", "found"), [(0, [1, 2]), (1, [1]), (12, [1]), (13, []), (24, []), (25, []), (48, [])]
)
def test_a_tail_that_was_cut_off_has_its_whole_rows(tmp_path: Path, cut: int, found: list[int]) -> None:
    path = tmp_path / "tail"
    Tail(path, DTYPE).append(some(1, 2))
    data = path.read_bytes()
    assert len(data) == 24 + 2 * DTYPE.itemsize
    path.write_bytes(data[: len(data) - cut])
    assert sequences(path, 0) == found


def test_a_file_of_other_rows_is_none(tmp_path: Path) -> None:
    path = tmp_path / "tail"
    Tail(path, np.dtype([("at", "<i8")])).append(np.array([(1,)], [("at", "<i8")]))
    assert sequences(path, 0) == []
    Tail(path, DTYPE).append(some(1))
    path.write_bytes(b"another!" + path.read_bytes()[8:])
    assert sequences(path, 0) == []


# ---- room for the end ---------------------------------------------------------------------------------


def test_room_is_kept_and_given_back_in_two_steps(tmp_path: Path) -> None:
    path = tmp_path / ".reserve"
    reserve = Reserve(tmp_path)
    assert path.stat().st_size == 256 * 1024
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(BlockingIOError):
        Reserve(tmp_path)
    assert path.exists(), "who does not get it leaves it"
    reserve.release()
    assert path.stat().st_size == 32 * 1024
    reserve.close()
    assert not path.exists()
    Reserve(tmp_path).close()


def test_without_room_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: int) -> None:
        raise OSError(ENOSPC, "full")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="full"):
        Reserve(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_summary_is_there_as_a_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = summary_with()
    write_summary(tmp_path, first)
    assert read_summary(tmp_path) == first
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]

    def full(_self: Path, _text: str) -> int:
        raise OSError(ENOSPC, "full")

    with monkeypatch.context() as without_room:
        without_room.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="full"):
            write_summary(tmp_path, summary_with(cycles=1))
    assert read_summary(tmp_path) == first
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_what_is_no_summary_is_told(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    path.write_text('{"cycles": 1}')
    with pytest.raises(BadInput) as caught:
        read_summary(tmp_path)
    assert (caught.value.source, caught.value.key, caught.value.expected) == (
        str(path),
        "",
        "a whole summary",
    )
