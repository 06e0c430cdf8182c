"""A log of whatever program as a stream of frames: candump's, pcap, pcapng, and those that python-can reads.

It is read as it goes, so its length costs no memory. What is no frame is counted, and the first told.

pcap and pcapng as frames, with the link types in which CAN comes.

    227 CAN_SOCKETCAN        what tcpdump and Wireshark capture on can0
    113, 276 LINUX_SLL(2)    the same on the interface "any"
    252 WIRESHARK_UPPER_PDU  what Wireshark and tshark make of a log of another program

An own reader: no library that this project has knows the two formats, and both are headers of fixed length.
Sources: draft-ietf-opsawg-pcap, -pcapng; the link-type pages of tcpdump.org; linux/can.h.
"""

import gzip
import io
import os
import stat
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct
from typing import BinaryIO, Final, NamedTuple, cast

from servobench.drivers.errors import MISSING, BadInput, printable
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.frame_port import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    REMOTE_FLAG,
    STANDARD_ID_MAX,
)
from servobench.hil.reviewing.trace.frame_columns import (
    CLASSICAL_BYTES_MAX,
    FD_BYTES_MAX,
    Hold,
    LogFrame,
    LogWindow,
    held_against_nothing,
)
from servobench.hil.reviewing.trace.log_lines import (
    HEAD_MAX,
    SUFFIXES,
    BrokenLog,
    LineReader,
    frame_of_line,
    is_remark,
    kind_of,
    lines_of_window,
    other_frames,
    reader_of,
)

STDIN: Final = Path("-")
KINDS: Final = f"a log of candump or SavvyCAN, a pcap or pcapng, or one of {', '.join(SUFFIXES)}"
"""Readable formats, for an error."""
_GZIP_MAGIC: Final = b"\x1f\x8b"
_LINE_MAX: Final = 1024
"""A line of candump -x -a with 64 bytes has 330."""
_SHOWN_MAX: Final = 60
"""Characters shown of a line that is no frame: enough to recognize it, on one line of the terminal."""


class BusLog:
    """The frames of a log, and what in it was none."""

    def __init__(
        self,
        path: Path,
        differences: bool = False,
        *,
        window: LogWindow | None = None,
        hold: Hold = held_against_nothing,
    ) -> None:
        """``differences``: each stamp counts from the frame before (candump -t d).

        ``window``: of a log in order of time only the frames in there, and what they rest on, are read;
        ``hold``: told of its bytes before they are.
        """
        self._path = path
        self._window = window
        self._hold = hold
        self._differences = differences
        self.frames = 0
        """Read so far."""
        self.malformed = 0
        """Lines or packets that are no CAN frame."""
        self.first_malformed = ""
        """Where the first of them is, and how it begins."""
        self.damage = ""
        """Why the file could not be read to its end."""
        self.backwards = 0
        """Frames whose time lies before that of the frame before."""

    def __iter__(self) -> Iterator[LogFrame]:
        """Raises BadInput if the file cannot be opened."""
        total_ns, before_ns = 0, 0
        with _opened(self._path) as file:
            for frame in self._frames(file):
                at_ns = frame.at_ns
                self.frames += 1
                if at_ns is not None and self._differences:
                    total_ns += at_ns
                    yield frame._replace(at_ns=total_ns)
                    continue
                if at_ns is not None:
                    self.backwards += at_ns < before_ns
                    before_ns = at_ns
                yield frame

    def notes(self) -> list[str]:
        """Return remarks on the log for the reader of the frames."""
        told = []
        if self.malformed:
            one = self.malformed == 1
            first = "" if one else ", the first "
            told.append(
                f"{self.malformed} {'line or packet is' if one else 'lines or packets are'} no CAN frame"
                f"{first or ': '}{self.first_malformed}"
            )
        if self.damage:
            told.append(f"it cannot be read to its end: {self.damage}")
        if self.backwards:
            told.append(
                f"the time goes back {self.backwards} times; a log of candump -t d is read with --differences"
            )
        return told

    def _frames(self, file: io.BufferedReader) -> Iterator[LogFrame]:
        try:
            start = file.peek(4)[:4]
            if start in PCAP_MAGICS or start == PCAPNG_MAGIC:
                yield from self._captured(file)
                return
            reader = reader_of(file.peek(HEAD_MAX)[:HEAD_MAX])
            if reader is not None:
                file.readline()
                yield from self._listed(reader, _lines(file, 1))
            elif kind_of(self._path):
                yield from other_frames(self._path)
            else:
                yield from self._listed(frame_of_line, self._lines(file))
        except (BrokenCapture, BrokenLog) as error:
            self.damage = str(error)
        except (EOFError, OSError, zlib.error) as error:
            self.damage = str(error) or type(error).__name__

    def _lines(self, file: io.BufferedReader) -> Iterator[tuple[int, bytes]]:
        if self._window is None:
            return _lines(file)
        return lines_of_window(self._path, self._window, self._hold)

    def _captured(self, file: io.BufferedReader) -> Iterator[LogFrame]:
        for packet in capture_packets(cast(BinaryIO, file)):
            if isinstance(packet, OtherPacket):
                self._count(f"packet {packet.number}", b"")
            else:
                yield packet

    def _listed(self, reader: LineReader, lines: Iterator[tuple[int, bytes]]) -> Iterator[LogFrame]:
        for number, line in lines:
            frame = reader(line, number) if len(line) < _LINE_MAX or line.endswith(b"\n") else None
            if frame is not None:
                yield frame
            elif not is_remark(line):
                self._count(f"line {number}", line)

    def _count(self, place: str, line: bytes) -> None:
        self.malformed += 1
        if self.malformed == 1:
            text = printable(line[:_SHOWN_MAX].decode("utf-8", "replace").rstrip())
            self.first_malformed = f"{place}: {text!r}" if text else place


