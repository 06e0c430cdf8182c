"""One session on a bus as 29 logs of other programs, with what each of them can hold."""

import gzip
from collections.abc import Callable, Sequence
from pathlib import Path
from struct import pack
from typing import Final, NamedTuple

import can
from can.io.trc import TRCFileVersion

from servobench.drivers.lean_can import mf4_reader
from servobench.hil.reviewing.trace.frame_columns import LogFrame

Frames = Sequence[LogFrame]
SLL_HEAD, SLL2_HEAD = pack(">HHH8sH", 4, 280, 0, b"", 0x0C), pack(">HHIHBB8s", 0x0C, 0, 3, 280, 4, 0, b"")
_OLE_DAYS: Final = 25_569
"""From the end of 1899, where PEAK's times begin, to 1970."""


class ForeignLog(NamedTuple):
    name: str
    """Its ending tells the kind."""
    write: Callable[[Path, Frames], None]
    lacks: str = ""
    """Letters of frames that the kind cannot hold: r remote, e error, f CAN FD."""
    step_us: int = 1
    """In which it tells times; 0: it tells none."""
    by_python_can: bool = True

    def holds(self, frame: LogFrame) -> bool:
        flags = (("r", frame.remote), ("e", frame.error), ("f", frame.fd))
        return not any(letter in self.lacks for letter, flag in flags if flag)


def message_of(frame: LogFrame) -> can.Message:
    return can.Message(
        timestamp=(frame.at_ns or 0) / 1e9,
        arbitration_id=frame.can_id,
        data=frame.data,
        dlc=len(frame.data),
        is_extended_id=frame.extended or frame.error,
        is_remote_frame=frame.remote,
        is_error_frame=frame.error,
        is_fd=frame.fd,
        channel=0,
        is_rx=frame.sent != "T",
    )


def by_python_can(**options: object) -> Callable[[Path, Frames], None]:
    def write(path: Path, frames: Frames) -> None:
        with can.Logger(path, **options) as log:
            for frame in frames:
                log.on_message_received(message_of(frame))

    return write


def _sqlite(path: Path, frames: Frames) -> None:
    with can.SqliteWriter(path) as log:
        log.MAX_BUFFER_SIZE_BEFORE_WRITES = len(frames)  # what is left at its end it loses otherwise
        for frame in frames:
            log.on_message_received(message_of(frame))


def _mf4(level: int) -> Callable[[Path, Frames], None]:
    def write(path: Path, frames: Frames) -> None:
        writer = mf4_reader().__init__.__globals__["MF4Writer"]
        with writer(path, compression_level=level) as log:
            for frame in frames:
                log.on_message_received(message_of(frame))

    return write


def _trc_by_python_can(version: TRCFileVersion) -> Callable[[Path, Frames], None]:
    def write(path: Path, frames: Frames) -> None:
        with can.TRCWriter(path) as log:
            log.file_version = version
            for frame in frames:
                log.on_message_received(message_of(frame))

    return write


