"""pcap and pcapng as frames, with the link types in which CAN comes.

    227 CAN_SOCKETCAN        what tcpdump and Wireshark capture on can0
    113, 276 LINUX_SLL(2)    the same on the interface "any"
    252 WIRESHARK_UPPER_PDU  what Wireshark and tshark make of a log of another program

An own reader: no library that this project has knows the two formats, and both are headers of fixed length.
Sources: draft-ietf-opsawg-pcap, -pcapng; the link-type pages of tcpdump.org; linux/can.h.
"""

from collections.abc import Iterator
from struct import Struct
from typing import BinaryIO, Final, NamedTuple

from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.wire.identifiers import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    EXTENDED_ID_MAX,
    REMOTE_FLAG,
    STANDARD_ID_MAX,
)
from servobench.hil.reviewing.trace.log_frame import CLASSICAL_BYTES_MAX, FD_BYTES_MAX, LogFrame

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
