"""The frames of a recording into a log of another program, batch by batch.

candump's log and pcap, whose stamps are in ns, are written by columns; Vector's asc and blf by python-can.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.identifiers import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_ID_MAX, REMOTE_FLAG
from servobench.hil.reviewing.candump import candump_lines
from servobench.hil.reviewing.export_format import ExportFormat
from servobench.hil.rows.frames_file import read_batches, read_interfaces
from servobench.hil.rows.run_files import FRAMES_FILE, FRAMES_LOG

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