def _times_us(frames: Frames) -> list[int]:
    """Since the first."""
    return [((frame.at_ns or 0) - (frames[0].at_ns or 0)) // 1000 for frame in frames]


def _asc(base: str, stamps: str, others: bool = False) -> Callable[[Path, Frames], None]:
    """By hand: python-can writes one dialect alone."""

    def digits(value: int, width: int) -> str:
        return f"{value:0{width}X}" if base == "hex" else str(value)

    def write(path: Path, frames: Frames) -> None:
        lines = ["date Tue Nov 14 10:13:20.000 pm 2023", f"base {base}  timestamps {stamps}"]
        lines += ["internal events logged", "// version 11.0.0", "Begin Triggerblock Tue Nov 14 2023"]
        told_us = 0

        def at(us: int) -> str:
            nonlocal told_us
            since, told_us = (us - told_us if stamps == "relative" else us), us
            return f"{since / 1e6:11.6f}"

        for number, (frame, us) in enumerate(zip(frames, _times_us(frames), strict=True)):
            if others and number % 3 == 0:
                between_us = (told_us + us) // 2
                lines.append(f"{at(between_us)} 1  Statistic: D 5 R 0 XD 0 XR 0 E 0 O 0 B 1.20%")
            name = digits(frame.can_id, 3) + ("x" if frame.extended else "")
            way = "Tx" if frame.sent == "T" else "Rx"
            data = " ".join(digits(byte, 2) for byte in frame.data)
            rest = "r" if frame.remote else f"d {len(frame.data)} {data}"
            lines.append(f"{at(us)} 1  {name:<15} {way}   {rest}  Length = 240 BitCount = 124")
        path.write_text("\r\n".join([*lines, "End TriggerBlock", ""]), newline="")

    return write


def _packed_asc(path: Path, frames: Frames) -> None:
    plain = path.with_suffix("")
    by_python_can()(plain, frames)
    path.write_bytes(gzip.compress(plain.read_bytes()))


def _trc(version: str) -> Callable[[Path, Frames], None]:
    """As PCAN-View writes it: bus states and errors among the frames."""

    def line(number: int, us: int, frame: LogFrame) -> str:
        name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:04X}"
        way = "Tx" if frame.sent == "T" else "Rx"
        data = " ".join(f"{byte:02X}" for byte in frame.data)
        if version == "2.0":
            kind = "RR" if frame.remote else "FD" if frame.fd else "DT"
            return f"{number:>7} {us / 1e3:13.3f} {kind} {name:>8} {way} {len(frame.data)} {data}"
        data = "RTR" if frame.remote else data
        if version == "1.3":
            return f"{number:>6}) {us / 1e3:13.3f} 1  {way}  {name:>8} -  {len(frame.data)}  {data}"
        return f"{number:>6}) {us / 1e3:13.3f}  {way}  {name:>8}  {len(frame.data)}  {data}"

    def state(number: int, us: int) -> str:
        if version == "2.0":
            return f"{number:>7} {us / 1e3:13.3f} ST          Rx    00 00 00 08"
        bus = " 1" if version == "1.3" else ""
        return f"{number:>6}) {us / 1e3:13.3f}{bus}  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY"

    def write(path: Path, frames: Frames) -> None:
        days = (frames[0].at_ns or 0) / 86_400e9 + _OLE_DAYS
        lines = [f";$FILEVERSION={version}", f";$STARTTIME={days:.11f}"]
        lines += [";$COLUMNS=N,O,T,I,d,l,D"] if version == "2.0" else []
        lines += [";", ";   Message Number) Time Offset (ms)", ";"]
        for number, (frame, us) in enumerate(zip(frames, _times_us(frames), strict=True), start=1):
            if number % 50 == 2:
                lines.append(state(number, us))
            lines.append(line(number, us, frame))
        path.write_text("\r\n".join([*lines, ""]), newline="")

    return write


def _gvret(directed: bool) -> Callable[[Path, Frames], None]:
    """As SavvyCAN's saveNativeCSVFile does, and as it did before it told directions."""

    def write(path: Path, frames: Frames) -> None:
        lines = [f"Time Stamp,ID,Extended,{'Dir,' if directed else ''}Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
        for frame in frames:
            way = ("Tx," if frame.sent == "T" else "Rx,") if directed else ""
            data = ",".join(f"{byte:02X}" for byte in frame.data.ljust(8, b"\0"))
            flag = "true" if frame.extended else "false"
            stamp = (frame.at_ns or 0) // 1000
            lines.append(f"{stamp},{frame.can_id:08X},{flag},{way}0,{len(frame.data)},{data},")
        path.write_text("\n".join([*lines, ""]))

    return write


def _identifiers_and_data(path: Path, frames: Frames) -> None:
    lines = [f"{frame.can_id:08X},{''.join(f'{byte:02X} ' for byte in frame.data)}" for frame in frames]
    path.write_text("\n".join(["ID,Data Bytes", *lines, ""]))


def _savvy_candump(path: Path, frames: Frames) -> None:
    lines = []
    for frame in frames:
        name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
        data = f"R{len(frame.data)}" if frame.remote else frame.data.hex().upper()
        lines.append(f"({(frame.at_ns or 0) / 1e9:017.6f}) vcan0 {name}#{data}\n")
    path.write_text("".join(lines))


def capture(
    kind: int, head: bytes, order: str, id_order: str, ns: bool = True
) -> Callable[[Path, Frames], None]:
    """As libpcap writes it; the payload by the link-type pages of tcpdump.org."""

    def write(path: Path, frames: Frames) -> None:
        text = pack(order + "IHHiIII", 0xA1B23C4D if ns else 0xA1B2C3D4, 2, 4, 0, 0, 65535, kind)
        for frame in frames:
            word = frame.can_id | frame.extended << 31 | frame.remote << 30 | frame.error << 29
            data = head + pack(id_order + "IBBH", word, len(frame.data), 4 * frame.fd, 0) + frame.data
            seconds, part_ns = divmod(frame.at_ns or 0, 10**9)
            part = part_ns if ns else part_ns // 1000
            text += pack(order + "IIII", seconds, part, len(data), len(data)) + data
        path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)

    return write