def _lines(file: io.BufferedReader, number: int = 0) -> Iterator[tuple[int, bytes]]:
    """Each with its number, which follows ``number``; of a longer one than any of candump its beginning."""
    while line := file.readline(_LINE_MAX):
        number += 1
        yield number, line
        while not line.endswith(b"\n") and len(line) == _LINE_MAX:
            line = file.readline(_LINE_MAX)


@contextmanager
def _opened(path: Path) -> Iterator[io.BufferedReader]:
    """The log, unpacked if it is packed."""
    if path == STDIN:
        yield cast(io.BufferedReader, sys.stdin.buffer)
        return
    try:
        if stat.S_ISDIR(os.stat(path).st_mode):
            raise BadInput(str(path), "", "a folder", f"a recording, or {KINDS}")
        file = path.open("rb")
    except OSError as error:
        found = MISSING if isinstance(error, FileNotFoundError) else error.strerror
        raise BadInput(str(path), "", found, KINDS) from None
    with file:
        if file.peek(2)[:2] == _GZIP_MAGIC:
            with gzip.open(file) as unpacked:
                yield io.BufferedReader(cast(io.RawIOBase, unpacked))
        else:
            yield file


PCAP_MAGICS: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""First bytes -> byte order, ns of the stamp's smaller unit."""
PCAPNG_MAGIC: Final = b"\x0a\x0d\x0d\x0a"
_RECORD_MAX: Final = 1 << 20
"""A CAN frame has less than a hundred bytes; longer is what capture programs write at most of a network."""
_SOCKETCAN, _COOKED, _COOKED_2, _UPPER_PDU = 227, 113, 276, 252
_COOKED_PROTOCOLS: Final = (0x000C, 0x000D)
"""LINUX_SLL_P_CAN, LINUX_SLL_P_CANFD."""
_OUTGOING: Final = 4
_FD_FRAME: Final = 0x04
"""CANFD_FDF in the flags behind the length."""
_HEADER: Final = 8


class BrokenCapture(Exception):
    """The file is damaged from here on."""


class _Link(NamedTuple):
    """An interface of the file."""

    kind: int
    name: str
    units_per_s: int = 1_000_000
    offset_s: int = 0


class OtherPacket(NamedTuple):
    """A packet that holds no CAN frame."""

    number: int


def capture_packets(file: BinaryIO) -> Iterator[LogFrame | OtherPacket]:
    """The packets of a pcap or pcapng file in its order. Raises BrokenCapture where it does not go on."""
    magic = file.read(4)
    return _pcapng(file) if magic == PCAPNG_MAGIC else _pcap(file, *PCAP_MAGICS[magic])


def _pcap(file: BinaryIO, order: str, unit_ns: int) -> Iterator[LogFrame | OtherPacket]:
    head = Struct(order + "HHiIII")
    kind = head.unpack(_exactly(file, head.size, "its header"))[5] & 0xFFFF
    record, number = Struct(order + "IIII"), 0
    while start := file.read(record.size):
        number += 1
        if len(start) < record.size:
            raise BrokenCapture(f"it ends within packet {number}")
        seconds, part, length, _ = record.unpack(start)
        data = _exactly(file, length, f"packet {number}")
        yield _frame(number, seconds * NS_PER_S + part * unit_ns, _Link(kind, ""), data, order, "")


def _pcapng(file: BinaryIO) -> Iterator[LogFrame | OtherPacket]:
    order, number, links = "<", 0, list[_Link]()
    first = True
    while first or (word := file.read(4)):
        kind_word = PCAPNG_MAGIC if first else word
        first = False
        length_word = _exactly(file, 4, "a block")
        if kind_word == PCAPNG_MAGIC:
            start = _exactly(file, 4, "a section header")
            order, links = ("<" if start == b"\x4d\x3c\x2b\x1a" else ">"), []
            _block(file, order, length_word, already=12)
            continue
        if len(kind_word) < 4:
            raise BrokenCapture("it ends within a block")
        kind = int.from_bytes(kind_word, "little" if order == "<" else "big")
        body = _block(file, order, length_word, already=8)
        if kind == 1:
            links.append(_link(body, order))
        elif kind == 6:
            number += 1
            yield _enhanced(number, body, order, links)
        elif kind == 3:
            number += 1
            link = links[0] if links else _Link(0, "")
            yield _frame(number, None, link, body[4:], order, "")


