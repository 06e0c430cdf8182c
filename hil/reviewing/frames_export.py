"""The frames of a recording into a log of another program, batch by batch.

candump's log and pcap, whose stamps are in ns, are written by columns; Vector's asc and blf by python-can.

Raw frames as a log that candump -L would write: can-utils, Wireshark, python-can and SavvyCAN read it.

    (1436509052.249713) can0 123#11223344

Which of them the bench sent has no place in that format: Wireshark refuses a line with more in it. The lines
are made by columns, ~0.2 us each.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_ID_MAX, REMOTE_FLAG
from servobench.hil.reviewing.export_format import ExportFormat
from servobench.hil.rows.frames_file import read_batches, read_interfaces
from servobench.hil.rows.run_files import FRAMES_FILE, FRAMES_LOG

_HEX = np.frombuffer(b"0123456789ABCDEF", np.uint8)
_IDENTIFIER_MASK = (1 << 30) - 1
"""The highest of these bits marks an error frame (CAN_ERR_FLAG)."""
_SECONDS_DIGITS = 10
"""Digits of Unix time in seconds, until the year 2286."""
_DIGIT_WEIGHTS = 10 ** np.arange(_SECONDS_DIGITS + 6 - 1, -1, -1, dtype=np.int64)


def candump_lines(rows: NDArray[np.void], interfaces: Sequence[str]) -> bytes:
    """The lines of ``rows``: (n,) of FRAME_DTYPE, their ``at`` ns since 1970, told to 1 us.

    ``interfaces``: names by segment.
    """
    if not rows.size:
        return b""
    count = rows.size
    extended = (rows["can_id"] & EXTENDED_FLAG) != 0
    remote = (rows["can_id"] & REMOTE_FLAG) != 0
    always = np.ones((count, 1), bool)
    parts: list[tuple[NDArray[np.uint8], NDArray[np.bool_]]] = []

    def text(letters: str, where: NDArray[np.bool_] = always) -> None:
        block = np.broadcast_to(np.frombuffer(letters.encode(), np.uint8), (count, len(letters)))
        parts.append((block, np.broadcast_to(where, block.shape)))

    stamp = _decimal_digits(rows["at"] // NS_PER_US)
    text("(")
    parts.append((stamp[:, :_SECONDS_DIGITS], np.broadcast_to(always, (count, _SECONDS_DIGITS))))
    text(".")
    parts.append((stamp[:, _SECONDS_DIGITS:], np.broadcast_to(always, (count, 6))))
    text(") ")
    for number, name in enumerate(interfaces):
        text(name, (rows["sent"] >> 1 == number)[:, None])
    text(" ")
    identifier = _hex_digits(rows["can_id"] & _IDENTIFIER_MASK)
    # a standard identifier has the last three digits, an extended one all eight
    parts.append(
        (identifier, np.concatenate((np.repeat(extended[:, None], 5, 1), np.repeat(always, 3, 1)), 1))
    )
    text("#")
    parts.append((np.full((count, 1), ord("R"), np.uint8), remote[:, None]))
    data = _HEX[np.stack((rows["data"] >> 4, rows["data"] & 15), 2)].reshape(count, 16)
    present = np.repeat(np.arange(8) < rows["length"][:, None], 2, 1) & ~remote[:, None]
    parts.append((data, present))
    text("\n")
    letters = np.concatenate([part for part, _ in parts], 1)
    lines: bytes = letters[np.concatenate([kept for _, kept in parts], 1)].tobytes()
    return lines


def _decimal_digits(values: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(n, 16) ASCII digits with leading zeros."""
    return (values[:, None] // _DIGIT_WEIGHTS % 10 + ord("0")).astype(np.uint8)


def _hex_digits(values: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(n, 8) ASCII digits with leading zeros."""
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    letters: NDArray[np.uint8] = _HEX[(values[:, None] >> shifts) & 15]
    return letters


Batches = Iterator[NDArray[np.void]]
_PCAP_HEAD: Final = np.array(
    (0xA1B2_3C4D, 2, 4, 0, 0, 1 << 16, 227),
    [
        ("magic", "<u4"),
        ("major", "<u2"),
        ("minor", "<u2"),
        ("zone", "<i4"),
        ("sigfigs", "<u4"),
        ("snaplen", "<u4"),
        ("link", "<u4"),
    ],
)
"""Stamps in ns, of SocketCAN (LINKTYPE_CAN_SOCKETCAN)."""
_PACKET: Final = np.dtype(
    [
        ("s", "<u4"), ("ns", "<u4"), ("captured", "<u4"), ("whole", "<u4"),
        ("can_id", ">u4"), ("length", "u1"), ("padding", "u1", (3,)), ("data", "u1", (8,)),
    ]
)  # fmt: skip
_CAN_BYTES: Final = 16


def export_frames(folder: Path, wanted: ExportFormat, path: Path) -> int:
    """Write the frames of ``folder`` to ``path``; return how many. Raises BadInput without frames."""
    source = folder / FRAMES_FILE
    if not source.is_file():
        older = f"; {folder / FRAMES_LOG} is candump's log" if (folder / FRAMES_LOG).is_file() else ""
        expected = f"a recording with {FRAMES_FILE} (recording.frames of its bench){older}"
        raise BadInput(str(folder), "", "no frames", expected)
    interfaces, count = read_interfaces(source), 0

    def batches() -> Batches:
        nonlocal count
        for batch in read_batches(source):
            count += batch.frames.size
            yield batch.frames

    _WRITERS[wanted](batches(), interfaces, path)
    return count


def _write_log(batches: Batches, interfaces: Sequence[str], path: Path) -> None:
    with path.open("wb") as file:
        for frames in batches:
            file.write(candump_lines(frames, interfaces))


def _write_pcap(batches: Batches, interfaces: Sequence[str], path: Path) -> None:  # noqa: ARG001
    with path.open("wb") as file:
        file.write(_PCAP_HEAD.tobytes())
        for frames in batches:
            _put_packets(frames, file)


def _put_packets(frames: NDArray[np.void], file: BinaryIO) -> None:
    packets = np.zeros(frames.size, _PACKET)
    packets["s"], packets["ns"] = np.divmod(frames["at"], NS_PER_S)
    packets["captured"] = packets["whole"] = _CAN_BYTES
    for name in ("can_id", "length", "data"):
        packets[name] = frames[name]
    file.write(packets.tobytes())


def _by_python_can(name: str) -> Callable[[Batches, Sequence[str], Path], None]:
    def write(batches: Batches, interfaces: Sequence[str], path: Path) -> None:  # noqa: ARG001
        import can

        writer: Any = getattr(can, name)
        with writer(str(path)) as sink:
            for frames in batches:
                columns = [frames[name].tolist() for name in ("at", "can_id", "length", "sent", "data")]
                for at_ns, flagged, length, sent, data in zip(*columns, strict=True):
                    remote = bool(flagged & REMOTE_FLAG)
                    sink.on_message_received(
                        can.Message(
                            timestamp=at_ns / NS_PER_S,
                            arbitration_id=flagged & EXTENDED_ID_MAX,
                            is_extended_id=bool(flagged & EXTENDED_FLAG),
                            is_remote_frame=remote,
                            is_error_frame=bool(flagged & ERROR_FLAG),
                            dlc=length,
                            data=None if remote else data[:length],
                            channel=sent >> 1,
                            is_rx=not sent & 1,
                        )
                    )

    return write


_WRITERS: Final[dict[ExportFormat, Callable[[Batches, Sequence[str], Path], None]]] = {
    ExportFormat.LOG: _write_log,
    ExportFormat.PCAP: _write_pcap,
    ExportFormat.ASC: _by_python_can("ASCWriter"),
    ExportFormat.BLF: _by_python_can("BLFWriter"),
}
OF_FRAMES: Final = frozenset(_WRITERS)
"""Formats that hold frames, not rows of cycles."""