def _pcapng(path: Path, frames: Frames) -> None:
    head = pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    options = pack("<HH4sHHB3xHH", 2, 4, b"can7", 9, 1, 9, 0, 0)
    text = head + pack("<IIHHI", 1, 20 + len(options), 227, 0, 0) + options + pack("<I", 20 + len(options))
    for frame in frames:
        word = frame.can_id | frame.extended << 31 | frame.remote << 30 | frame.error << 29
        data = pack(">IBBH", word, len(frame.data), 4 * frame.fd, 0) + frame.data
        filled = data.ljust((len(data) + 3) // 4 * 4, b"\0")
        length, at_ns = 32 + len(filled), frame.at_ns or 0
        text += pack("<IIIIIII", 6, length, 0, at_ns >> 32, at_ns & 0xFFFF_FFFF, len(data), len(data))
        text += filled + pack("<I", length)
    path.write_bytes(text)


FOREIGN: Final = (
    ForeignLog("python-can.asc", by_python_can(), step_us=2),
    ForeignLog("packed.asc.gz", _packed_asc, step_us=2, by_python_can=False),
    ForeignLog("hex.asc", _asc("hex", "absolute"), "ef"),
    ForeignLog("dec.asc", _asc("dec", "absolute"), "ef"),
    ForeignLog("relative.asc", _asc("hex", "relative"), "ef"),
    ForeignLog("events.asc", _asc("dec", "relative", others=True), "ef"),
    ForeignLog("python-can.blf", by_python_can()),
    ForeignLog("plain.blf", by_python_can(compression_level=0)),
    ForeignLog("small.blf", by_python_can(max_container_size=4096, channel=3)),
    ForeignLog("python-can.trc", _trc_by_python_can(TRCFileVersion.V2_1), "ref", step_us=2),
    ForeignLog("python-can-1.0.trc", _trc_by_python_can(TRCFileVersion.V1_0), "ref", step_us=1000),
    ForeignLog("1.1.trc", _trc("1.1"), "ef", step_us=2),
    ForeignLog("1.3.trc", _trc("1.3"), "ef", step_us=2),
    ForeignLog("2.0.trc", _trc("2.0"), "e", step_us=2),
    ForeignLog("python-can.csv", by_python_can(), "f"),
    ForeignLog("savvycan.csv", _gvret(directed=True), "ref", by_python_can=False),
    ForeignLog("savvycan-undirected.csv", _gvret(directed=False), "ref", by_python_can=False),
    ForeignLog("savvycan-timeless.csv", _identifiers_and_data, "ref", step_us=0, by_python_can=False),
    ForeignLog("python-can.log", by_python_can()),
    ForeignLog("savvycan.log", _savvy_candump, "ef"),
    ForeignLog("python-can.db", _sqlite, "f"),
    ForeignLog("plain.mf4", _mf4(0), by_python_can=False),
    ForeignLog("transposed.mf4", _mf4(2), by_python_can=False),
    ForeignLog("socketcan.pcap", capture(227, b"", "<", ">"), by_python_can=False),
    ForeignLog("microseconds.pcap", capture(227, b"", ">", ">", ns=False), by_python_can=False),
    ForeignLog("packed.pcap.gz", capture(227, b"", "<", ">"), by_python_can=False),
    ForeignLog("cooked.pcap", capture(113, SLL_HEAD, "<", "<"), by_python_can=False),
    ForeignLog("cooked2.pcap", capture(276, SLL2_HEAD, ">", ">"), by_python_can=False),
    ForeignLog("socketcan.pcapng", _pcapng, by_python_can=False),
)