def _block(file: BinaryIO, order: str, length_word: bytes, already: int) -> bytes:
    """The rest of a block without its closing length."""
    length = Struct(order + "I").unpack(length_word)[0]
    if length < already + 4 or length % 4:
        raise BrokenCapture(f"a block of {length} bytes")
    return _exactly(file, length - already, "a block")[:-4]


def _link(body: bytes, order: str) -> _Link:
    if len(body) < _HEADER:
        raise BrokenCapture("an interface description that is too short")
    name, units, offset = "", 1_000_000, 0
    for code, value in _options(body[8:], order):
        if code == 2:
            name = value.decode("utf-8", "replace").rstrip("\0")
        elif code == 9 and value:
            power = value[0] & 0x7F
            units = 1 << power if value[0] & 0x80 else 10 ** min(power, 18)
        elif code == 14 and len(value) == 8:
            offset = Struct(order + "q").unpack(value)[0]
    return _Link(Struct(order + "H").unpack_from(body)[0], name, units, offset)


def _enhanced(number: int, body: bytes, order: str, links: list[_Link]) -> LogFrame | OtherPacket:
    head = Struct(order + "IIIII")
    if len(body) < head.size:
        raise BrokenCapture(f"packet {number} is too short")
    which, high, low, length, _ = head.unpack_from(body)
    if which >= len(links) or length > len(body) - head.size:
        raise BrokenCapture(f"packet {number} contradicts its file")
    link = links[which]
    at_ns = link.offset_s * NS_PER_S + (high << 32 | low) * NS_PER_S // link.units_per_s
    sent = ""
    for code, value in _options(body[head.size + (length + 3) // 4 * 4 :], order):
        if code == 2 and len(value) == 4:
            sent = {1: "R", 2: "T"}.get(Struct(order + "I").unpack(value)[0] & 3, "")
    return _frame(number, at_ns, link, body[head.size : head.size + length], order, sent)


def _options(rest: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    head, place = Struct(order + "HH"), 0
    while place + head.size <= len(rest):
        code, length = head.unpack_from(rest, place)
        if not code:
            return
        yield code, rest[place + 4 : place + 4 + length]
        place += 4 + (length + 3) // 4 * 4


def _frame(
    number: int, at_ns: int | None, link: _Link, data: bytes, order: str, sent: str
) -> LogFrame | OtherPacket:
    id_order = ">"
    if link.kind in (_COOKED, _COOKED_2):
        first = link.kind == _COOKED
        size, protocol, kind = (16, data[14:16], data[1:2]) if first else (20, data[:2], data[10:11])
        if int.from_bytes(protocol, "big") not in _COOKED_PROTOCOLS:
            return OtherPacket(number)
        sent, data = ("T" if kind == bytes((_OUTGOING,)) else "R"), data[size:]
        id_order = order  # unlike 227: as the host had it that captured (Wireshark's reading, too)
    elif link.kind == _UPPER_PDU:
        name, data = _upper(data)
        if name not in (b"can-hostendian", b"can-bigendian", b"canfd"):
            return OtherPacket(number)
        id_order = ">" if name == b"can-bigendian" else order
    elif link.kind != _SOCKETCAN:
        return OtherPacket(number)
    if len(data) < _HEADER:
        return OtherPacket(number)
    word, length, flags = Struct(id_order + "IBB").unpack_from(data)
    fd = bool(flags & _FD_FRAME) or length > CLASSICAL_BYTES_MAX
    if length > FD_BYTES_MAX or (not word & REMOTE_FLAG and len(data) < _HEADER + length):
        return OtherPacket(number)
    remote, error = bool(word & REMOTE_FLAG), bool(word & ERROR_FLAG)
    can_id = word & (EXTENDED_ID_MAX if word & (EXTENDED_FLAG | ERROR_FLAG) else STANDARD_ID_MAX)
    payload = b"" if remote else data[_HEADER : _HEADER + length]
    extended = bool(word & EXTENDED_FLAG) and not error
    return LogFrame(number, at_ns, link.name, can_id, payload, extended, remote, error, fd, sent)


def _upper(data: bytes) -> tuple[bytes, bytes]:
    """Name of the dissector, and what it is for."""
    name, place, head = b"", 0, Struct(">HH")
    while place + head.size <= len(data):
        tag, length = head.unpack_from(data, place)
        place += head.size
        if not tag:
            return name, data[place:]
        if tag == 12:
            name = data[place : place + length].rstrip(b"\0")
        place += length
    return b"", b""


def _exactly(file: BinaryIO, length: int, what: str) -> bytes:
    if length > _RECORD_MAX:
        raise BrokenCapture(f"{what} of {length} bytes")
    data = file.read(length)
    if len(data) < length:
        raise BrokenCapture(f"it ends within {what}")
    return data
